# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which reading of two PSDs is most likely wrong, by many blocks and poses; a single block cannot tell.

If the other readings are right, the true value of reading i is m_i - r/a_i (:mod:`consistency`). Over many poses m_i
must follow one law of it: constant (dead or stuck), or its opposite (inverted). Exchanged axes make the length of the
base line right. If two readings would do, none is named.
"""

import numpy as np

from psd_deflection.records import FloatArray

NAMES = ('x1', 'y1', 'x2', 'y2')

_FORGET = 1.0 / 500.0
"""Share of the past that a block takes off the moments."""

_ENOUGH = 10
"""Blocks before a reading is named."""

_NEAR = 0.02
"""How near to -1 the slope of an inverted reading on its true value must be."""


class OutlierSearch:
    """Moments of the readings and of their true values, each if the other readings are right."""

    def __init__(self, centers: FloatArray, beams: FloatArray) -> None:
        """``centers``, ``beams`` (2, 2), m."""
        self._apart = tuple((centers[0] - centers[1]).tolist())
        self._base_line = float(np.hypot(*(beams[0] - beams[1])))
        self._swapped = [0.0, 0.0, 0.0]
        self._blocks = 0
        self._weight = 0.0
        self._sum = np.zeros(8)
        self._squares = np.zeros((3, 4))

    def add(self, dots: tuple[float, ...], errors: tuple[float, ...]) -> None:
        """Take a block: its readings (4,) m and :attr:`ConsistencyResult.errors`."""
        x1, y1, x2, y2 = dots
        true = np.array(dots) - errors
        ax, ay = self._apart
        for i, (x, y) in enumerate(((x1 - x2, y1 - y2), (y1 - x2, x1 - y2), (x1 - y2, y1 - x2))):
            r = ((ax + x) ** 2 + (ay + y) ** 2) ** 0.5 - self._base_line
            self._swapped[i] = (1.0 - _FORGET) * self._swapped[i] + r * r
        both = np.concatenate((dots, true))
        if not self._blocks:
            self._first = both
        both = both - self._first
        read, true = both[:4], both[4:]
        keep = 1.0 - _FORGET
        self._blocks += 1
        self._weight = keep * self._weight + 1.0
        self._sum = keep * self._sum + both
        self._squares = keep * self._squares + np.stack((read * read, read * true, true * true))

    def most_likely(self, noise: float) -> str:
        """Return what is wrong, such as 'y2 does not move', or '' if unknown. ``noise``: sd of a reading, m."""
        if self._blocks < _ENOUGH:
            return ''
        for psd in (1, 2):
            # The length of the base line is right if the axes are exchanged, and far off if not.
            if self._swapped[psd] < min(0.01 * self._swapped[0], self._weight * (10.0 * noise) ** 2):
                return f'the axes of psd_{psd} are exchanged'
        mean = self._sum / self._weight
        read, true = mean[:4], mean[4:]
        moments = self._squares / self._weight - np.stack((read * read, read * true, true * true))
        matches = []
        for c, name in enumerate(NAMES):
            var_read, shared, var_true = moments[:, c].tolist()
            # It must have had reason to move, by far more than noise.
            if var_true < (100.0 * noise) ** 2:
                continue
            slope = shared / var_true
            off = var_read - slope * shared
            if var_read < (5.0 * noise) ** 2:
                matches.append(f'{name} does not move with the others')
            elif abs(slope + 1.0) < _NEAR and off < (10.0 * noise) ** 2 + 1e-4 * var_true:
                matches.append(f'{name} has the wrong sign')
        return matches[0] if len(matches) == 1 else ''
