# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Section 2.3 of the thesis, (2.32) to (2.49): each equation as printed beside its correction; for comparison only.

The chain as printed ends at (2.38), whose root is imaginary. So each printed equation is given the corrected values of
those before it. Two PSDs at height 0. theta is counter-clockwise, the thesis's clockwise; ``x_i`` of (2.32) is read as
X_i, and its distances as the coordinates whose signs the text asks for: (X^_i, Y^_i) = R(theta) q_i.
"""

from __future__ import annotations

from math import acos, atan2, cos, hypot, inf, nan, remainder, sin, sqrt, tan
from typing import NamedTuple

import numpy as np

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.plate.plate import plate_points
from psd_deflection.records import FloatArray


class TiltBranch(NamedTuple):
    """One of the tilts that explain the dots at a given twist: m and rad."""

    dx: float
    dy: float
    phi: float
    omega: float


class Compared(NamedTuple):
    """What an equation gives: ``printed`` (NaN: imaginary), ``corrected``, and what is ``true``, in ``unit``."""

    equation: str
    unit: str
    printed: float
    corrected: float
    true: float


def hats(geometry: Geometry, dots: tuple[float, ...], theta: float) -> FloatArray:
    """(2.32), corrected: coordinates (2, 2), m, of both dots on the axes that are turned back by ``theta``."""
    c, s = cos(theta), sin(theta)
    places = np.asarray(geometry.centers) + np.reshape(dots, (2, 2))
    return np.asarray(places @ np.array([[c, s], [-s, c]]))


def tilt_branches(geometry: Geometry, dots: tuple[float, ...], theta: float) -> tuple[TiltBranch, ...]:
    """Return all (dX, dY, phi, omega) that give exactly these dots at twist ``theta``: none, or four.

    (2.33) to (2.43), corrected:

    - 2.34, 2.35: Y_T,i = l_iy - dY; so 2.36: cos phi = (l_1y - l_2y)/(Y^_1 - Y^_2), dY = l_2y - Y^_2 cos phi;
    - 2.37: Pr_i = +- Y^_i sin |phi|, the sign cannot be determined;
    - 2.38: DT^2 = (Pr_1 - Pr_2)^2 + (X^_1 - X^_2)^2, a sum;
    - 2.40, 2.41: omega = atan2(Pr_1 - Pr_2, X^_1 - X^_2) +- acos((l_1x - l_2x)/DT);
    - 2.42: dX = l_1x - X^_1 cos omega - Pr_1 sin omega.

    Raises SolverError if the beams are exactly side by side or one above the other (phi cannot be
    found if l_1y = l_2y, omega cannot if l_1x = l_2x).
    """
    if check_twist(geometry) != 2:
        raise SolverError('tilt branches are those of two PSDs')
    (l1x, l1y), (l2x, l2y) = geometry.beams.tolist()
    for axis, angle, apart in (('y', 'phi', l1y - l2y), ('x', 'omega', l1x - l2x)):
        if abs(apart) < 1e-6:
            raise SolverError(f'both beams have the same {axis}: {angle} has no part in their base line')
    (x1, y1), (x2, y2) = hats(geometry, dots, theta).tolist()
    # Rounding may carry an untilted plate past 1 by a few digits; more is a contradiction.
    cos_phi = (l1y - l2y) / (y1 - y2) if y1 != y2 else nan
    if not abs(cos_phi) <= 1.0 + 1e-12:
        return ()
    cos_phi = min(1.0, cos_phi)
    phi = acos(cos_phi)
    dy = l2y - y2 * cos_phi
    branches = []
    for signed in (phi, -phi):
        p1 = y1 * sin(signed)
        p2 = y2 * sin(signed)
        cosine = (l1x - l2x) / hypot(p1 - p2, x1 - x2)
        if not abs(cosine) <= 1.0 + 1e-12:
            return ()
        apart = acos(max(-1.0, min(1.0, cosine)))
        middle = atan2(p1 - p2, x1 - x2)
        for sum_ in (middle + apart, middle - apart):
            omega = remainder(sum_, 2.0 * np.pi)
            branches.append(TiltBranch(l1x - x1 * cos(omega) - p1 * sin(omega), dy, signed, omega))
    return tuple(branches)


def compared(geometry: Geometry, pose: FloatArray) -> list[Compared]:
    """(2.36) to (2.45) at the true twist of ``pose`` (5,): dX, dY m, theta, phi, omega rad."""
    dx, dy, theta, phi, omega = pose.tolist()
    dots = tuple((plate_points(pose[None], geometry.beams, geometry.heights)[0] - geometry.centers).ravel().tolist())
    (x1, y1), (x2, y2) = hats(geometry, dots, theta).tolist()
    p1, p2 = y1 * sin(phi), y2 * sin(phi)
    (l1x, l1y), (l2x, l2y) = geometry.beams.tolist()
    g_x, g_y = l2x - l1x, l1y - l2y

    def off(branch: TiltBranch) -> float:
        return hypot(branch.phi - phi, branch.omega - omega)

    best = min(tilt_branches(geometry, dots, theta), key=off)
    by_sum = hypot(p1 - p2, x1 - x2)
    difference = (p2 - p1) ** 2 - (x2 - x1) ** 2
    # 2.39-2.41, given the corrected DT, and lengths for G_x and the difference.
    summed = acos(abs(x2 - x1) / by_sum) + acos(min(abs(g_x) / by_sum, 1.0))
    # 2.42: consistent, with omega counted the other way.
    by_printed = -(x1 * cos(-omega) - p1 * sin(-omega))
    out = [
        Compared('2.36 ΔY', 'm', g_y / (y1 / y2 - 1.0) if y2 else 0.0, best.dy, dy),
        Compared('2.38 DT', 'm', sqrt(difference) if difference >= 0.0 else nan, by_sum, by_sum),
        Compared('2.41 |ω|', 'rad', summed, abs(best.omega), abs(omega)),
        Compared('2.42 ΔX', 'm', by_printed, best.dx, dx),
    ]
    for psd, x, p, l_x in ((1, x1, p1, l1x), (2, x2, p2, l2x)):
        # 2.44 and 2.45 along X^: what takes the dot of the tilted plate to that of a flat one.
        first, stretch = p * tan(omega), 1.0 / cos(omega) - 1.0
        out.append(
            Compared(
                f'2.44, 2.45 δX^ of PSD {psd}', 'm', first - dx * stretch, first - (l_x - dx) * stretch, l_x - dx - x
            )
        )
    return out


def mismatch(geometry: Geometry, dots: tuple[float, ...], theta: float) -> float:
    """The stopping test (2.46) to (2.49), corrected: how far any branch at a trial ``theta`` is off the readings, m.

    ``inf`` if the trial angle has no branch.
    """
    poses = np.array([[b.dx, b.dy, theta, b.phi, b.omega] for b in tilt_branches(geometry, dots, theta)])
    if not len(poses):
        return inf
    made = plate_points(poses, geometry.beams, geometry.heights) - geometry.centers
    return float(np.abs(made.reshape(len(poses), 4) - dots).max())
