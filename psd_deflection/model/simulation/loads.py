# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Load histories: the known load at the tip, sample by sample.

The thesis hangs 10, 30 and 50 N on a sidebar, 0.585 m from the link on its +X side, and on the
link itself (thesis chapter 5). A weight pulls along -Y; on the sidebar it also turns the tip by
Tz = -F * 0.585 m (a weight at +X turns clockwise in (x, y), so theta is negative).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from psd_deflection.base.csv_table import CsvTable
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.text import plain_number
from psd_deflection.records import FloatArray
from psd_deflection.rig.parameters import shown

SIDEBAR_ARM = 0.585
"""Place of the weight on the sidebar, m from the link, toward +X."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadHistory:
    """``loads`` (n, 3): Fx N, Fy N, Tz N m at the tip centroid, held from each sample to the next."""

    loads: FloatArray
    sample_rate_hz: float

    def __len__(self) -> int:
        return len(self.loads)

    def then(self, *following: LoadHistory) -> LoadHistory:
        """This history, followed by the others (all at its rate)."""
        return LoadHistory(np.concatenate([self.loads, *(o.loads for o in following)]), self.sample_rate_hz)


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
    amplitude: tuple[float, float, float], f0: float, f1: float, duration: float, rate: float = 1000.0
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
    none = (0.0, 0.0, 0.0)
    levels = [none, sidebar(30.0), sidebar(50.0), sidebar(10.0), none, direct(50.0)]
    levels += [(30.0, 0.0, 0.0), (-20.0, -20.0, 15.0), (0.0, 20.0, 25.0), none]
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


HELP = """\
load histories (a load is FX,FY,TZ in N, N, N m; DWELL and SECONDS in s):
  thesis[:DWELL]             0, 10, 30, 50 N on the sidebar, 0, the same on the
                             link, 0 (default: 4 s each)
  identification             24 s that show most effects of the catalogue
  constant:LOAD:SECONDS
  steps:LOAD;LOAD;...:DWELL
  ramp:LOAD;LOAD:SECONDS
  chirp:LOAD:F0,F1:SECONDS   a sine of this amplitude, from F0 to F1 Hz
  FILE.csv                   columns t, load_fx, load_fy, load_tz, held
"""

MAX_SECONDS = 86_400.0


def _numbers(text: str, count: int | None, source: str) -> tuple[float, ...]:
    try:
        out = tuple(plain_number(v) for v in text.split(','))
    except ValueError:
        raise ConfigError(f'{source}: {text!r} is not a list of numbers') from None
    if not all(math.isfinite(v) for v in out):
        raise ConfigError(f'{source}: {text!r} holds a number that is not finite')
    if count is not None and len(out) != count:
        raise ConfigError(f'{source}: {text!r} must be {count} numbers, is {len(out)}')
    return out


def _load(text: str, source: str) -> tuple[float, float, float]:
    a, b, c = _numbers(text, 3, source)
    return (a, b, c)


def _seconds(text: str, source: str) -> float:
    (value,) = _numbers(text, 1, source)
    if not 0.0 < value <= MAX_SECONDS:
        raise ConfigError(f'{source}: {value:g} s: must be above 0 and at most {MAX_SECONDS:g}')
    return value


def load_histories(words: Sequence[str], rate: float, parameter: str = 'loads') -> LoadHistory:
    """The histories of several ``words``, one after the other. Raises as :func:`load_history`."""
    parts = [load_history(word, rate, parameter) for word in words]
    return parts[0].then(*parts[1:])


def load_history(words: str, rate: float, parameter: str = 'loads') -> LoadHistory:
    """The history that ``words`` describe (see ``HELP``) at ``rate`` Hz.

    Raises ConfigError naming the ``parameter``, the words and what is wrong, RecordingError for a bad file.
    """
    source = f'{parameter} {words}'
    if words.endswith('.csv'):
        return from_csv(words, rate)
    kind, *rest = words.split(':')
    if kind == 'thesis' and len(rest) <= 1:
        return thesis_load_cases(_seconds(rest[0], source) if rest else 4.0, rate)
    if kind == 'identification' and not rest:
        return identification(rate)
    if kind == 'constant' and len(rest) == 2:
        return constant(_load(rest[0], source), _seconds(rest[1], source), rate)
    if kind == 'steps' and len(rest) == 2:
        return steps([_load(part, source) for part in rest[0].split(';')], _seconds(rest[1], source), rate)
    if kind == 'ramp' and len(rest) == 2:
        ends = [_load(part, source) for part in rest[0].split(';')]
        if len(ends) != 2:
            raise ConfigError(f'{source}: a ramp has two loads, this one has {len(ends)}')
        return ramp(ends[0], ends[1], _seconds(rest[1], source), rate)
    if kind == 'chirp' and len(rest) == 3:
        f0, f1 = _numbers(rest[1], 2, source)
        if not (0.0 <= f0 < rate / 2.0 and 0.0 <= f1 < rate / 2.0):
            raise ConfigError(f'{source}: frequencies must be at least 0 and below {rate / 2.0:g} Hz')
        return chirp(_load(rest[0], source), f0, f1, _seconds(rest[2], source), rate)
    raise ConfigError(f'{source}: not a load history: thesis, identification, constant, steps, ramp, chirp or a .csv')


def load_table(
    loads: npt.ArrayLike, rate: float, seconds: float | None = None, parameter: str = 'loads'
) -> LoadHistory:
    """The history of ``loads``: (3,) or (n, 3), N, N, N m. Each row is held for ``seconds``; None: for one sample.

    Raises ConfigError naming the ``parameter``, the value and what is wrong.
    """
    try:
        rows = np.atleast_2d(np.asarray(loads, dtype=np.float64))
    except (TypeError, ValueError):
        raise ConfigError(f'{parameter} = {shown(loads)}: must be numbers, (3,) or (n, 3)') from None
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ConfigError(f'{parameter}: has the shape {np.shape(loads)}: must be (3,) or (n, 3): N, N, N m')
    bad = np.flatnonzero(~np.all(np.isfinite(rows), axis=1))
    if len(bad):
        raise ConfigError(f'{parameter}[{bad[0]}] = {rows[bad[0]].tolist()}: must be finite')
    repeats = 1
    if seconds is not None:
        most = MAX_SECONDS / len(rows)
        try:
            fits = 0.0 < seconds <= most
        except TypeError:
            fits = False
        if not fits:
            raise ConfigError(f'seconds = {shown(seconds)} s: must be above 0 and at most {most:g}')
        repeats = round(seconds * rate)
    return LoadHistory(np.repeat(rows, repeats, axis=0), rate)


def temperature_history(words: str, n: int, parameter: str = 'temperature') -> FloatArray:
    """``T0[,T1,...]`` in degrees Celsius: straight lines through these, evenly over n samples.

    Raises ConfigError naming the ``parameter``.
    """
    return temperature_table(_numbers(words, None, f'{parameter} {words}'), n, parameter)


def temperature_table(knots: npt.ArrayLike, n: int, parameter: str = 'temperature') -> FloatArray:
    """Straight lines through ``knots`` (a number or (m,), degrees Celsius), evenly over n samples.

    Raises ConfigError naming the ``parameter``.
    """
    try:
        values = np.atleast_1d(np.asarray(knots, dtype=np.float64))
    except (TypeError, ValueError):
        raise ConfigError(f'{parameter} = {shown(knots)}: must be numbers') from None
    if values.ndim != 1 or not len(values) or not np.all(np.isfinite(values)):
        raise ConfigError(f'{parameter} = {shown(knots)}: must be finite numbers, (m,)')
    return np.asarray(np.interp(np.linspace(0.0, 1.0, n), np.linspace(0.0, 1.0, len(values)), values))
