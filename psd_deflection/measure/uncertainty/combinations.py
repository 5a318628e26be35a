# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Orthogonal combinations of the readings: those that move with the link first, then those that do not.

Of two PSDs: x and y of the plate's middle, its twist, and the length of the base line, exactly, which does not move
while the plate stays flat. Of more PSDs: the directions in which the solver's unknowns move the dots at rest, and those
across them, of which the link moves the dots only to second order. The one that does not move is of what the solver's
model leaves of the dots: a twist by 1 degree would move the dots' own by 15 um.
"""

import abc
import math
from collections.abc import Callable

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.model.plate.linear import design_matrix
from psd_deflection.records import FloatArray

_HALF = math.sqrt(0.5)

Residual = Callable[[FloatArray], FloatArray]
"""What a model of the plate leaves of dots (n, C), m."""


class Combinations(abc.ABC):
    """``matrix`` (C, C): one combination of the C readings a row. ``moving``: how many of them move with the link.

    ``still``: the first one that does not move to any order.
    """

    matrix: FloatArray
    moving: int
    still: int

    @abc.abstractmethod
    def of(self, dots: FloatArray) -> FloatArray:
        """The combinations (C, n) of ``dots`` (n, C), m."""

    @abc.abstractmethod
    def back(self, value: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Dots (B, C) m and their covariance (B, C, C) m^2 from those of the combinations, of B blocks."""

    @abc.abstractmethod
    def fixed(self, dots: FloatArray) -> FloatArray:
        """One combination (n,) of ``dots`` (n, C), m, that does not move."""


class _BaseLine(Combinations):
    """Of two PSDs."""

    moving = still = 3

    def __init__(self, centers: FloatArray, beams: FloatArray, xp: Arithmetic) -> None:
        self._xp = xp
        self.matrix = combinations(beams, xp)
        apart = self._apart = centers[0] - centers[1]
        self._across, self._along = (float(xp.einsum('i,i->', row[:2], apart)) for row in self.matrix[2:4])
        self._beams_apart = float(xp.hypot_many(*(beams[0] - beams[1])))
        self._base_line = self._beams_apart * _HALF

    def of(self, dots: FloatArray) -> FloatArray:
        """See :class:`Combinations`."""
        z = self._xp.einsum('ac,sc->as', self.matrix, dots)
        # The length itself, not its first order: a twist by 1 degree would move that by 13 um.
        z[3] = self._xp.hypot_many(z[3] + self._along, z[2] + self._across) - self._base_line
        return np.asarray(z)

    def back(self, value: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See :class:`Combinations`."""
        # From the length to the part along the base line at rest.
        x, y, twist, length = value.T[:, :, None]
        length = length + self._base_line
        across = twist + self._across
        along = np.sqrt(np.maximum(length * length - across * across, 1e-4 * length * length))
        to_x, to_y, to_twist, to_length = self.matrix
        longer = along - self._along
        dots = x * to_x + y * to_y + twist * to_twist + longer * to_length
        back = np.empty(covariance.shape)
        back[:] = self.matrix
        back[:, 2] -= (across / along) * to_length
        back[:, 3] *= length / along
        return dots, self._xp.einsum('zac,zab,zbd->zcd', back, covariance, back)

    def fixed(self, dots: FloatArray) -> FloatArray:
        """See :class:`Combinations`."""
        apart = dots[:, :2] - dots[:, 2:] + self._apart
        return np.asarray((self._xp.hypot_many(apart[:, 0], apart[:, 1]) - self._beams_apart) * _HALF)


class _Several(Combinations):
    """Of more PSDs."""

    def __init__(self, slopes: FloatArray, residual: Residual | None, xp: Arithmetic) -> None:
        """``slopes`` (C, unknowns): how each reading goes with each unknown at rest."""
        self._xp = xp
        self._residual = residual
        self.matrix = _completed(slopes, xp)
        self.moving = slopes.shape[1]
        self.still = len(slopes)

    def of(self, dots: FloatArray) -> FloatArray:
        """See :class:`Combinations`."""
        return self._xp.einsum('ac,sc->as', self.matrix, dots)

    def back(self, value: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See :class:`Combinations`."""
        dots = self._xp.einsum('ac,za->zc', self.matrix, value)
        return dots, self._xp.einsum('ac,zab,bd->zcd', self.matrix, covariance, self.matrix)

    def fixed(self, dots: FloatArray) -> FloatArray:
        """See :class:`Combinations`."""
        residual = dots if self._residual is None else self._residual(dots)
        return self._xp.einsum('c,sc->s', self.matrix[self.moving], residual)


def combinations_of(
    centers: FloatArray,
    beams: FloatArray,
    slopes: FloatArray | None = None,
    residual: Residual | None = None,
    xp: Arithmetic = FIXED,
) -> Combinations:
    """Of the PSDs at ``centers`` (P, 2) m under ``beams`` (P, 2) m.

    ``slopes`` (2P, unknowns): how the readings of more than two PSDs go with what is solved for, at rest; None: with
    the motion of a flat plate. ``residual``: what the solver's model leaves of the dots; None: to first order.
    """
    if len(centers) == 2:
        return _BaseLine(centers, beams, xp)
    return _Several(design_matrix(beams) if slopes is None else slopes, residual, xp)


def combinations(beams: FloatArray, xp: Arithmetic = FIXED) -> FloatArray:
    """Orthogonal (4, 4): x and y of the middle, twist, base line, each of (x1, y1, x2, y2). ``beams`` (2, 2), m."""
    along = (beams[0] - beams[1]) / xp.hypot_many(*(beams[0] - beams[1]))
    x, y = float(along[0]), float(along[1])
    rows = np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0], [-y, x, y, -x], [x, y, -x, -y]])
    return np.asarray(rows * _HALF)


def _completed(slopes: FloatArray, xp: Arithmetic) -> FloatArray:
    """Orthogonal (C, C) whose first rows span the columns of ``slopes`` (C, k), of full rank."""
    count = len(slopes)
    rows: list[FloatArray] = []
    for candidate in (*slopes.T, *np.eye(count)):
        row = candidate / np.sqrt(xp.sum(candidate * candidate, 0))
        # Twice: once leaves rounding that shows.
        for _ in range(2):
            for before in rows:
                row = row - xp.sum(before * row, 0) * before
        residual = xp.root(float(xp.sum(row * row, 0)))
        # Of the unit vectors, those that the rows so far span are left out.
        if len(rows) < slopes.shape[1] or residual > _SPANNED:
            rows.append(row / residual)
        if len(rows) == count:
            break
    return np.stack(rows)


_SPANNED = 1e-6
