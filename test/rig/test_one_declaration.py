# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A parameter is declared once and its value is checked in one place, for files, options and nodes alike."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import psd_deflection

PACKAGE = Path(psd_deflection.__file__).parent
THE_PLACE = Path('rig/parameters.py')
ARGUMENTS = {('__init__.py', 'simulate')}
"""Functions that check an argument of a caller in Python, which is no parameter."""
NUMBERS = {'int', 'float', 'bool'}


def functions() -> Iterator[tuple[Path, ast.FunctionDef]]:
    for path in sorted(PACKAGE.rglob('*.py')):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                yield path.relative_to(PACKAGE), node


def calls(tree: ast.AST, name: str) -> Iterator[ast.Call]:
    return (n for n in ast.walk(tree) if isinstance(n, ast.Call) and ast.unparse(n.func).rpartition('.')[2] == name)


def checks_a_number(function: ast.FunctionDef) -> bool:
    """Whether it looks at the type of a value and rejects it as a parameter."""
    raised = (n.exc for n in ast.walk(function) if isinstance(n, ast.Raise) and n.exc is not None)
    rejects = any('ConfigError' in ast.unparse(error) for error in raised)
    kinds = {n.id for call in calls(function, 'isinstance') for n in ast.walk(call.args[1]) if isinstance(n, ast.Name)}
    return rejects and bool(kinds & NUMBERS)


def test_a_number_of_a_file_is_checked_in_one_place() -> None:
    found = {(str(path), function.name) for path, function in functions() if checks_a_number(function)}
    assert found == ARGUMENTS


def test_a_field_is_declared_as_a_parameter_in_one_place() -> None:
    declared = {
        path.relative_to(PACKAGE)
        for path in PACKAGE.rglob('*.py')
        for call in calls(ast.parse(path.read_text()), 'field')
        if any(keyword.arg == 'metadata' for keyword in call.keywords)
        # pyarrow's fields are columns.
        and not ast.unparse(call.func).startswith('pa.')
    }
    assert declared == {THE_PLACE}
