# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Load histories: the known load at the tip, sample by sample.

The thesis hangs 10, 30 and 50 N on a sidebar, 0.585 m from the link on its +X side, and on the
link itself (thesis chapter 5). A weight pulls along -Y; on the sidebar it also turns the tip by
Tz = -F * 0.585 m (a weight at +X turns clockwise in (x, y), so theta is negative).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psd_deflection.base.csv_table import CsvTable
from psd_deflection.records import FloatArray

SIDEBAR_ARM = 0.585
"""Place of the weight on the sidebar, m from the link, toward +X."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadHistory:
    """``loads`` (n, 3): Fx N, Fy N, Tz N m at the tip centroid, held from each sample to the next."""

    loads: FloatArray
    sample_rate_hz: float

    def __len__(self) -> int:
        return len(self.loads)

    def then(self, *others: LoadHistory) -> LoadHistory:
        """This history, followed by the others (all at its rate)."""
        return LoadHistory(np.concatenate([self.loads, *(o.loads for o in others)]), self.sample_rate_hz)


def sidebar(force: float) -> tuple[float, float, float]:
    """The load of a weight of ``force`` N on the sidebar."""
    return (0.0, -force, -force * SIDEBAR_ARM)


def direct(force: float) -> tuple[float, float, float]:
    """The load of a weight of ``force`` N on the link itself."""
    return (0.0, -force, 0.0)


def _count(duration: float, rate: float) -> int:
    return max(0, round(duration * rate))


def constant(load: tuple[float, float, float], duration: float, rate: float = 1000.0) -> LoadHistory:
    """One load for ``duration`` s."""
    return LoadHistory(np.tile(np.asarray(load, dtype=np.float64), (_count(duration, rate), 1)), rate)


def steps(levels: list[tuple[float, float, float]], dwell: float, rate: float = 1000.0) -> LoadHistory:
    """Each of ``levels`` for ``dwell`` s."""
    parts = [constant(level, dwell, rate).loads for level in levels]
    return LoadHistory(np.concatenate(parts) if parts else np.empty((0, 3)), rate)


def ramp(
    start: tuple[float, float, float], end: tuple[float, float, float], duration: float, rate: float = 1000.0
) -> LoadHistory:
    """Straight from ``start`` to ``end``."""
    s = np.linspace(0.0, 1.0, _count(duration, rate))[:, None]
    return LoadHistory((1.0 - s) * np.asarray(start) + s * np.asarray(end), rate)


def chirp(
    amplitude: tuple[float, float, float],
    f0: float,
    f1: float,
    duration: float,
    rate: float = 1000.0,
) -> LoadHistory:
    """A sine whose frequency rises steadily from ``f0`` to ``f1`` Hz."""
    t = np.arange(_count(duration, rate)) / rate
    phase = 2.0 * np.pi * (f0 * t + 0.5 * (f1 - f0) * t * t / max(duration, 1e-9))
    return LoadHistory(np.sin(phase)[:, None] * np.asarray(amplitude, dtype=np.float64), rate)


def thesis_load_cases(dwell: float = 4.0, rate: float = 1000.0) -> LoadHistory:
    """0, 10, 30, 50 N on the sidebar, back to 0, the same on the link itself, back to 0."""
    levels = [(0.0, 0.0, 0.0), *(sidebar(f) for f in (10.0, 30.0, 50.0))]
    levels += [(0.0, 0.0, 0.0), *(direct(f) for f in (10.0, 30.0, 50.0)), (0.0, 0.0, 0.0)]
    return steps(levels, dwell, rate)


def identification(rate: float = 1000.0) -> LoadHistory:
    """24 s that excite every effect of the catalogue that one recording can show.

    Steps of weight on the sidebar and on the link, pulls along X, torque both ways, back through
    the same levels (hysteresis), and a chirp through both modes.
    """
    levels = [
        (0.0, 0.0, 0.0),
        sidebar(30.0),
        sidebar(50.0),
        sidebar(10.0),
        (0.0, 0.0, 0.0),
        direct(50.0),
        (30.0, 0.0, 0.0),
        (-20.0, -20.0, 15.0),
        (0.0, 20.0, 25.0),
        (0.0, 0.0, 0.0),
    ]
    swept = chirp((4.0, 4.0, 3.0), 2.0, 30.0, 4.0, rate)
    return steps(levels, 2.0, rate).then(swept)


def from_csv(path: str | Path, rate: float = 1000.0) -> LoadHistory:
    """``t,load_fx,load_fy,load_tz`` of a CSV file, held between rows and cut to ``rate``.

    Raises RecordingError naming file, line and column.
    """
    table = CsvTable(Path(path))
    names = ('t', 'load_fx', 'load_fy', 'load_tz')
    table.require(names, f'a load history has {",".join(names)}')
    times: list[float] = []
    rows: list[list[float]] = []
    for row in table.table_rows():
        numbers = [row.number(name) for name in names]
        if times and numbers[0] <= times[-1]:
            raise row.reject('column t does not rise')
        times.append(numbers[0])
        rows.append(numbers[1:])
    if not rows:
        raise table.reject('no rows below the header')
    t = np.asarray(times) - times[0]
    step = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    wanted = np.arange(_count(float(t[-1]) + step, rate)) / rate
    # Half a nanosecond of tolerance, so a row at a sample's time applies from that sample.
    index = np.clip(np.searchsorted(t, wanted + 0.5e-9, side='right') - 1, 0, len(t) - 1)
    return LoadHistory(np.asarray(rows)[index], rate)


class CyclicLoads:
    """A history that repeats, for a device that never ends; it begins at sample ``start``."""

    def __init__(self, history: LoadHistory, start: int = 0) -> None:
        if len(history) == 0:
            raise ValueError('a cyclic history needs at least one sample')
        self._loads = history.loads
        self._next = start % len(history)

    def take(self, n: int) -> FloatArray:
        """The next n samples, (n, 3)."""
        index = (self._next + np.arange(n)) % len(self._loads)
        self._next = (self._next + n) % len(self._loads)
        return self._loads[index]
