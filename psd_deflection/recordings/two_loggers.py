# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Two tables of two loggers, each with some of the PSDs and a clock of its own, become one recording.

The time between the clocks is found from the motion. Every sample of the recording is a reading of each table: those
of the slower table, each with the nearest of the other within 3/4 of its period. Where there is none, the sample is
lost.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.in_memory import RecordingInMemory
from psd_deflection.recordings.read.csv_reader import CsvRecording
from psd_deflection.recordings.time_shift import REPEATS, TimeShift, time_shift
from psd_deflection.records import FloatArray, IntArray, RawChunk, channel_names

STRETCH_S, REACHES_S = 60.0, (2.0, 5.0, 20.0)
"""The motion of so long a part tells the time between the clocks, s: beside the starts, up to one of these, and a third
of the part."""
PIECE_S, MOST_PIECES, TURNS = 10.0, 16, 5
"""Pieces of at least this length, at most so many, tell the difference of the clocks' rates, in so many turns."""
NEAR_S = 0.2
"""Shifts within which a found one is looked for again, s."""
CLEARLY = 4.0
"""Factor by which one time between the clocks must leave less unshared than another, far from it."""
DRIFT = 5e-4
"""Largest difference of the rates of two clocks."""
SURE = 3.0
"""Standard deviations by which the rates differ, or they are taken as equal."""
WITHIN = 0.75
"""Share of the faster table's period by which the readings of a sample may be apart: half, and jitter."""
SLOWER = 1.1
"""Factor of its period by which the second table is slower than the first, so that its samples are kept."""


class ClockOffset(NamedTuple):
    """What the second clock shows more than the first: ``seconds`` ± ``sd`` when the first shows ``at`` s.

    ``rate`` ± ``rate_sd``: by how much it gains each second; 0 if that is not certain. ``rate_sd`` is infinite if the
    motion does not tell. ``given``: the offset was not found but given.
    """

    seconds: float
    sd: float
    at: float = 0.0
    rate: float = 0.0
    rate_sd: float = math.inf
    given: bool = False

    def on_second(self, t: FloatArray) -> FloatArray:
        """Times of the second clock, s, at times ``t`` of the first."""
        return t + self.seconds + self.rate * (t - self.at)

    def on_first(self, t: FloatArray) -> FloatArray:
        """Times of the first clock, s, at times ``t`` of the second."""
        return (t - self.seconds + self.rate * self.at) / (1.0 + self.rate)


class LoggerTable(NamedTuple):
    """``seq``, ``t_ns`` (n,); ``t`` (n,): s; ``volts`` (n, 3k) of the k PSDs whose ``channels`` it has."""

    seq: IntArray
    t_ns: IntArray
    t: FloatArray
    volts: FloatArray
    channels: tuple[str, ...]

    @classmethod
    def of(cls, recording: CsvRecording) -> LoggerTable:
        """Read one."""
        blocks = list(recording.blocks())
        t_ns = np.concatenate([b.t_ns for b in blocks])
        volts = np.concatenate([b.volts for b in blocks]).astype(np.float64)
        return cls(np.concatenate([b.seq for b in blocks]), t_ns, t_ns * 1e-9, volts, recording.channels)

    @property
    def period(self) -> float:
        """s between samples."""
        return float(np.median(np.diff(self.t)))

    def at(self, grid: FloatArray) -> FloatArray:
        """Dots (m, 2k), V, at times between two samples, only to compare them; NaN where no two are near."""
        dots = [i for i in range(self.volts.shape[1]) if i % 3 < 2]
        after = np.clip(np.searchsorted(self.t, grid), 1, len(self.t) - 1)
        valid = (self.t[after] - self.t[after - 1] < 2.0 * self.period) & (grid >= self.t[0]) & (grid <= self.t[-1])
        values = np.column_stack([np.interp(grid, self.t, self.volts[:, i]) for i in dots])
        return np.where(valid[:, None], values, np.nan)


class JoinedTables(NamedTuple):
    """``recording``: on the first clock, of the tables ``first`` and ``second``. ``offset``: of the second clock.

    ``lost``: samples of the slower table without a reading of the other, while both record. ``apart``: rms of the time
    between the two readings of a sample, s; ``most``: the largest that is accepted, s.
    """

    recording: RecordingInMemory
    first: str
    second: str
    offset: ClockOffset
    lost: int
    apart: float
    most: float

    def sentences(self) -> list[str]:
        """What was found of the clocks, and how the samples were put together."""
        o, way = self.offset, 'more' if self.offset.seconds > 0.0 else 'less'
        rates = 'whether their rates differ is unknown: push near the beginning and near the end'
        if o.rate:
            rates = f'it gains {1e6 * o.rate:.1f} ± {1e6 * o.rate_sd:.1f} µs a second, which is put right'
        elif math.isfinite(o.rate_sd):
            rates = f'their rates agree within {SURE * 1e6 * o.rate_sd:.0f} µs a second'
        precision = 'as given' if o.given else f'± {o.sd:.5f} s at {o.at:.1f} s, by the motion; {rates}'
        return [
            f'{self.second}: its clock shows {abs(o.seconds):.5f} s {way} than that of {self.first}, {precision}',
            f'each sample is a reading of both, {1e3 * self.apart:.3f} ms apart (rms; {1e3 * self.most:.3f} ms at '
            f'most); {self.lost} are lost, without a reading of the other that is near',
        ]

    def tree(self) -> dict[str, object]:
        """The numbers, in s."""
        o = self.offset
        rate_sd = o.rate_sd if math.isfinite(o.rate_sd) else None
        fields = {'offset': o.seconds, 'offset_sd': o.sd, 'at': o.at, 'rate': o.rate, 'rate_sd': rate_sd}
        return {**fields, 'given': o.given, 'lost': self.lost, 'apart': self.apart, 'most': self.most}


def join(first: str | Path, second: str | Path, offset: float | None = None) -> JoinedTables:
    """Return the tables ``first`` and ``second`` as one recording on the first one's clock.

    ``offset``: what the second clock shows more than the first, s; None: as the motion says. Raises RecordingError
    naming the file if one cannot be read, if they do not have each PSD once, or if the motion does not tell.
    """
    recordings = [CsvRecording(Path(path), part=True) for path in (first, second)]
    ours, theirs = map(LoggerTable.of, recordings)
    names = sorted((*ours.channels, *theirs.channels))
    if names != sorted(channel_names(len(names) // 3)):
        raise RecordingError(
            f'{first} has {", ".join(ours.channels)}, {second} has {", ".join(theirs.channels)}: '
            'together they must have x, y and sum of each PSD once'
        )
    clock = ClockOffset(offset, 0.0, given=True) if offset is not None else _offset(ours, theirs, first, second)
    theirs = theirs._replace(t=clock.on_first(theirs.t))
    slower = theirs if theirs.period > SLOWER * ours.period else ours
    other = ours if slower is theirs else theirs
    at, of = _pairs(slower.t, other.t, WITHIN * other.period)
    if not len(at):
        raise RecordingError(f'{second}: no reading is at the time of one of {first}: their clocks are further apart')
    t_ns = np.rint(1e9 * slower.t[at]).astype(np.int64) if slower is theirs else slower.t_ns[at]
    columns = dict(zip(slower.channels, slower.volts[at].T, strict=True))
    columns |= zip(other.channels, other.volts[of].T, strict=True)
    volts = np.column_stack([columns[c] for c in channel_names(len(names) // 3)]).astype(np.float32)
    samples = RawChunk(slower.seq[at] - slower.seq[at[0]], t_ns, volts, np.zeros(len(at), np.uint8))
    beside = recordings[0]
    return JoinedTables(
        RecordingInMemory(Path(first), None, samples, beside.loads(), beside.references(), beside.temperatures()),
        str(first),
        str(second),
        clock,
        int(at[-1] - at[0]) + 1 - len(at),
        float(np.sqrt(np.mean((slower.t[at] - other.t[of]) ** 2))),
        WITHIN * other.period,
    )


def _pairs(t: FloatArray, other_t: FloatArray, within: float) -> tuple[IntArray, IntArray]:
    """Which of ``t`` (n,) has which of ``other_t`` (m,): the nearest behind the last one taken, ``within`` s of it."""
    after = np.clip(np.searchsorted(other_t, t), 1, len(other_t) - 1)
    nearest = after - (t - other_t[after - 1] <= other_t[after] - t)
    last, taken = -1, []
    for i, (time, j) in enumerate(zip(t.tolist(), nearest.tolist(), strict=True)):
        j = max(j, last + 1)
        if j < len(other_t) and abs(other_t[j] - time) <= within:
            taken.append((i, j))
            last = j
    at, of = np.array(taken, np.int64).reshape(-1, 2).T
    return at, of


def _offset(ours: LoggerTable, theirs: LoggerTable, first: str | Path, second: str | Path) -> ClockOffset:
    # Clocks that count from one beginning show the same, nearly; else the loggers were started together, nearly.
    starts = (ClockOffset(0.0, 0.0), ClockOffset(float(theirs.t[0] - ours.t[0]), 0.0))
    unknown = ''
    for begin in np.arange(ours.t[0], ours.t[-1], STRETCH_S).tolist():
        end = min(begin + STRETCH_S, float(ours.t[-1]))
        # The smaller the reach, the more of the motion is compared.
        tried = [(start, _shift(ours, theirs, begin, end, start, reach)) for start in starts for reach in REACHES_S]
        sure = [f._replace(seconds=start.seconds + f.seconds) for start, f in tried if not f.unknown]
        sure.sort(key=lambda f: f.unshared)
        if sure and (sure[-1].unshared > CLEARLY * sure[0].unshared or np.ptp([f.seconds for f in sure]) < NEAR_S):
            break
        unknown = REPEATS if sure else tried[-1][1].unknown
    else:
        raise RecordingError(
            f'{first}, {second}: {unknown}: this does not tell how far the two clocks are apart. Push the link in '
            'two directions, each time otherwise, while both record; or say what the second clock shows more: '
            '--offset SECONDS'
        )
    clock = ClockOffset(sure[0].seconds, sure[0].sd, 0.5 * (begin + end))
    edges = np.linspace(ours.t[0], ours.t[-1], min(MOST_PIECES, int(np.ptp(ours.t) / PIECE_S)) + 1)
    for _ in range(TURNS):
        pieces = []
        for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            middle = 0.5 * (begin + end)
            piece = _shift(ours, theirs, begin, end, clock, NEAR_S + DRIFT * abs(middle - clock.at), outside=False)
            if not piece.unknown:
                pieces.append((middle, piece.seconds, piece.sd))
        if len(pieces) < 2:
            break
        # The pushes in a piece are not in its middle: only what is left of a rate is found without a bias.
        clock = along(clock, *np.array(pieces).T)
    return clock


def _shift(
    ours: LoggerTable,
    theirs: LoggerTable,
    begin: float,
    end: float,
    clock: ClockOffset,
    reach: float,
    *,
    outside: bool = True,
) -> TimeShift:
    """What the second clock shows more than ``clock`` says, from the motion from ``begin`` to ``end`` of the first.

    ``outside``: as :func:`time_shift` has it.
    """
    grid = np.arange(begin, end, min(ours.period, theirs.period))
    first, second = ours.at(grid), theirs.at(clock.on_second(grid))
    coarse = time_shift(first, second, float(grid[1] - grid[0]), reach, outside=outside)
    if coarse.unknown or reach < NEAR_S:
        return coarse
    # What is left is no part of a sample, which the interpolation would bias.
    nearer = clock._replace(seconds=clock.seconds + coarse.seconds)
    fine = _shift(ours, theirs, begin, end, nearer, 0.99 * NEAR_S, outside=False)
    return fine if fine.unknown else fine._replace(seconds=coarse.seconds + fine.seconds)


def along(clock: ClockOffset, at: FloatArray, more: FloatArray, sd: FloatArray) -> ClockOffset:
    """``clock`` with what it shows ``more`` at some times, as a straight line, or constant if that is as likely."""
    weights = sd**-2.0
    middle = float(weights @ at / weights.sum())
    seconds = clock.seconds + clock.rate * (at - clock.at) + more
    for rates in (1, 0):
        design = np.column_stack((np.ones(len(at)), at - middle))[:, : 1 + rates]
        covariance = np.linalg.inv(design.T @ (weights[:, None] * design))
        values = covariance @ design.T @ (weights * seconds)
        scatter = float(weights @ (seconds - design @ values) ** 2) / max(len(at) - 1 - rates, 1)
        deviations = np.sqrt(np.diag(covariance) * max(scatter, 1.0))
        if rates:
            rate, rate_sd = float(values[1]), float(deviations[1])
            if abs(rate) > SURE * rate_sd:
                return ClockOffset(float(values[0]), float(deviations[0]), middle, rate, rate_sd)
    return ClockOffset(float(values[0]), float(deviations[0]), middle, 0.0, rate_sd)
