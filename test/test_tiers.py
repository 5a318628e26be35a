# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The table of rooms names files that exist; each mutant made by hand changes one line that exists."""

from __future__ import annotations

import ast
from pathlib import Path

from tools.mutants_by_hand import KINDS, hand_made
from tools.tiers import ROOMS

ROOT = Path(__file__).parents[1]


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
