# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rooms: what their lines allow, which tests should notice their mutants, and no class name for two things."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

from tools.allow_contract import broken_by
from tools.mutants_by_hand import KINDS, hand_made
from tools.rooms import large_functions
from tools.tiers import ROOMS

ROOT = Path(__file__).parents[1]
PURE = {'math', 'numpy'}
LINES = {'psd_deflection': ['warnings'], 'psd_deflection.measure': [], 'psd_deflection.run': ['threading']}
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


def test_no_class_name_stands_for_two_things() -> None:
    places = defaultdict(list)
    for package in ('psd_deflection', 'msg_adapters'):
        for path in sorted((ROOT / package).rglob('*.py')):
            for node in ast.parse(path.read_text(encoding='utf-8')).body:
                if isinstance(node, ast.ClassDef):
                    places[node.name].append(str(path.relative_to(ROOT)))
    assert len(places) > 300
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


def test_no_function_is_large() -> None:
    assert large_functions(ROOT) == {}


def test_each_lies_in_a_room_whose_tests_should_notice() -> None:
    rooms = [path for room in ROOMS.values() for path in room.code]
    for m in hand_made():
        assert any(m.file == path or m.file.startswith(f'{path}/') for path in rooms), m.file
    for room in ROOMS.values():
        for path in (*room.code, *room.leave):
            assert (ROOT / path).exists(), path


def test_each_room_has_quick_tests_in_each_of_its_files() -> None:
    for room in ROOMS.values():
        for path in map(ROOT.joinpath, (*room.tests, *room.slow)):
            files = list(path.rglob('test_*.py')) or [path]
            slow = ['pytestmark = pytest.mark.slow' in file.read_text() for file in files]
            assert not all(slow) or str(path.relative_to(ROOT)) not in room.tests, path


def test_each_mutant_made_by_hand_changes_one_line_and_can_run() -> None:
    every = hand_made()
    assert {m.kind for m in every} == set(KINDS)
    assert len(set(every)) == len(every)
    for m in every:
        text = (ROOT / m.file).read_text()
        changed = m.code(text)
        ast.parse(changed)
        lines = [(a, b) for a, b in zip(text.splitlines(), changed.splitlines(), strict=True) if a != b]
        assert [(a.strip(), b.strip()) for a, b in lines] == [(m.was, m.made)]
