# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The time between two PSDs from their motion alone, and two loggers' tables joined by it."""

import json
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
from psd_deflection.recordings.two_loggers import ClockOffset, along, join
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.rig.config import load_rig

STEPS = 'steps:0,0,0;0,-10,0;0,-10,-5.85;0,0,0;12,0,0;0,0,4;0,0,0;0,-20,-11.7;0,0,0:2'
PUSHES = (STEPS, 'steps:0,0,0;3,-10,0:1.3', 'steps:0,0,0;5,5,0:2.1', 'steps:0,0,0:1')
ROTATED, DEAD = np.array([[0, 1, 0], [-1, 0, 0]]), np.array([[0, 0, 1], [0, 0, 1]])
"""Which of x, y and sum are read as x and y."""


@cache
def volts(*words: str) -> FloatArray:
    """(n, 6), V, at 1 kHz."""
    rig = load_rig()
    counts = RigSimulator(rig, 3).step(loads.load_histories(words, 1000.0).loads).counts
    return np.asarray(counts * rig.converter.volts_per_count, np.float64)


def shift_of(table: FloatArray, rows: int, axes: IntArray = ROTATED, stated: float = 0.0) -> TimeShift:
    """Of PSD 2, read so many ``rows`` late."""
    second = table[:, 3:] @ axes.T
    late = slice(max(rows, 0), len(table) + min(rows, 0))
    return time_shift(table[late, :2], second[max(-rows, 0) : len(table) - max(rows, 0)], 1e-3, 4.0, stated)


@pytest.mark.parametrize('rows', [0, 1, 8, 40, 1000, 3000, -1, -8, -40, -1000, -3000])
def test_the_shift_is_found_of_either_sign(rows: int) -> None:
    shift = shift_of(volts(STEPS), rows)
    assert not shift.unknown
    assert abs(shift.seconds - 1e-3 * rows) < 3.0 * shift.sd < 1e-4
    assert (shift.evidence > 0.0) == (rows != 0)
    assert shift_of(volts(STEPS), rows, stated=1e-3 * rows).evidence == 0.0


def test_lost_samples_and_spikes_leave_the_shift() -> None:
    table = volts(STEPS).copy()
    rng = np.random.default_rng(0)
    table[rng.random(len(table)) < 0.1] = np.nan
    table[6000:7000, 3:] = np.nan
    table[rng.integers(0, len(table), 10), 4] = 9.0
    shift = shift_of(table, -40)
    assert shift.evidence > 0.0
    assert abs(shift.seconds + 0.04) < 3.0 * shift.sd


@pytest.mark.parametrize(
    ('words', 'axes', 'why'),
    [
        ('constant:0,0,0:20', ROTATED, AT_REST),
        ('constant:0,-10,-5.85:20', ROTATED, AT_REST),
        (STEPS, DEAD, AT_REST),
        ('steps:0,0,0;0,-10,0;0,0,0;0,-10,0;0,0,0;0,-10,0;0,0,0;0,-10,0;0,0,0:1', ROTATED, REPEATS),
        ('chirp:0,5,0:1.3,1.3:20', ROTATED, REPEATS),
    ],
)
def test_motion_that_does_not_tell_gives_a_reason(words: str, axes: IntArray, why: str) -> None:
    for rows in (0, 40, -1000):
        assert shift_of(volts(words), rows, axes).unknown == why


def write_table(path: Path, t: FloatArray, rows: IntArray, psd: int) -> Path:
    """What a logger of one PSD writes: its readings at ``rows``, at the times ``t`` of its clock."""
    table = volts(*PUSHES)[rows, 3 * psd - 3 : 3 * psd]
    lines = (f'{when:.6f},{x},{y},{light}' for when, (x, y, light) in zip(t.tolist(), table.tolist(), strict=True))
    path.write_text('\n'.join((f't,x{psd},y{psd},sum{psd}', *lines)) + '\n')
    return path


def loggers(folder: Path, every: int, offset: float, rate: float = 0.0) -> tuple[Path, Path]:
    """Tables of PSD 1, every 10 ms, and PSD 2, begun 1.73 s later, every so many ms by a clock that shows more."""
    rng = np.random.default_rng(1)
    rows = [np.arange(first, len(volts(*PUSHES)) - 2, step) for first, step in ((5, 10), (1730, every))]
    rows = [r + rng.integers(-1, 2, len(r)) * (every > 2) for r in rows]
    first, second = (1e-3 * r.astype(np.float64) for r in rows)
    second = offset + (1.0 + rate) * second
    return write_table(folder / '1.csv', first, rows[0], 1), write_table(folder / '2.csv', second, rows[1], 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('every', 'offset', 'rate'), [(10, -1.73, 0.0), (10, 7.3, 0.0), (20, 0.0, 0.0), (2, 1.7e9, 0.0), (2, 0.0, 4e-4)]
)
def test_each_joined_sample_is_a_reading_of_both(tmp_path: Path, every: int, offset: float, rate: float) -> None:
    tables = loggers(tmp_path, every, offset, rate)
    joined = join(*tables)
    clock = joined.offset
    assert abs(clock.seconds - offset - rate * clock.at) < 4.0 * clock.sd < 2e-3
    assert clock.rate == rate == 0.0 or abs(clock.rate - rate) < 4.0 * clock.rate_sd < 1e-4
    samples = joined.recording.samples
    assert len(samples) == pytest.approx((len(volts(*PUSHES)) - 1730) / max(every, 10), abs=joined.lost + 2)
    assert joined.lost < 0.01 * len(samples)
    for table, names in zip(tables, (['x1', 'y1', 'sum1'], ['x2', 'y2', 'sum2']), strict=True):
        rows = {tuple(row) for b in CsvRecording(table, part=True).blocks() for row in b.volts.tolist()}
        assert {tuple(row) for row in samples[names].tolist()} <= rows


@pytest.mark.parametrize(('before', 'lost'), [(0.007, 0), (0.008, 1)])
def test_a_reading_three_quarters_of_a_period_away_is_lost(tmp_path: Path, before: float, lost: int) -> None:
    """Both loggers lack a reading, the second that nearest to what the first one then has."""
    rows, t = np.arange(200), 0.01 * np.arange(200)
    ours = write_table(tmp_path / '1.csv', np.delete(t, 99), np.delete(rows, 99), 1)
    theirs = write_table(tmp_path / '2.csv', np.delete(t + 0.01 - before, 100), np.delete(rows, 100), 2)
    assert join(ours, theirs, 0.0).lost == lost


@pytest.mark.parametrize(('size', 'scatter'), [(3.0, 9.0 * 8.0 / 6.0), (0.3, 1.0)])
def test_the_line_of_a_clock_is_as_sure_as_its_scatter_at_most(size: float, scatter: float) -> None:
    """Eight offsets about a line leave six degrees of freedom; their places scatter by 42 about the middle."""
    off = 1e-3 * size * np.resize([1.0, -1.0, -1.0, 1.0], 8)
    clock = along(ClockOffset(0.0, 0.0), np.arange(8.0), 5e-3 * np.arange(8.0) + off, np.full(8, 1e-3))
    assert (clock.at, clock.seconds, clock.rate) == pytest.approx((3.5, 17.5e-3, 5e-3))
    assert (clock.sd, clock.rate_sd) == pytest.approx((1e-3 * (scatter / 8.0) ** 0.5, 1e-3 * (scatter / 42.0) ** 0.5))


@pytest.mark.parametrize('ppm', [0, 40, 100, -200])
@pytest.mark.parametrize('second', ['5,0,0;0,-8,0;0,0,1;-6,3,0;2,-12,0.5', '20,0,0;0,-20,0;0,0,2;10,-10,0;5,5,1'])
def test_six_unlike_loads_tell_offset_and_rate(tmp_path: Path, second: str, ppm: int) -> None:
    """A step every 3 s: the halves of such a motion look alike to one combination of the readings, not to both."""
    table, rows = volts(f'steps:0,0,0;{second};0,0,0:3'), np.arange(2000, 18000)
    t = np.arange(len(table)) * 1e-3
    paths = []
    for psd, times, of in ((1, t, table), (2, 1.3 + (1.0 + 1e-6 * ppm) * t[rows], table[rows])):
        readings = of[:, 3 * psd - 3 : 3 * psd]
        lines = [f'{a:.6f},{x},{y},{light}' for a, (x, y, light) in zip(times, readings, strict=True)]
        paths.append(tmp_path / f'{psd}.csv')
        paths[-1].write_text('\n'.join([f't,x{psd},y{psd},sum{psd}', *lines]))
    clock = join(paths[0], paths[1]).offset
    when = t[rows].astype(np.float64)
    assert abs(clock.on_second(when) - 1.3 - (1.0 + 1e-6 * ppm) * when).max() < 5e-5


def test_convert_joins_two_loggers_and_says_how(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = map(str, loggers(tmp_path, 10, -1.73))
    assert main(['convert', first, second, '--out', str(tmp_path / 'run.csv')]) == 0
    printed = capsys.readouterr().out
    assert '2.csv: its clock shows 1.7' in printed
    assert 'less than that of' in printed
    assert main(['convert', first, second, '--offset', '-1.73', '--out', str(tmp_path / 'bag'), '--json']) == 0
    clocks = json.loads(capsys.readouterr().out)['clocks']
    assert (clocks['given'], clocks['offset'], clocks['rate_sd']) == (True, -1.73, None)


def test_two_loggers_that_cannot_be_joined_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = loggers(tmp_path, 10, 0.0)
    rest = np.arange(3000)
    still = write_table(tmp_path / 'still.csv', np.linspace(0.0, 30.0, 3000), rest % 2, 2)
    with pytest.raises(RecordingError, match=f'{AT_REST}.*two directions.*--offset'):
        join(first, still)
    with pytest.raises(RecordingError, match='have x, y and sum of each PSD once'):
        join(first, first)
    with pytest.raises(RecordingError, match='clocks are further apart'):
        join(first, second, 1000.0)
    for words, why in (
        ((str(first), '--offset', '1'), '--offset is for the .csv of two loggers'),
        ((str(first), str(second), str(first)), 'one recording is converted'),
        ((str(first),), 'joins the parts of two loggers'),
    ):
        assert main(['convert', *words, '--out', str(tmp_path / 'out.csv')]) in (2, 4)
        assert why in capsys.readouterr().err
