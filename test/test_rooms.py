# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rooms: mutants in each of them, no class name for two things, a bound for what grows."""

import ast
import importlib
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest

import psd_deflection
from blind.sweep import declared
from tools.mutants_by_hand import hand_made
from tools.tiers import ROOMS

ROOT = Path(__file__).parents[1]


def test_no_class_name_stands_for_two_things() -> None:
    places = defaultdict(list)
    for package in ('psd_deflection', 'msg_adapters'):
        for path in sorted((ROOT / package).rglob('*.py')):
            for node in ast.parse(path.read_text(encoding='utf-8')).body:
                if isinstance(node, ast.ClassDef):
                    places[node.name].append(str(path.relative_to(ROOT)))
    assert len(places) > 300
    assert {name: modules for name, modules in places.items() if len(modules) > 1} == {}


def test_each_threshold_has_unit_reason_trade_and_a_use() -> None:
    listed = list(declared())
    # Less than 80 with the ten of the predictive mean, which no other module shares.
    assert 60 < len(listed) < 70
    assert [(name, words) for _, name, words in listed if len(words) != 3 or '' in words] == []
    studies = ROOT / 'psd_deflection' / 'studies'
    paths = [path for room in ('discover', 'loads') for path in (studies / room).rglob('*.py')]
    text = '\n'.join(path.read_text(encoding='utf-8') for path in paths if path.name != 'thresholds.py')
    assert [name for _, name, _ in listed if len(re.findall(rf'\b{name}\b', text)) < 2] == []


def test_each_mutant_made_by_hand_changes_a_line_of_a_room() -> None:
    rooms = [path for room in ROOMS.values() for path in room.code]
    for m in hand_made():
        assert any(m.file == path or m.file.startswith(f'{path}/') for path in rooms), m.file
        ast.parse(m.code((ROOT / m.file).read_text()))


@pytest.mark.parametrize(('noticed', 'status'), [(95, 0), (94, 1)])
def test_mutants_fail_below_95_percent(monkeypatch: pytest.MonkeyPatch, noticed: int, status: int) -> None:
    """Without cosmic-ray, which has an environment of its own."""
    for name in ('', '.ast', '.mutating', '.plugins'):
        monkeypatch.setitem(sys.modules, f'cosmic_ray{name}', Mock())
    mutants = importlib.import_module('tools.mutants')
    made = [('x', 'quick')] * noticed + [('x', '')] * (100 - noticed)
    monkeypatch.setattr(mutants, 'tried', lambda *_: made)
    assert mutants.main(['--rooms', 'solvers']) == status


PACKAGE = Path(psd_deflection.__file__).parent
RUNNING = ('run', 'ros', 'devices', 'camera', 'arms', 'measure')
UNBOUNDED = {
    *('dict', 'set', 'list', 'Counter', 'defaultdict', 'OrderedDict', 'deque', 'SimpleQueue', 'Queue', 'LifoQueue')
}
GROWS = {'append', 'appendleft', 'add', 'setdefault', 'extend', 'update', 'put', 'put_nowait', 'insert'}


@pytest.mark.parametrize('room', RUNNING)
def test_what_others_can_make_grow_names_its_bound(room: str) -> None:
    """A container of an object that has no ``maxlen`` and grows is declared beside a comment ``Bound: ...``."""
    for path in sorted((PACKAGE / room).rglob('*.py')):
        text = path.read_text()
        lines, nodes = text.splitlines(), list(ast.walk(ast.parse(text)))
        containers = [(name, node.lineno) for node in nodes if isinstance(node, ast.stmt) for name in _kept(node)]
        bounded = {name for name, line in containers if 'Bound: ' in ''.join(lines[max(line - 2, 0) : line + 1])}
        growing = {name for name, _ in containers} & {name for node in nodes for name in _grown(node)}
        assert growing <= bounded, path


def _kept(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and _is_unbounded(node.value):
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            if isinstance(target, ast.Attribute):
                yield target.attr
    # A field of a dataclass.
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and isinstance(node.value, ast.Call):
        factory = next((k.value for k in node.value.keywords if k.arg == 'default_factory'), None)
        if factory is not None and _name(factory) in UNBOUNDED:
            yield node.target.id


def _is_unbounded(value: ast.expr) -> bool:
    if isinstance(value, ast.Dict | ast.Set | ast.List):
        return not (value.keys if isinstance(value, ast.Dict) else value.elts)
    if not isinstance(value, ast.Call) or _name(value.func) not in UNBOUNDED:
        return False
    return not any(k.arg in ('maxlen', 'maxsize') for k in value.keywords)


def _grown(node: ast.AST) -> Iterator[str]:
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign | ast.AugAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Attribute):
            yield node.target.attr
    for target in targets:
        if isinstance(target, ast.Subscript) and not isinstance(target.slice, ast.Constant):
            yield _name(target.value) if isinstance(target.value, ast.Attribute) else ''
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in GROWS:
        yield _name(node.func.value) if isinstance(node.func.value, ast.Attribute) else ''


def _name(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ''
