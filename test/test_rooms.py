# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rooms: their number, what their lines allow, and that no class name stands for two things."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

from tools.allow_contract import broken_by
from tools.rooms import Measured, circles, large_functions, measured, private_names

ROOT = Path(__file__).resolve().parents[1]
PURE = {'math', 'numpy'}
LINES = {
    'psd_deflection': ['warnings'],
    'psd_deflection.measure': [],
    'psd_deflection.run': ['threading'],
}
NO_ROOM = 'no line for the room psd_deflection.attic'
FOREIGN = ('concurrent', 'multiprocessing', 'trajectory_msgs', 'aiohttp', 'urllib', 'threading')
AS_IT_IS = {
    'psd_deflection': {'warnings'},
    'psd_deflection.measure': set[str](),
    'psd_deflection.measure.averaging': {'numpy'},
    'psd_deflection.run.session': {'threading', 'math'},
}


@pytest.mark.parametrize(
    ('module', 'libraries', 'message'),
    [
        *(('measure.averaging', {name}, f'imports {name}, which no line') for name in FOREIGN),
        ('attic', set(), NO_ROOM),
        ('attic.box', {'math'}, NO_ROOM),
        # What the package itself may import is not for its rooms.
        ('run.session', {'threading', 'warnings'}, 'session imports warnings, which no line'),
        ('run.session', {'math'}, 'run: threading is allowed, and nobody imports it'),
    ],
)
def test_what_no_line_allows_is_broken(module: str, libraries: set[str], message: str) -> None:
    (line,) = broken_by(AS_IT_IS | {f'psd_deflection.{module}': libraries}, PURE, LINES)
    assert message in line


def test_what_the_lines_allow_is_kept() -> None:
    assert broken_by(AS_IT_IS, PURE, LINES) == []
    attic = {'psd_deflection.attic': ['numpy']}
    (line,) = broken_by(AS_IT_IS, PURE, LINES | attic)
    assert line == 'psd_deflection.attic: the line names no module'
    one = {'psd_deflection.measure.averaging': ['aiohttp']}
    wider = AS_IT_IS | {'psd_deflection.measure.averaging': {'aiohttp'}}
    assert broken_by(wider, PURE, LINES | one) == []
    (line,) = broken_by(wider | {'psd_deflection.measure.timing': {'aiohttp'}}, PURE, LINES | one)
    assert line == 'psd_deflection.measure.timing imports aiohttp, which no line allows there'


def test_circles_are_found() -> None:
    straight = [('a', 'b'), ('b', 'c'), ('a', 'c'), ('d', 'c')]
    assert circles(straight) == []
    assert circles([*straight, ('c', 'b'), ('d', 'e'), ('e', 'd')]) == [['b', 'c'], ['d', 'e']]


def test_the_house_is_one_that_a_person_keeps_in_mind() -> None:
    message = subprocess.run(
        [sys.executable, '-m', 'tools.rooms'], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    rooms, files, lines, arrows = map(int, re.findall(r'\d+', message[-2]))
    assert rooms <= 22
    assert arrows <= 150
    assert (files, lines) > (100, 10_000)
    assert re.fullmatch(r'make targets: \d+; private names in test: \d+', message[-4])
    assert message[-1] == 'circles of rooms: none; circles of modules: none'


def test_the_tests_lie_where_the_code_lies() -> None:
    code, tests = ROOT / 'psd_deflection', ROOT / 'test'
    rooms = {p.name for p in code.iterdir() if (p / '__init__.py').is_file()}
    folders = {p.parent.relative_to(tests) for room in rooms for p in (tests / room).rglob('*.py')}
    assert len(rooms) > 10
    assert [str(f) for f in folders if not (code / f).is_dir()] == []


def test_no_class_name_stands_for_two_things() -> None:
    places = defaultdict(list)
    for package in ('psd_deflection', 'msg_adapters'):
        for path in sorted((ROOT / package).rglob('*.py')):
            for node in ast.parse(path.read_text(encoding='utf-8')).body:
                if isinstance(node, ast.ClassDef):
                    places[node.name].append(str(path.relative_to(ROOT)))
    assert len(places) > 300
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


FORKS = """
def plain(a, *rest, b=1, **more): return a
async def forks(self, x):
    if x and x or x: pass
    elif x: pass
    for i in x: pass
    else: pass
    while x: x = 1 if x else 2
    try: pass
    except A: pass
    except B: pass
    else: pass
    match x:
        case 1: pass
        case 2: pass
    def inside(y):
        return [z for z in y if z if not z]
class Box:
    def put(self, a, b, /, c, *, d): return lambda e: e or c
"""


def test_forks_and_parameters_are_counted() -> None:
    assert measured(FORKS) == {
        'plain': Measured(1, 2),
        'forks': Measured(14, 1),
        'forks.inside': Measured(4, 1),
        'Box.put': Measured(2, 4),
    }
    assert not Measured(20, 8).is_large
    assert Measured(21, 0).is_large
    assert Measured(1, 9).is_large


def test_private_names_are_counted(tmp_path: Path) -> None:
    (tmp_path / 'test_it.py').write_text(
        'module._part(self._own, cls._own)\na.b._cut = Other._D = __name__ + one._two()\n'
        'point._replace(x=1)._asdict()\n'
    )
    assert private_names(tmp_path) == ['module._part', 'b._cut', 'one._two']


def test_no_function_is_large() -> None:
    assert large_functions(ROOT) == {}
