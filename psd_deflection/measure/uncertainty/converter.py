# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The steps of the converter as the samples show them, whatever the rig file says.

Volts of a converter lie on a grid: their differences are multiples of its step. The greatest common divisor of the
differences of one channel is that step, once neighbouring levels were seen; noise makes them follow each other. It is
found by Euclid's algorithm, sample by sample, within the rounding of float32. One difference that is no multiple of it
makes it finer, so that the steps of a finer converter are never taken for coarse: 19 independent differences all being
even has a chance of 2 in 10^6, and a channel is believed after ``BELIEVED``.

A channel that does not leave its level (noise far below a step) tells no step by its differences. Its volts and those
of the other channels are multiples of the step themselves, so the divisor of all levels is taken.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.rig.declarations import LEAST_BITS

Volts = npt.NDArray[np.float32] | FloatArray

BELIEVED = 30
"""Samples off a channel's first level that all are multiples of its step."""

_FINE = 1.5
"""Times the rig file's step: not coarser than that."""

_ROUNDING = 2.5e-7
"""Of a difference of two float32, as a share of their size."""

_OFF = 0.25
"""Share of the rig file's step by which a multiple may be off."""

_LEVELS = 4
"""Channels off 0 V whose levels have a common divisor."""


class ConverterSteps:
    """Takes volts and tells the steps; it looks on for as long as a channel may be coarse.

    ``steps`` (C,): V of each channel, 0 where it is that of the rig file or not known.
    """

    def __init__(self, channels: int, step: float, coarsest: float) -> None:
        """``step``: of the rig file, V. ``coarsest``: V; what is coarser is no step."""
        self._step, self._coarsest = step, coarsest
        self._first = np.full(channels, np.nan)
        self._divisor = np.zeros(channels)
        self._off = np.zeros(channels)
        self.steps = np.zeros(channels)
        # What is fine stays so.
        self._all_fine = False

    @classmethod
    def of_rig(cls, rig: Rig) -> ConverterSteps:
        """Of the channels of its PSDs."""
        converter = rig.converter
        return cls(3 * len(rig.psds), converter.volts_per_count, converter.full_scale / (1 << (LEAST_BITS - 1)))

    @property
    def _fine(self) -> npt.NDArray[np.bool_]:
        return (self._divisor > 0.0) & (self._divisor < _FINE * self._step)

    def add(self, volts: Volts) -> bool:
        """``volts`` (n, C), none of them NaN; True if :attr:`steps` changed."""
        if self._all_fine:
            return False
        fine = self._fine
        levels: FloatArray = np.asarray(volts, dtype=np.float64)
        self._first = np.where(np.isnan(self._first), levels[0], self._first)
        apart = np.abs(levels - self._first)
        rounding = self._tolerance(levels)
        self._off += np.count_nonzero(apart > rounding, axis=0)
        with np.errstate(divide='ignore', invalid='ignore'):
            times = apart / self._divisor
            fits = np.abs(times - np.rint(times)) * self._divisor <= rounding
        for channel in np.flatnonzero(~fine & ~fits.all(axis=0)).tolist():
            own = float(self._divisor[channel])
            for value in np.unique(apart[:, channel]).tolist():
                own = _common(own, value, float(rounding[channel]))
            # Not many times the rounding of float32, it is none.
            least = max(_FINE * self._step, 8.0 * _ROUNDING * float(np.abs(levels[:, channel]).max()))
            self._divisor[channel] = own if own == 0.0 or own > least else self._step
        before = self.steps
        self.steps = self._found()
        self._all_fine = bool(self._fine.all())
        return not np.array_equal(before, self.steps)

    def state(self) -> tuple[float, ...]:
        """What :meth:`set_state` needs to go on from here; () before the first sample."""
        if np.isnan(self._first).any():
            return ()
        return tuple(v for part in (self._first, self._divisor, self._off) for v in part.tolist())

    def set_state(self, values: tuple[float, ...]) -> None:
        """Go on from :meth:`state` of another one. Raises ValueError if it had other channels."""
        if len(values) != 3 * len(self.steps):
            raise ValueError(f'steps of {len(self.steps)} channels have {3 * len(self.steps)} values')
        self._first, self._divisor, self._off = np.reshape(values, (3, -1)).copy()
        self.steps = self._found()
        self._all_fine = bool(self._fine.all())

    def _tolerance(self, volts: FloatArray) -> FloatArray:
        return np.asarray(np.maximum(_OFF * self._step, _ROUNDING * np.abs(volts).max(axis=0)))

    def _found(self) -> FloatArray:
        fine = self._fine
        reported = (self._divisor > 0.0) & ~fine & (self._divisor <= self._coarsest) & (self._off >= BELIEVED)
        out = np.where(reported, self._divisor, 0.0)
        silent = (self._off < BELIEVED) & ~fine
        if silent.any():
            # The same converter has the others; if none of them tells, the levels themselves.
            common = float(out.max()) if reported.any() else 0.0 if fine.any() else self._of_levels()
            out[silent & (self._first != 0.0)] = common
        return out

    def _of_levels(self) -> float:
        own = 0.0
        levels = np.abs(self._first)
        if np.count_nonzero(levels > 0.0) < _LEVELS:
            return 0.0
        for value in (*levels.tolist(), *self._divisor.tolist()):
            own = _common(own, value, float(self._tolerance(levels[None, :]).max()))
        return own if _FINE * self._step <= own <= self._coarsest else 0.0


def _common(a: float, b: float, within: float) -> float:
    """The greatest common divisor of two numbers, each of them known ``within`` so much; 0 has every divisor."""
    a, b = max(a, b), min(a, b)
    while b > within:
        rest = a % b
        a, b = b, min(rest, b - rest)
    return a
