# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The table of tiers and rooms names what is there; each mutant made by hand changes one line that is there."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from test.conftest import COLLECTED
from tools.mutants_by_hand import KINDS, hand_made
from tools.tiers import QUICK_ENTRIES, ROOMS, SLOW_ENTRIES, chooses, entries_of, tier_of

ROOT = Path(__file__).parents[1]


def test_each_lies_in_a_room_whose_tests_should_notice() -> None:
    rooms = [path for room in ROOMS.values() for path in room.code]
    for m in hand_made():
        assert any(m.file == path or m.file.startswith(f'{path}/') for path in rooms), m.file
    for room in ROOMS.values():
        for path in (*room.code, *room.leave):
            assert (ROOT / path).exists(), path


def test_each_entry_of_the_table_chooses_tests(request: pytest.FixtureRequest) -> None:
    tests = request.config.stash[COLLECTED]
    files = {name.partition('::')[0] for name in tests}
    for entry in {*QUICK_ENTRIES, *SLOW_ENTRIES}:
        path = entry.partition(' ')[0]
        assert (ROOT / path).exists(), entry
        folder = {str(f.relative_to(ROOT)) for f in (ROOT / path).rglob('test_*.py')}
        # A run of some files has not seen the others.
        if (folder or {path}) <= files:
            own = {tier_of(name, marked) for name, marked in tests.items() if chooses(entry, name)}
            assert own >= ({'quick'} if entry in QUICK_ENTRIES else set()), entry
            assert own, entry


def test_a_test_is_slow_unless_a_room_counts_on_it() -> None:
    assert tier_of('test/blind/test_day.py::test_a_day[3]', False) == 'slow'
    assert tier_of('test/measure/test_timing.py::test_a_jump', False) == 'quick'
    assert tier_of('test/measure/test_timing.py::test_a_jump', True) == 'slow'
    # Slow for the room plate, counted on by the room solvers.
    assert tier_of('test/model/solvers/test_truth.py::test_it', False) == 'quick'
    assert chooses('test/a.py -k not (this or That) and other', 'test/a.py::test_OTHER')
    assert not chooses('test/a.py -k not (this or That) and other', 'test/a.py::test_other[that]')
    assert not chooses('test/a', 'test/ab.py::test_it')
    with pytest.raises(ValueError, match='words, and, or, not'):
        chooses('test/a.py -k 1', 'test/a.py::test_it')
    assert entries_of('measure') == ('test/measure',)
    assert entries_of('averaging') == ('test/averaging', *ROOMS['averaging'].tests)


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
