# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Load histories and temperatures in the notation of the command line."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.numbers import plain_number
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.loads import LoadHistory
from psd_deflection.records import FloatArray
from psd_deflection.rig.parameters import shown

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
    parts = [load_history(one, rate, parameter) for one in words]
    return parts[0].then(*parts[1:])


def load_history(words: str, rate: float, parameter: str = 'loads') -> LoadHistory:
    """The history that ``words`` describe (see ``HELP``) at ``rate`` Hz.

    Raises ConfigError naming the ``parameter``, the words and what is wrong, RecordingError for a bad file.
    """
    source = f'{parameter} {words}'
    if words.endswith('.csv'):
        return loads.from_csv(words, rate)
    kind, *rest = words.split(':')
    if kind == 'thesis' and len(rest) <= 1:
        return loads.thesis_load_cases(_seconds(rest[0], source) if rest else 4.0, rate)
    if kind == 'identification' and not rest:
        return loads.identification(rate)
    if kind == 'constant' and len(rest) == 2:
        return loads.constant(_load(rest[0], source), _seconds(rest[1], source), rate)
    if kind == 'steps' and len(rest) == 2:
        return loads.steps([_load(part, source) for part in rest[0].split(';')], _seconds(rest[1], source), rate)
    if kind == 'ramp' and len(rest) == 2:
        ends = [_load(part, source) for part in rest[0].split(';')]
        if len(ends) != 2:
            raise ConfigError(f'{source}: a ramp has two loads, this one has {len(ends)}')
        return loads.ramp(ends[0], ends[1], _seconds(rest[1], source), rate)
    if kind == 'chirp' and len(rest) == 3:
        f0, f1 = _numbers(rest[1], 2, source)
        if not (0.0 <= f0 < rate / 2.0 and 0.0 <= f1 < rate / 2.0):
            raise ConfigError(f'{source}: frequencies must be at least 0 and below {rate / 2.0:g} Hz')
        return loads.chirp(_load(rest[0], source), f0, f1, _seconds(rest[2], source), rate)
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
