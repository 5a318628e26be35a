# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Drift of the readings of a link at rest: the slope of each reading's means over the last segments.

A link that creeps and a detector that warms look alike, and the covariance of a block has nothing of a detector's
drift. So the blocks report it.
"""

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.records import FloatArray

_SHORTEST, _LONGEST = 4, 20
"""Segments of a fit: 4 to 20 s with blocks of 20 at 1 kHz."""

_SIGNIFICANT = 5.0
"""Standard deviations of a slope, or of all together: of white noise, chance makes one of four readings seem to drift
once in 5 days."""


class Drift:
    """Fits segment after segment. ``slope`` (C,): m a segment, 0 where there is none; kept while the link moves."""

    def __init__(self, count: int, xp: Arithmetic = FIXED) -> None:
        """``count``: C."""
        self._xp = xp
        self._means: list[FloatArray] = []  # Bound: _LONGEST.
        self.slope = np.zeros(count)
        # A chi-square of all slopes together (Wilson & Hilferty 1931).
        share = 2.0 / (9.0 * count)
        cube_root = 1.0 - share + _SIGNIFICANT * xp.root(share)
        self._limit = count * cube_root * cube_root * cube_root

    def interrupt(self) -> None:
        """Begin anew after a segment that is missing, or in which the link moved."""
        self._means = []

    def add(self, mean: FloatArray, sd: FloatArray) -> None:
        """Take the next segment at rest: ``mean`` (C,) of the readings and its ``sd`` (C,) by their noise, m."""
        self._means = [*self._means[1 - _LONGEST :], mean]
        count = len(self._means)
        if count < _SHORTEST:
            return
        xp, means = self._xp, np.stack(self._means)
        time = np.arange(count) - 0.5 * (count - 1)
        squares = float(xp.sum(time * time, 0))
        means = means - xp.sum(means, 0) / count
        slope = xp.sum(time[:, None] * means, 0) / squares
        residual = means - time[:, None] * slope
        variance = np.maximum(sd * sd, xp.sum(residual * residual, 0) / (count - 2)) / squares
        ratio = slope * slope / variance
        together = float(xp.sum(ratio, 0)) > self._limit
        self.slope = slope if together else np.where(ratio > _SIGNIFICANT * _SIGNIFICANT, slope, 0.0)

    def state(self) -> tuple[float, ...]:
        """Return the state as numbers; () before the first segment at rest."""
        return tuple(np.concatenate((self.slope, *self._means)).tolist()) if self._means or self.slope.any() else ()

    def set_state(self, values: tuple[float, ...]) -> None:
        """Go on from :meth:`state`. Raises ValueError if it is that of other readings."""
        count = len(self.slope)
        if len(values) % count or not 0 < len(values) <= (_LONGEST + 1) * count:
            raise ValueError(f'the drift of {count} readings has up to {_LONGEST + 1} rows of them')
        self.slope, *self._means = np.reshape(values, (-1, count))
