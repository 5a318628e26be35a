# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""docs/trust.md against the texts of the package: no correction without its row, no row without its line."""

import ast
import re
from collections.abc import Iterator
from functools import cache

from tools.program import ROOT

PACKAGE = ROOT / 'psd_deflection'
PAGE = (ROOT / 'docs' / 'trust.md').read_text('utf-8')
LOGS = {'log', '_log', '_report', 'warn', '_warn'}
CORRECTS = re.compile(
    r'start(s|ed) (again|anew)|time map|1 ns apart|dropped|deleted,|kept to|not processed|not kept|left with|back$|'
    r'to come back|not corrected|begins later|cannot be read|taking a|is not waited|stopped: |rejected|still '
)
OTHER = (
    # The name of a kind of line.
    'rejected {}',
    # It is of a request, which is answered with it.
    '{}: {}: {}: {}',
    'the source hangs; it is not waited for',
    '{} is rejected: {}',
)


def text_of(node: ast.AST) -> str:
    """A string of the source, with {} for what is put in; '' for anything else."""
    if isinstance(node, ast.JoinedStr):
        return ''.join(str(v.value) if isinstance(v, ast.Constant) else '{}' for v in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ''


@cache
def sources() -> tuple[tuple[str, ast.Module], ...]:
    paths = sorted(PACKAGE.rglob('*.py'))
    return tuple((p.relative_to(PACKAGE).parts[0], ast.parse(p.read_text('utf-8'))) for p in paths)


@cache
def texts() -> str:
    return '\n'.join(text_of(node) for _, tree in sources() for node in ast.walk(tree))


def lines() -> Iterator[str]:
    """What run, ros and devices log."""
    for room, tree in sources():
        for call in ast.walk(tree):
            if room in ('run', 'ros', 'devices') and isinstance(call, ast.Call):
                name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, 'id', '')
                yield from (text_of(a) for a in call.args if name in LOGS)


def rows(heading: str, column: int) -> list[list[str]]:
    section = PAGE.split(f'## {heading}\n')[1].split('\n## ')[0]
    table = [line.split('|')[1:-1] for line in section.splitlines() if line.startswith('|')]
    return [re.findall('`([^`]*)`', row[column]) for row in table[2:]]


def test_each_correction_has_a_line_that_the_package_logs() -> None:
    stated = rows('Corrections', 1)
    assert all(stated)
    assert [part for row in stated for part in row if part not in texts()] == []


def test_each_logged_correction_is_in_the_table() -> None:
    stated = [part for row in rows('Corrections', 1) for part in row]
    result = {line for line in lines() if ' ' in line and CORRECTS.search(line)}
    assert len(result) > 20
    assert [line for line in result if not any(part in line for part in (*stated, *OTHER))] == []


def test_statements_are_package_texts_with_known_basis() -> None:
    named = [part for row in rows('Statements', 0) for part in row]
    assert [part for part in named if part.split('JOINT')[0].split('CAUSE')[0].split('ACTION')[0] not in texts()] == []
    section = PAGE.split('## Statements\n')[1]
    table = [line.split('|') for line in section.splitlines() if line.startswith('|')][2:]
    assert [row[1] for row in table if not re.match(r' (measured|acknowledged|assumed)', row[3])] == []
