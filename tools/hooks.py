# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Inserts text from the program into the pages when the site is built, so that the two agree.

``<!-- messages -->``: every error message, by exit status. ``<!-- commands -->``: every command's
help. ``<!-- parameters -->``: every parameter. ``<!-- effects -->``: every effect of the package.
``<!-- exit statuses -->``: what each one means.
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

from psd_deflection.base import errors
from psd_deflection.cli.main import COMMANDS, main, make_parser
from psd_deflection.cli.studies.effects import explained
from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.rig.declarations import PARAMETERS

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ('psd_deflection', 'msg_adapters')
OWN_EFFECTS = {path.stem for path in (ROOT / 'psd_deflection' / 'model' / 'simulation' / 'effects').glob('[a-z]*.py')}
"""Not those of whoever builds the site."""

STATUS = {
    name: kind.exit_status
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, errors.PsdDeflectionError) and kind is not errors.PsdDeflectionError
}
"""Error class to exit status."""

WITHOUT_STATUS = ('DamagedError', 'RefusedError', 'SourceEndedError', '_FullError', '_GoneError')
"""Messages of the live page or the log: warnings that end nothing."""

READERS = (
    'msg_adapters',
    'psd_deflection.recordings.read.clouds',
    'psd_deflection.recordings.cdr',
    'psd_deflection.recordings.read.bag_reader',
)
"""Whose ValueErrors say what is wrong with a recorded message; the reader puts file and topic before them."""


def template(node: ast.expr) -> str:
    """The text of a message, with … for variable parts; '' if it is not a literal."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return ''.join(v.value if isinstance(v, ast.Constant) else '…' for v in node.values)  # type: ignore[misc]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return template(node.left) + template(node.right)
    return '…'


def trees() -> Iterator[tuple[str, ast.Module]]:
    """(module, syntax tree) of every module of the program."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob('*.py')):
            module = str(path.relative_to(ROOT).with_suffix('')).replace('/', '.')
            yield module, ast.parse(path.read_text(encoding='utf-8'))


def messages() -> Iterator[tuple[str, str, str]]:
    """(error class, message, module) of every error that the program makes."""
    kinds = error_kinds()
    for module, tree in trees():
        known = kinds | ({'ValueError': 'RecordingError'} if module.startswith(READERS) else {})
        functions = {f.name: f for f in ast.walk(tree) if isinstance(f, ast.FunctionDef)}
        makers = dict(filter(None, (_maker(f, known) for f in functions.values())))
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call) or not node.args:
                continue
            name = _callee(node)
            if name in makers:
                kind, head = makers[name]
                yield kind, head + template(node.args[0]), module
            elif name in known:
                head = '…: ' if name == 'ValueError' else ''
                for text in _expanded(node.args[0], functions):
                    if text.strip('…:= '):
                        yield known[name], head + text, module


def error_kinds() -> dict[str, str]:
    """Name of each class of error that a user meets to the one of ``STATUS`` that it is, or to itself."""
    kinds = {name: name for name in (*STATUS, *WITHOUT_STATUS)}
    found = [c for _, tree in trees() for c in ast.walk(tree) if isinstance(c, ast.ClassDef)]
    for c in found * 2:
        for base in c.bases:
            if isinstance(base, ast.Name) and base.id in kinds:
                kinds.setdefault(c.name, kinds[base.id])
    return kinds


def _callee(node: ast.Call) -> str:
    return str(getattr(node.func, 'id', None) or getattr(node.func, 'attr', ''))


def _maker(function: ast.FunctionDef, known: dict[str, str]) -> tuple[str, tuple[str, str]] | None:
    """(name, (error class, how its messages begin)) of a function that makes an error of the reason it is given."""
    parameters = {a.arg for a in function.args.args}
    for node in ast.walk(function):
        if isinstance(node, ast.Return) and isinstance(node.value, ast.Call) and _callee(node.value) in known:
            (text, *_) = node.value.args
            if isinstance(text, ast.JoinedStr) and isinstance(text.values[-1], ast.FormattedValue):
                last = text.values[-1].value
                if isinstance(last, ast.Name) and last.id in parameters:
                    return function.name, (known[_callee(node.value)], template(text)[:-1])
    return None


def _expanded(node: ast.expr, functions: dict[str, ast.FunctionDef]) -> Iterator[str]:
    """The text of a message; where it ends with what a function of the module says, each thing that one says."""
    if isinstance(node, ast.JoinedStr) and isinstance(node.values[-1], ast.FormattedValue):
        last = node.values[-1].value
        if isinstance(last, ast.Call) and _callee(last) in functions:
            for said in ast.walk(functions[_callee(last)]):
                if isinstance(said, ast.Return) and said.value is not None:
                    value = said.value
                    if isinstance(value, ast.Call) and isinstance(value.func, ast.Attribute):
                        value = value.func.value
                    yield template(node)[:-1] + template(value)
            return
    yield template(node)


def message_tables() -> str:
    """One table per exit status, and one of messages that end nothing."""
    out = []
    found = list(messages())
    headings = {name: f'Exit status {status}: {name}' for name, status in sorted(STATUS.items(), key=lambda i: i[1])}
    for names, heading in [*(((n,), h) for n, h in headings.items()), (WITHOUT_STATUS, 'While it goes on')]:
        rows = sorted({(text, module) for kind, text, module in found if kind in names})
        if rows:
            out.append(f'## {heading}\n\n| message | from |\n|---|---|')
            out += [f'| {cell(text)} | `{module}` |' for text, module in rows]
            out.append('')
    return '\n'.join(out)


def cell(text: str) -> str:
    """``text`` as the tables show it."""
    text = re.sub(r'…+', '…', re.sub(r'\s+', ' ', text))
    return '`' + text.replace('|', '\\|').replace('`', "'") + '`'


def command_help() -> str:
    """The help of each command."""
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
        live = ' (may change while running)' if p.live else ''
        rows.append(f'| `{p.name}` | `{p.default}` | {p.unit} | {p.bound_text()} | {p.description}{live} |')
    return '\n'.join(rows)


def exit_statuses() -> str:
    """Each exit status and its meaning."""
    rows = [f'| {status} | {meaning} |' for status, meaning in errors.EXIT_STATUSES.items()]
    return '\n'.join(['| status | meaning |', '|---|---|', *rows])


def effect_list() -> str:
    """Every effect of the package, explained."""
    shown = sorted((e for e in catalogue().values() if e.name in OWN_EFFECTS), key=lambda e: e.rank)
    return '\n'.join(f'## {e.name}\n\n```text\n{chr(10).join(explained(e))}\n```\n' for e in shown)


FILLED = {
    'effects': effect_list,
    'exit statuses': exit_statuses,
    'messages': message_tables,
    'commands': command_help,
    'parameters': parameter_table,
}


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """mkdocs calls it for each page."""
    for name, fill in FILLED.items():
        mark = f'<!-- {name} -->'
        if mark in markdown:
            # Also replace the line below the marker, which is for readers of the file itself.
            before, _, after = markdown.partition(f'{mark}\n')
            markdown = f'{before}{fill()}\n{after.partition(chr(10))[2]}'
    return markdown


def on_page_content(html: str, **kwargs: Any) -> str:
    """mkdocs calls it for each page: convert Sphinx roles in docstrings, which mkdocs does not render."""
    html = re.sub(r':(?:class|meth|func|mod|data|attr):(?=<code>)', '', html)
    return re.sub(r'<code>~[\w.]*\.(\w+)</code>', r'<code>\1</code>', html)


def on_post_page(output: str, **kwargs: Any) -> str:
    """mkdocs calls it for each finished page: name what the theme leaves without a name, for screen readers."""

    def named(nav: re.Match[str]) -> str:
        title = re.search(rf'<label class="md-nav__title" for="{nav[1]}">(.*?)</label>', output, re.S)
        return nav[0] if title is None else f'aria-label="{" ".join(re.sub("<[^>]+>", "", title[1]).split())}"'

    html = re.sub(r'aria-labelledby="(__nav_[\d_]+)_label"', named, output)
    search = 'data-md-component="search" role="dialog"'
    return html.replace(f'{search}>', f'{search} aria-label="Search">')


def on_post_template(output: str, template_name: str, **kwargs: Any) -> str:
    """mkdocs calls it for each page that has no Markdown, such as 404.html."""
    return on_post_page(output) if template_name.endswith('.html') else output
