"""What the pages get from the program itself when the site is built, so that they cannot disagree.

``<!-- messages -->``: every error message, by exit status. ``<!-- commands -->``: every command's
help. ``<!-- parameters -->``: every parameter.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from psd_deflection import errors
from psd_deflection.cli.main import COMMANDS, main, make_parser
from psd_deflection.parameters import PARAMETERS

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ('psd_deflection', 'msg_adapters')

STATUS = {
    name: kind.exit_status
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, errors.PsdDeflectionError) and kind is not errors.PsdDeflectionError
}
"""Error class to exit status."""


def template(node: ast.expr) -> str:
    """The text of a message, with … for what depends on the case; '' where it is no literal."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return ''.join(v.value if isinstance(v, ast.Constant) else '…' for v in node.values)  # type: ignore[misc]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return template(node.left) + template(node.right)
    return '…'


def messages() -> Iterator[tuple[str, str, str]]:
    """(error class, message, module) of every error that the program makes."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob('*.py')):
            for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
                if (
                    isinstance(node, ast.Call)
                    and isinstance(node.func, ast.Name)
                    and node.func.id in STATUS
                    and node.args
                ):
                    text = template(node.args[0])
                    if text.strip('…: '):
                        yield node.func.id, text, str(path.relative_to(ROOT).with_suffix('')).replace('/', '.')


def message_tables() -> str:
    """One table an exit status."""
    out = []
    for name, status in sorted(STATUS.items(), key=lambda item: item[1]):
        rows = sorted({(text, module) for kind, text, module in messages() if kind == name})
        if rows:
            out.append(f'### Exit status {status}: {name}\n\n| message | from |\n|---|---|')
            out += [f'| {_cell(text)} | `{module}` |' for text, module in rows]
            out.append('')
    return '\n'.join(out)


def _cell(text: str) -> str:
    return '`' + re.sub(r'\s+', ' ', text).replace('|', '\\|').replace('`', "'") + '`'


def command_help() -> str:
    """What each command says of itself."""
    out = []
    os.environ['COLUMNS'] = '90'
    make_parser(())
    for name in COMMANDS:
        stream = io.StringIO()
        with contextlib.redirect_stdout(stream), contextlib.suppress(SystemExit):
            main([name, '--help'])
        out.append(f'### {name}\n\n```text\n{stream.getvalue().rstrip()}\n```\n')
    return '\n'.join(out)


def parameter_table() -> str:
    """Every parameter with unit, bounds and default."""
    rows = ['| parameter | default | unit | bounds | |', '|---|---|---|---|---|']
    for p in PARAMETERS:
        bounds = p.bound_text() or (', '.join(p.choices) if p.choices else '')
        live = ' (may change while running)' if p.live else ''
        rows.append(f'| `{p.name}` | `{p.default}` | {p.unit} | {bounds} | {p.description}{live} |')
    return '\n'.join(rows)


FILLED = {'messages': message_tables, 'commands': command_help, 'parameters': parameter_table}


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """mkdocs calls it for each page."""
    for name, fill in FILLED.items():
        mark = f'<!-- {name} -->'
        if mark in markdown:
            # In the place of the line below it too, which is for those who read the file itself.
            before, _, after = markdown.partition(f'{mark}\n')
            markdown = f'{before}{fill()}\n{after.partition(chr(10))[2]}'
    return markdown


def on_page_content(html: str, **kwargs: Any) -> str:
    """mkdocs calls it for each page: docstrings name other things as Sphinx wants them, which is not drawn here."""
    html = re.sub(r':(?:class|meth|func|mod|data|attr):(?=<code>)', '', html)
    return re.sub(r'<code>~[\w.]*\.(\w+)</code>', r'<code>\1</code>', html)
