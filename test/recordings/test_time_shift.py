# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The time between two PSDs from their motion alone, and two loggers' tables joined by it."""

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.base.errors import RecordingError
from psd_deflection.cli.main import main
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.read.csv_reader import CsvRecording
from psd_deflection.recordings.time_shift import AT_REST, REPEATS, TimeShift, time_shift
from psd_deflection.recordings.two_loggers import JoinedTables, join
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig

STEPS = 'steps:0,0,0;0,-10,0;0,-10,-5.85;0,0,0;12,0,0;0,0,4;0,0,0;0,-20,-11.7;0,0,0:2'
AXES = {
    'as named': ((3, 1), (4, 1)),
    'exchanged': ((4, 1), (3, 1)),
    'rotated': ((4, -1), (3, 1)),
    'dead': ((5, 1), (5, 1)),
}


@cache
def volts(words: str = STEPS) -> FloatArray:
    """(n, 6), V, at 1 kHz."""
    rig = load_rig()
    counts = RigSimulator(rig, 3).step(loads.load_histories([words], 1000.0).loads).counts
    return counts * rig.converter.volts_per_count


def shift_of(table: FloatArray, rows: int = 0, axes: str = 'as named', stated: float = 0.0) -> TimeShift:
    """Of PSD 2, read so many ``rows`` late."""
    second = np.column_stack([sign * table[:, column] for column, sign in AXES[axes]])
    late = slice(max(rows, 0), len(table) + min(rows, 0))
    return time_shift(table[late, :2], second[max(-rows, 0) : len(table) - max(rows, 0)], 1e-3, 4.0, stated)


@pytest.mark.parametrize('axes', ['as named', 'exchanged', 'rotated'])
@pytest.mark.parametrize('rows', [0, 1, 8, 40, 1000, 3000])
def test_the_shift_is_found_of_either_sign(rows: int, axes: str) -> None:
    for k in (rows, -rows):
        found = shift_of(volts(), k, axes)
        assert not found.unknown
        assert found.sd < 3e-5
        assert abs(found.seconds - 1e-3 * k) < 3.0 * found.sd
        assert (found.evidence > 0.0) == (k != 0)
        assert shift_of(volts(), k, axes, stated=1e-3 * k).evidence == 0.0


def test_lost_samples_and_spikes_leave_the_shift() -> None:
    table = volts().copy()
    rng = np.random.default_rng(0)
    table[rng.random(len(table)) < 0.1] = np.nan
    table[6000:7000, 3:] = np.nan
    table[rng.integers(0, len(table), 10), 4] = 9.0
    found = shift_of(table, -40)
    assert found.evidence > 0.0
    assert abs(found.seconds + 0.04) < 3.0 * found.sd


@pytest.mark.parametrize(
    ('words', 'axes', 'why'),
    [
        ('constant:0,0,0:20', 'as named', AT_REST),
        ('constant:0,-10,-5.85:20', 'as named', AT_REST),
        (STEPS, 'dead', AT_REST),
        ('steps:0,0,0;0,-10,0;0,0,0;0,-10,0;0,0,0;0,-10,0;0,0,0;0,-10,0;0,0,0:1', 'as named', REPEATS),
        ('chirp:0,5,0,1.3,1.3:20', 'as named', REPEATS),
    ],
)
def test_motion_that_does_not_tell_gives_a_reason(words: str, axes: str, why: str) -> None:
    for rows in (0, 40, -1000):
        assert shift_of(volts(words), rows, axes).unknown == why


def written(path: Path, rows: Sequence[int], columns: slice, names: str, clock: float = 0.0, rate: float = 1.0) -> Path:
    """The table of a logger that reads ``columns`` at ``rows``, by a clock that shows ``clock`` then more."""
    lines = [f't,{names}', *(f'{clock + 1e-3 * k * rate:.6f},' + ','.join(map(str, volts()[k, columns])) for k in rows)]
    path.write_text('\n'.join(lines) + '\n')
    return path


def loggers(
    folder: Path, *, every: int = 10, late: int = 1730, clock: float = 0.0, rate: float = 1.0
) -> tuple[Path, Path]:
    """The first begins at once, the second ``late`` ms later, each with 10 ms and some jitter between readings."""
    rng = np.random.default_rng(1)
    first = np.arange(5, 18000, 10) + rng.integers(-1, 2, 1800)
    second = np.arange(late, 18000, every)
    second = second + rng.integers(-1, 2, len(second)) * (every > 2)
    names = ('x1,y1,sum1', 'x2,y2,sum2')
    return (
        written(folder / 'a.csv', first.tolist(), slice(0, 3), names[0]),
        written(folder / 'b.csv', second.tolist(), slice(3, 6), names[1], clock - 1e-3 * late, rate),
    )


def readings(joined: JoinedTables) -> FloatArray:
    """(n, 7): the time on the first clock, s, and the volts."""
    (chunk,) = joined.recording._chunks()  # noqa: SLF001 - all at once
    return np.column_stack((1e-9 * chunk.t_ns, chunk.readings))


@pytest.mark.parametrize(('every', 'clock'), [(10, 0.0), (10, 7.3), (25, 0.0), (2, 1.7e9)])
def test_two_loggers_become_one_without_an_invented_sample(tmp_path: Path, every: int, clock: float) -> None:
    first, second = loggers(tmp_path, every=every, clock=1.73 + clock)
    joined = join(first, second)
    assert abs(joined.offset.seconds - clock) < 4.0 * joined.offset.sd < 2e-3
    found, ours, theirs = readings(joined), *(CsvRecording(p, part=True).samples for p in (first, second))
    assert len(found) + joined.lost == len(theirs if every > 10 else ours[ours['t_ns'] >= 1e9 * found[0, 0]])
    # Each is a reading of both tables, none is there twice.
    for table, columns in ((ours, slice(1, 4)), (theirs, slice(4, 7))):
        rows = {tuple(row) for row in np.array(table[['x1', 'y1', 'sum1']].tolist(), np.float32).tolist()}
        assert {tuple(row) for row in found[:, columns].astype(np.float32).tolist()} <= rows


def test_clocks_of_different_rates_are_told_and_put_right(tmp_path: Path) -> None:
    first, second = loggers(tmp_path, every=2, clock=1.73, rate=1.0 + 4e-4)
    offset = join(first, second).offset
    assert abs(offset.rate - 4e-4) < 4.0 * offset.rate_sd < 1e-4
