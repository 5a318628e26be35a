# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Cells against the rows that they are made of, through wraps, gaps and clocks that are set."""

import base64
import dataclasses
import json
import math
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from psd_deflection.records import BlockStatus
from psd_deflection.run.monitor import history
from psd_deflection.run.monitor.feed import BlockResult
from psd_deflection.run.monitor.history import LEVELS, AskedError, History, Window, asked

from .serving import START_NS, estimate_of, spots_of

SMALL = ((1, 150), (10, 9), (60, 3))
SECOND = 1_000_000_000
SIZE = 20


def row(t_ns: int, dx: float | None, total: float = 5.0, lost: int = 0, gone: int = 0) -> BlockResult:
    """A block at ``t_ns`` whose dX is ``dx`` (None: it has no estimate), and whose first sum is ``total``."""
    status = BlockStatus.OK if dx is not None else BlockStatus.LASER_LOST
    spots = dataclasses.replace(spots_of(0, status=status, lost=lost), t_ns=t_ns, sums=(total, 5.0))
    return BlockResult(spots, estimate_of(0)._replace(t_ns=t_ns, dx=dx) if dx is not None else None, gone)


def filled(rows: Iterable[BlockResult], levels: tuple[tuple[int, int], ...] = LEVELS) -> History:
    made = History(2, SIZE, levels)
    for result in rows:
        made.add(result)
    return made


def window(made: History, since: float, until: float, points: int = 2000) -> Window:
    """From ``since`` to ``until``, s after START_NS."""
    return made.window(history.Asked(START_NS + round(since * SECOND), START_NS + round(until * SECOND), points))


finite = st.floats(-1e-2, 1e-2)
steps = st.one_of(st.integers(1, SECOND), st.integers(SECOND, 100 * SECOND), st.integers(-10 * SECOND, 0))
blocks = st.lists(
    st.tuples(steps, st.none() | finite, finite | st.just(math.nan), st.integers(0, SIZE), st.integers(0, 3)),
    min_size=1,
    max_size=60,
)


class Plain:
    """The same with every row kept: which rows each level still has."""

    def __init__(self) -> None:
        self.rows: list[BlockResult] = []
        self.slots: list[dict[int, int]] = [{} for _ in SMALL]
        self.second = -(10**18)

    def add(self, result: BlockResult) -> None:
        second = result.spots.t_ns // SECOND
        if second < self.second:
            self.rows = [r for r in self.rows if r.spots.t_ns // SECOND < second]
            for (width, length), slots in zip(SMALL, self.slots, strict=True):
                present = {r.spots.t_ns // SECOND // width for r in self.rows}
                for slot, key in list(slots.items()):
                    if key >= second // width:
                        del slots[slot]
                if (key := second // width) in present:
                    slots[key % length] = key
        self.second = second
        self.rows.append(result)
        for (width, length), slots in zip(SMALL, self.slots, strict=True):
            slots[second // width % length] = second // width

    def between(self, width_ns: int, since_ns: int, until_ns: int) -> list[BlockResult]:
        """The rows of [since, until) that the level has on which cells of ``width_ns`` are built."""
        level = max(i for i, (width, _) in enumerate(SMALL) if width_ns % (width * SECOND) == 0 and self.of[i])
        width = SMALL[level][0] * SECOND
        keys = set(self.slots[level].values())
        newest = max(keys)
        return [
            r
            for r in self.rows
            if since_ns <= r.spots.t_ns < until_ns
            and r.spots.t_ns // width in keys
            and r.spots.t_ns // width > newest - SMALL[level][1]
        ]

    of = (True, True, True)


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(blocks, st.integers(0, 3), st.integers(1, 400), st.integers(10, 200))
@example([(k, None, 0.0, 0, 0) for k in (1, 50 * SECOND, 145 * SECOND, 87 * SECOND)], 3, 73, 10)
def test_cells_are_what_the_rows_say(
    drawn: list[tuple[int, float | None, float, int, int]], past: int, span: int, points: int
) -> None:
    made, plain = History(2, SIZE, SMALL), Plain()
    t_ns = START_NS
    for step, dx, total, lost, gone in drawn:
        t_ns += step
        for keeper in (made, plain):
            keeper.add(row(t_ns, dx, total, lost, gone))
    until_ns = t_ns + SECOND - past * 37 * SECOND
    wanted = history.Asked(until_ns - span * SECOND, until_ns, points)
    view = made.window(wanted)
    # Which level it was taken from is the finest that reaches back and is not finer than needed.
    level = next(
        i for i, ring in enumerate(made.rings) if ring is made.ring_for(wanted.from_ns, span * SECOND // points)
    )
    plain.of = tuple(i == level for i in range(3))  # type: ignore[assignment]
    width = view.width_ns
    assert width % (SMALL[level][0] * SECOND) == 0
    assert len(view.columns['dx']) <= points + 1
    first, last = wanted.from_ns // width * width, -(-wanted.to_ns // width) * width
    inside = plain.between(width, first, last)
    assert sum(view.columns['blocks']) == len(inside)
    for k in range(len(view.columns['dx'])):
        start = view.start_ns + k * width
        here = [r for r in inside if start <= r.spots.t_ns < start + width]
        dxs = [r.estimate.dx for r in here if r.estimate is not None]
        sums = [r.spots.sums[0] for r in here if not math.isnan(r.spots.sums[0])]
        for name, values in (('dx', dxs), ('sum1', sums)):
            mean, low, high = (view.columns[name + end][k] for end in ('', '_low', '_high'))
            if not values:
                assert np.isnan([mean, low, high]).all()
                continue
            assert mean == pytest.approx(math.fsum(values) / len(values), rel=1e-12, abs=1e-15)
            assert (low, high) == (np.float32(min(values)), np.float32(max(values)))
        assert (view.columns['blocks'][k], view.columns['estimates'][k]) == (len(here), len(dxs))
        assert view.columns['lost'][k] == sum(r.spots.lost + SIZE * r.gone for r in here)


def test_old_times_are_asked_of_the_level_that_still_has_them() -> None:
    made = filled((row(START_NS + s * SECOND, s * 1e-6) for s in range(400)), SMALL)
    assert window(made, 300, 400).width_ns == SECOND
    # The seconds reach back 150 s, the cells of ten 90 s, those of a minute three minutes.
    assert (window(made, 235, 245).width_ns, len(window(made, 0, 100).columns['dx'])) == (60 * SECOND, 0)


def test_a_clock_that_is_set_back_leaves_what_lies_before() -> None:
    made = filled(row(START_NS + s * SECOND, 1e-3) for s in range(200))
    for s in (10, 150, 190):
        made.mark(START_NS + s * SECOND, f'[{s}]')
    made.unsaved()
    made.add(row(START_NS + 125 * SECOND, 2e-3))
    # The file has the marks that are forgotten.
    assert made.unsaved().marks == [(START_NS + 10 * SECOND, '[10]')]
    for level in (200, 20, 4):
        view = window(made, 0, 200, level)
        assert (view.columns['blocks'].sum(), np.nanmax(view.columns['dx_high'])) == (126, np.float32(2e-3))
    assert json.loads(made.answer(history.Asked(START_NS, START_NS + 200 * SECOND, 100)))['marks'] == [[10]]


def test_a_clock_that_is_far_off_for_a_moment_does_no_harm() -> None:
    made = filled(row(START_NS + s * SECOND, 1e-3) for s in range(20))
    for t_ns in (2**63 - 1, -(2**63), START_NS + 20 * SECOND):
        made.add(row(t_ns, 1e-3))
    assert window(made, 0, 30).columns['blocks'].sum() == 1


def test_constant_time_and_huge_losses_take_no_room() -> None:
    made = filled(row(START_NS, 1e-3, gone=2**60) for _ in range(5000))
    assert sum(map(len, made._values)) <= 5 * history.MOST_BLOCKS
    view = window(made, 0, 1)
    assert view.columns['blocks'].tolist() == [5000]
    assert 0 < view.columns['lost'][0] <= 5 * history.MOST_LOST


def test_a_gap_has_no_value_and_loses_nothing() -> None:
    made = filled(row(START_NS + s * SECOND, 1e-3, lost=1) for s in (*range(10), *range(70, 80)))
    view = window(made, 0, 80).columns
    there = np.repeat([1.0, 0.0, 1.0], [10, 60, 10])
    np.testing.assert_array_equal(np.isfinite(view['dx']), there > 0.0)
    for name in ('blocks', 'estimates', 'lost'):
        np.testing.assert_array_equal(view[name], there)
    # In cells wider than the gap it is not seen, but their count of blocks tells it.
    assert window(made, 0, 80, 1).columns['blocks'].tolist() == [10, 10]


def test_memory_is_taken_once_and_marks_are_bounded() -> None:
    made = filled([])
    before = made.bytes
    assert before < 20e6
    # A day, three days, a week and an hour.
    assert [ring.length * ring.width_ns / (3600 * SECOND) for ring in made.rings] == [24.0, 72.0, 169.0]
    for k in range(history.MOST_MARKS + 700):
        made.add(row(START_NS + k * 97 * SECOND, 1e-3))
        made.mark(START_NS + k, f'[{k}]')
    assert made.bytes == before
    content = json.loads(made.answer(history.Asked(START_NS, START_NS + SECOND, 100)))
    assert (content['marks'][-1], len(content['marks'])) == ([history.MOST_MARKS + 699], history.SENT_MARKS)
    assert content['marks_left_out'] == 2000 - history.SENT_MARKS


@pytest.mark.slow
def test_a_week_is_answered_in_the_cells_that_were_asked_for() -> None:
    made = filled(row(START_NS + s * SECOND, 1e-6 * s) for s in range(0, 8 * 86_400, 30))
    for span, points, width in ((7 * 86_400, 2000, 360), (86_400, 1000, 120), (3600, 700, 6), (600, 700, 1)):
        view = window(made, 8 * 86_400 - span, 8 * 86_400, points)
        assert view.width_ns == width * SECOND
        assert len(view.columns['dx']) <= points + 1
        assert view.columns['blocks'].sum() == pytest.approx(span / 30, abs=width / 30 + 1)


def test_an_answer_has_times_in_seconds_and_floats_in_base64() -> None:
    made = filled([row(START_NS, 1e-3), row(START_NS + 2 * SECOND, None)])
    content = json.loads(made.answer(history.Asked(START_NS, START_NS + 3 * SECOND, 100)))
    assert (content['start'], content['width']) == (START_NS / 1e9, 1.0)
    dx = np.frombuffer(base64.b64decode(content['columns']['dx']), '<f4')
    assert dx[0] == np.float32(1e-3)
    assert np.isnan(dx[1:]).all()
    assert np.frombuffer(base64.b64decode(content['columns']['estimates']), '<f4').tolist() == [1, 0, 0]


@pytest.mark.parametrize(
    ('query', 'words'),
    [
        ({}, 'from is missing: must be a time'),
        ({'from': '1'}, 'to is missing'),
        ({'from': 'noon', 'to': '2'}, "from = 'noon'"),
        ({'from': '1_0', 'to': '20'}, "from = '1_0'"),
        ({'from': '1', 'to': 'nan'}, "to = 'nan'"),
        ({'from': '1', 'to': 'inf'}, "to = 'inf'"),
        ({'from': '1', 'to': '1e10'}, 'at most 9e\\+09'),
        ({'from': '2', 'to': '2'}, 'from = 2: must be before to = 2'),
        ({'from': '1', 'to': '2', 'points': '9'}, "points = '9': must be a whole number from 10 to 2000"),
        ({'from': '1', 'to': '2', 'points': '2001'}, 'points'),
        ({'from': '1', 'to': '2', 'points': '1e3'}, 'points'),
        ({'from': '1', 'to': '2', 'points': '٣٠٠'}, 'points'),
        ({'from': '1', 'to': '2', 'points': '9' * 5000}, 'points'),
        ({'from': '1', 'to': '2', 'until': '3'}, "'until' is no parameter"),
    ],
)
def test_what_cannot_be_asked_for_is_named(query: dict[str, str], words: str) -> None:
    with pytest.raises(AskedError, match=words):
        asked(query)


def test_the_window_of_a_request() -> None:
    assert asked({'from': '1.5', 'to': '2e0', 'points': '10'}) == (1_500_000_000, 2_000_000_000, 10)
    assert asked({'from': '-1', 'to': '2'}).points == 1000


def test_all_time_may_be_asked_for() -> None:
    made = filled(row(START_NS + s * SECOND, 1e-3) for s in range(200))
    view = made.window(asked({'from': '-9e9', 'to': '9e9', 'points': '2000'}))
    assert (view.columns['blocks'].tolist(), view.width_ns) == ([200], 9_000_000 * SECOND)


def test_outdated_cell_does_not_replace_newer_cell() -> None:
    """Cells 1 and 4 of a ring of three share a place, in which an old one still lies."""
    ring = history.Ring(1, 3, history.cell_kind(3))
    cells = np.full(2, history.empty_cell(history.cell_kind(3)), history.cell_kind(3))
    cells['key'] = (1, 4)
    cells['blocks'] = (1, 2)
    ring.put(cells[:1].copy())
    ring.put(cells.copy())
    assert ring.cells['key'].tolist().count(4) == 1
    assert 1 not in ring.cells['key']
    assert int(ring.between(4, 5)['blocks'][0]) == 2


def test_marks_are_unsaved_at_first_and_after_new_ones() -> None:
    made = History(2, SIZE, SMALL)
    # None yet: the file may have some of a run before.
    assert made.unsaved().marks == []
    assert made.unsaved().marks is None
    made.mark(START_NS, '"bumped"')
    assert made.unsaved().marks == [(START_NS, '"bumped"')]
    assert made.unsaved().marks is None
    assert made.unsaved(0).marks == [(START_NS, '"bumped"')]
