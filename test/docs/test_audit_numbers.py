# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""docs/audit.md has a row for every number of the thesis, and no page or docstring quotes an equation that is none."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LAST = {'2.': 49, '3.': 23, '4.': 34, '5.': 7, 'A-': 21, 'B-': 8}
"""The last equation of each chapter and appendix; all before it are numbered."""
FIGURES = {'1.': 4, '2.': 13, '3.': 4, '4.': 3, '5.': 35}
EQUATIONS = {f'{chapter}{n}' for chapter, last in LAST.items() for n in range(1, last + 1)}
EVERY = {
    *(f'({e})' for e in EQUATIONS),
    *(f'Fig. {chapter}{n}' for chapter, last in FIGURES.items() for n in range(1, last + 1)),
    *('Fig. A1', 'Fig. A2', 'Fig. B1', 'Table 3.1', 'Table 5.1', 'Table B1', 'Table B2'),
    *(f'Appendix {letter}' for letter in 'ABCD'),
}
STATES = ('done', 'corrected', 'replaced', 'out of scope')
_NUMBER = r'(?:[2-5]\.[1-9]\d?|[AB]-[1-9]\d?)'
_QUOTED = re.compile(rf'\(({_NUMBER}(?:(?:, | and |–|-){_NUMBER})*)\)')


def spelled(words: str) -> Iterator[str]:
    """The numbers of a row's first cell: ``(2.1–2.4), Fig. 2.5``."""
    for part in words.split(', '):
        match = re.fullmatch(r'(\(|Fig\. |Table |Appendix )([^–)]+)(?:–([^–)]+))?(\)?)', part)
        assert match is not None, part
        kind, first, last, close = match.groups()
        if last is None:
            yield f'{kind}{first}{close}'
            continue
        head = re.sub(r'\d+$', '', first)
        assert last.startswith(head), part
        for n in range(int(first[len(head) :]), int(last[len(head) :]) + 1):
            yield f'{kind}{head}{n}{close}'


def test_every_number_of_the_thesis_has_one_row_with_its_state() -> None:
    page = (ROOT / 'docs' / 'audit.md').read_text(encoding='utf-8')
    rows = [line.strip('|').split('|') for line in page.split('## Every number')[1].splitlines() if line[:1] == '|']
    rows = [[cell.strip() for cell in row] for row in rows if row[0].strip('- ') not in ('', 'number')]
    found = [number for row in rows for number in spelled(row[0])]
    assert sorted(found) == sorted(EVERY)
    assert {row[1] for row in rows} <= set(STATES)
    assert all(row[2] for row in rows)


def texts() -> Iterator[tuple[str, str]]:
    """Pages, and docstrings of the package."""
    for path in (ROOT / 'docs').glob('*.md'):
        yield path.name, path.read_text(encoding='utf-8')
    for path in (ROOT / 'psd_deflection').rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                yield str(path.relative_to(ROOT)), ast.get_docstring(node) or ''


@pytest.mark.slow
def test_no_equation_is_quoted_that_the_thesis_has_not() -> None:
    quoted = [(where, n) for where, text in texts() for q in _QUOTED.findall(text) for n in re.findall(_NUMBER, q)]
    assert len(quoted) > 50
    assert [(where, n) for where, n in quoted if n not in EQUATIONS] == []
