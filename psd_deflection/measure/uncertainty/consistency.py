# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The one reading too many: whether the four readings belong to one flat plate, and which one does not.

Two PSDs give four readings for three unknowns. What is left is one number a block: how much longer
the base line between the dots is than that between the beams, r = a^T e for errors e of the readings,
with a = (n, -n)/sqrt(2) and n along the base line. Over its variance a^T C a it is a chi-square of one
degree of freedom. A sound rig is beyond ``LIMIT`` in one block of 10^6; a dead, stuck, swapped or
inverted reading, a PSD that is turned or scaled, and a plate that tilts are beyond it as soon as they
cost more than a few standard deviations.

If one reading i alone is wrong, it is wrong by e_i = r/a_i. Which one, a single block cannot tell; so
``widen`` adds the errors that each of them would cause, sum_i (K_i e_i)(K_i e_i)^T with the solver's
gain K and half as much again, and the truth stays inside. While the link rings, two wrong readings may
cancel in r for a block; so r is held and forgotten over a second. An r that lasts is widened for at a
smaller size than one of a single block. Over many blocks and poses the wrong one can often be told:
the true reading of i is m_i - r/a_i if the others are right, and what i says of it must then follow
one law: nothing (dead or stuck), or the opposite (inverted). If two readings would do, none is named.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.records import FloatArray

LIMIT = 25.0
"""Chi-square beyond which the readings contradict each other: one sound block in 1.7 million (Gaussian noise), with the
second that it holds for: one block in 35 000."""

NAMES = ('x1', 'y1', 'x2', 'y2')

UNMEASURED = 16.0
"""Times ``LIMIT`` while the noise is not measured yet: it may be four times what the rig file says."""

WIDEN = 6.635
"""Chi-square from which one block is widened: 1 % of sound blocks, by less than their own errors."""

LASTING = 2.5
"""The same for the mean r of the last blocks, over the variance of one block. Hum of constant phase, which is in that
variance, has at most 2."""

SLOWLY = 1.0 / 8.0
"""Share of the newest block in that mean."""

_MORE = 1.5
"""Times the error of one reading alone: the errors of two exchanged readings cancel in part in r."""

_FADE = 0.98
"""What is left of a held r^2 after a block."""

_UNSEEN = 0.02
"""A reading with a smaller part in the base line cannot be checked by it."""

_NONE = (0.0, 0.0, 0.0, 0.0)

_FORGET = 1.0 / 500.0
_ENOUGH = 10
"""Blocks before a reading is named."""

_NEAR = 0.02
"""How near to -1 the slope of an inverted reading on what it should be must be."""


class ConsistencyCheck(NamedTuple):
    """One block's answer.

    ``chi_square`` of this block. ``contradict``: this block or one shortly before is beyond ``LIMIT``.
    ``errors`` (4,): of each reading if it alone is wrong, m. ``possible`` (4,): what the covariance is to
    allow for, m: the same from ``WIDEN`` on, or with the r that is held or lasts. Of more than two PSDs ``errors`` and
    ``possible`` are (2P,), ``freedom`` counts the redundant readings, and ``wrong`` is the PSD (from 1) to leave out,
    0: none.
    """

    chi_square: float
    contradict: bool
    errors: tuple[float, ...]
    possible: tuple[float, ...]
    wrong: int = 0
    freedom: int = 1


class Consistency:
    """Holds the readings of each block against each other; it remembers the r of the last second.

    ``held``: r^2 of a contradiction, m^2, or 0. ``mean``: of r over the last blocks, m. ``lasting``: r^2 of one that
    lasts, m^2, or 0.
    """

    def __init__(self, by: Arithmetic = FIXED) -> None:
        self._by = by
        self.held = 0.0
        self.mean = 0.0
        self.lasting = 0.0

    def check(
        self, apart: tuple[float, float], residual: tuple[float, ...], covariance: FloatArray, *, limit: float = LIMIT
    ) -> ConsistencyCheck:
        """Check one block.

        ``apart``: centre of PSD 1 and its dot less those of PSD 2, m. ``residual`` (4,): what the solver leaves of
        the dots, m. ``covariance`` (4, 4) of the dots, m^2. ``limit``: chi-square beyond which they contradict.
        """
        x, y = apart
        size = self._by.root(2.0 * (x * x + y * y))
        if size == 0.0:
            return ConsistencyCheck(0.0, False, _NONE, _NONE)
        ax, ay = x / size, y / size
        x1, y1, x2, y2 = residual
        r = ax * (x1 - x2) + ay * (y1 - y2)
        u1, v1, u2, v2 = [ax * (c[0] - c[2]) + ay * (c[1] - c[3]) for c in covariance.tolist()]
        variance = ax * (u1 - u2) + ay * (v1 - v2)
        chi_square = r * r / variance if variance > 0.0 else 0.0
        contradict = chi_square > limit
        held = max(_FADE * self.held, r * r if contradict else 0.0)
        self.held = held if held > limit * variance else 0.0
        one_x, one_y = [1.0 / p if abs(p) > _UNSEEN else 0.0 for p in (ax, ay)]
        self.mean += SLOWLY * (r - self.mean)
        square = self.mean * self.mean
        # Chance takes the mean of an r that lasts below the limit for some blocks.
        lasts = square * LIMIT > LASTING * limit * variance
        lasting = max(_FADE * self.lasting, square if lasts else 0.0)
        self.lasting = lasting if lasting > variance else 0.0
        # The limit's share: below it an error is not sure enough to be held, and may still be many standard deviations.
        doubtful = chi_square * LIMIT > WIDEN * limit
        root = _MORE * self._by.root(max(self.held, self.lasting, r * r if doubtful else 0.0))
        errors = (r * one_x, r * one_y, -r * one_x, -r * one_y)
        possible = (root * one_x, root * one_y, -root * one_x, -root * one_y)
        return ConsistencyCheck(chi_square, self.held > 0.0, errors, possible)


def widened(covariance: FloatArray, gain: FloatArray, errors: tuple[float, ...], by: Arithmetic = FIXED) -> FloatArray:
    """``covariance`` (3, 3) and what each of ``errors`` (2P,) alone would cause through ``gain`` (3, 2P)."""
    caused = gain * np.array(errors)
    return np.asarray(covariance + by.einsum('ik,jk->ij', caused, caused))


class Suspect:
    """Finds the reading that is most likely wrong from the poses that were seen."""

    def __init__(self, centers: FloatArray, beams: FloatArray) -> None:
        """``centers``, ``beams`` (2, 2), m. Beginning anew forgets what was seen."""
        self._apart = tuple((centers[0] - centers[1]).tolist())
        self._base_line = float(np.hypot(*(beams[0] - beams[1])))
        self._swapped = [0.0, 0.0, 0.0]
        self._blocks = 0
        self._weight = 0.0
        self._sum = np.zeros(8)
        self._squares = np.zeros((3, 4))

    def add(self, dots: tuple[float, ...], errors: tuple[float, ...]) -> None:
        """A block's readings (4,) m and :attr:`Checked.errors`."""
        x1, y1, x2, y2 = dots
        should = np.array(dots) - errors
        ax, ay = self._apart
        for i, (x, y) in enumerate(((x1 - x2, y1 - y2), (y1 - x2, x1 - y2), (x1 - y2, y1 - x2))):
            r = ((ax + x) ** 2 + (ay + y) ** 2) ** 0.5 - self._base_line
            self._swapped[i] = (1.0 - _FORGET) * self._swapped[i] + r * r
        both = np.concatenate((dots, should))
        if not self._blocks:
            self._first = both
        both = both - self._first
        said, should = both[:4], both[4:]
        keep = 1.0 - _FORGET
        self._blocks += 1
        self._weight = keep * self._weight + 1.0
        self._sum = keep * self._sum + both
        self._squares = keep * self._squares + np.stack((said * said, said * should, should * should))

    def most_likely(self, noise: float) -> str:
        """What is wrong, as 'y2 does not move', or '' if that cannot be told. ``noise``: sd of a reading, m."""
        if self._blocks < _ENOUGH:
            return ''
        for psd in (1, 2):
            # The length of the base line is right if the axes are exchanged, and far off if not.
            if self._swapped[psd] < min(0.01 * self._swapped[0], self._weight * (10.0 * noise) ** 2):
                return f'the axes of psd_{psd} are exchanged'
        mean = self._sum / self._weight
        said, should = mean[:4], mean[4:]
        moments = self._squares / self._weight - np.stack((said * said, said * should, should * should))
        found = []
        for c, name in enumerate(NAMES):
            own, shared, wanted = moments[:, c].tolist()
            # It must have had reason to move, by far more than noise.
            if wanted < (100.0 * noise) ** 2:
                continue
            slope = shared / wanted
            off = own - slope * shared
            if own < (5.0 * noise) ** 2:
                found.append(f'{name} does not move with the others')
            elif abs(slope + 1.0) < _NEAR and off < (10.0 * noise) ** 2 + 1e-4 * wanted:
                found.append(f'{name} has the wrong sign')
        return found[0] if len(found) == 1 else ''
