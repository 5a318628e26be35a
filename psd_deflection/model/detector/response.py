# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""From the place of a dot on a detector to its reading, and back: the one model of what a detector does.

What happens to a dot at (x, y), m from the detector's centre, in this order:

1. The edges of the active area cut the spot (:mod:`psd_deflection.model.detector.clipping`).
2. Other light pulls the reading to its own centroid (:func:`pulled`).
3. The axes are turned in their plane (:func:`rotated`).
4. The reading grows with the distance from the centre (:func:`grown`).
5. Each axis reads a part of the other one (:func:`crossed`).
6. Each axis has a gain (:func:`scaled`).

Steps 1 and 2 happen to the light, the others to the signal. The effects of the simulation are single steps. The
calibration takes 3 to 6 as one (:class:`DetectorResponse`), the budget 1, 2, 4 and 6. Sources: Hamamatsu's technical
note and data sheets on PSDs (2, 4, 5); geometry of a cut spot (1).
"""

import math
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.records import FloatArray

Pair = tuple[FloatArray, FloatArray]
Size = float | FloatArray

_NEWTON = 6
"""Steps of Newton's method that reach rounding anywhere on a detector."""


def pulled(place: FloatArray, laser: Size, level: Size, center: float) -> FloatArray:
    """One axis, beside other light of ``level`` about ``center``, m; ``laser`` in the unit of ``level``."""
    return (laser * place + level * center) / (laser + level)


def compensated(reading: FloatArray, laser: Size, level: Size, center: float) -> FloatArray:
    """The inverse of :func:`pulled`."""
    return ((laser + level) * reading - level * center) / laser


def rotated(x: FloatArray, y: FloatArray, c: Size, s: Size) -> Pair:
    """In axes that are turned by the angle with the cosine ``c`` and the sine ``s``; back with ``-s``."""
    return c * x + s * y, c * y - s * x


def grown(x: FloatArray, y: FloatArray, k: Size) -> Pair:
    """r becomes r (1 + k r^2); ``k``: 1/m^2."""
    by_distance = 1.0 + k * (x * x + y * y)
    return x * by_distance, y * by_distance


def shrunk(x: FloatArray, y: FloatArray, k: float, xp: Arithmetic = LIBRARY) -> Pair:
    """The inverse of :func:`grown`.

    With k < 0 the reading falls again farther out: no dot is sought where its slope is below a tenth.
    """
    read = xp.hypot_many(x, y)
    farthest = math.sqrt(0.3 / -k) if k < 0.0 else math.inf
    true = np.minimum(read, farthest)
    for _ in range(_NEWTON):
        true = np.minimum(true - (true * (1.0 + k * true**2) - read) / (1.0 + 3.0 * k * true**2), farthest)
    by_distance = 1.0 + k * true**2
    return x / by_distance, y / by_distance


def crossed(x: FloatArray, y: FloatArray, xy: Size, yx: Size) -> Pair:
    """``xy``: share of y in x, ``yx``: share of x in y."""
    return x + xy * y, y + yx * x


def uncrossed(x: FloatArray, y: FloatArray, xy: Size, yx: Size) -> Pair:
    """The inverse of :func:`crossed`."""
    det = 1.0 - xy * yx
    return (x - xy * y) / det, (y - yx * x) / det


def scaled(x: FloatArray, y: FloatArray, gain_x: Size, gain_y: Size) -> Pair:
    """``gain``: scale errors, 0 if there is none."""
    return x * (1.0 + gain_x), y * (1.0 + gain_y)


def unscaled(x: FloatArray, y: FloatArray, gain_x: Size, gain_y: Size) -> Pair:
    """The inverse of :func:`scaled`."""
    return x / (1.0 + gain_x), y / (1.0 + gain_y)


class DetectorResponse(NamedTuple):
    """What a calibration finds of one detector: ``rotation``, rad; ``nonlinearity``, 1/m^2; the others are shares."""

    rotation: float
    gain_x: float
    gain_y: float
    crosstalk_xy: float
    crosstalk_yx: float
    nonlinearity: float

    def reading(self, x: FloatArray, y: FloatArray, xp: Arithmetic = LIBRARY) -> Pair:
        """What the detector reads of a dot at (x, y), m."""
        angle = np.asarray(self.rotation)
        x, y = rotated(x, y, xp.cos_many(angle), xp.sin_many(angle))
        x, y = grown(x, y, self.nonlinearity)
        x, y = crossed(x, y, self.crosstalk_xy, self.crosstalk_yx)
        return scaled(x, y, self.gain_x, self.gain_y)

    def place(self, x: FloatArray, y: FloatArray, xp: Arithmetic = LIBRARY) -> Pair:
        """The inverse of :meth:`reading`."""
        x, y = unscaled(x, y, self.gain_x, self.gain_y)
        x, y = uncrossed(x, y, self.crosstalk_xy, self.crosstalk_yx)
        x, y = shrunk(x, y, self.nonlinearity, xp)
        angle = np.asarray(self.rotation)
        return rotated(x, y, xp.cos_many(angle), -xp.sin_many(angle))

    def slopes(self, x: FloatArray, y: FloatArray, xp: Arithmetic = LIBRARY) -> FloatArray:
        """Derivatives (2, 2, ...) of :meth:`reading` by x and y, by central differences."""
        step = 1e-6
        columns = [
            np.subtract(self.reading(x + a, y + b, xp), self.reading(x - a, y - b, xp)) / (2.0 * step)
            for a, b in ((step, 0.0), (0.0, step))
        ]
        return np.stack(columns, axis=1)
