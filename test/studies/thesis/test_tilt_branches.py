# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Section 2.3 of the thesis, corrected: four tilts explain the readings at any admissible twist."""

from __future__ import annotations

from math import acos, atan2, cos, hypot, nan, pi, remainder, sin
from typing import Any, NamedTuple

import numpy as np
import pytest

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate import Geometry
from psd_deflection.model.plate.layout import check_twist


class TiltBranch(NamedTuple):
    """One of the tilts that explain the dots at a given twist: m and rad."""

    dx: float
    dy: float
    phi: float
    omega: float


def tilt_branches(geometry: Geometry, dots: tuple[float, ...], theta: float) -> tuple[TiltBranch, ...]:
    """All (dX, dY, phi, omega) that give exactly these dots at twist ``theta``: none, or four.

    The thesis's 2.32-2.43, corrected, for two PSDs at height 0:

    - 2.32: (X^_i, Y^_i) = R(theta) q_i, signs kept;
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
    (c1x, c1y), (c2x, c2y) = np.asarray(geometry.centers).tolist()
    for axis, angle, apart in (('y', 'phi', l1y - l2y), ('x', 'omega', l1x - l2x)):
        if abs(apart) < 1e-6:
            raise SolverError(f'both beams have the same {axis}: {angle} has no part in their base line')
    c = cos(theta)
    s = sin(theta)
    x1 = c * (c1x + dots[0]) - s * (c1y + dots[1])
    y1 = s * (c1x + dots[0]) + c * (c1y + dots[1])
    x2 = c * (c2x + dots[2]) - s * (c2y + dots[3])
    y2 = s * (c2x + dots[2]) + c * (c2y + dots[3])
    # Rounding may carry an untilted plate past 1 by a few digits; more is a contradiction.
    cos_phi = (l1y - l2y) / (y1 - y2) if y1 != y2 else nan
    if not abs(cos_phi) <= 1.0 + 1e-12:
        return ()
    cos_phi = min(1.0, cos_phi)
    phi = acos(cos_phi)
    dy = l2y - y2 * cos_phi
    found = []
    for signed in (phi, -phi):
        p1 = y1 * sin(signed)
        p2 = y2 * sin(signed)
        cosine = (l1x - l2x) / hypot(p1 - p2, x1 - x2)
        if not abs(cosine) <= 1.0 + 1e-12:
            return ()
        apart = acos(max(-1.0, min(1.0, cosine)))
        middle = atan2(p1 - p2, x1 - x2)
        for sum_ in (middle + apart, middle - apart):
            omega = remainder(sum_, 2.0 * pi)
            found.append(TiltBranch(l1x - x1 * cos(omega) - p1 * sin(omega), dy, signed, omega))
    return tuple(found)


THREE = [[0.1, 0.0], [-0.05, 0.087], [-0.05, -0.087]]


@pytest.mark.parametrize('case', [f'G{i}' for i in range(1, 13) if i != 4])
def test_tilt_branches(golden: Any, case: str) -> None:
    """G4 lies on the edge, where rounding alone decides whether a branch exists; its list is empty."""
    theta = golden.cases[case]['pose'][3]
    got = np.array(tilt_branches(golden.geometry(case), golden.dots(case), theta))
    want = np.array(golden.cases[case]['tilt_branches_at_true_theta'])
    assert got.shape == (4, 4)
    at_rest = np.abs(want[:, 2:]) < 1e-7
    np.testing.assert_allclose(got[:, :2], want[:, :2], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(got[:, 2:][~at_rest], want[:, 2:][~at_rest], rtol=0.0, atol=1e-9)
    assert np.abs(got[:, 2:][at_rest]).max(initial=0.0) < 1e-7


def test_tilt_branches_name_their_degenerate_rigs() -> None:
    for centers, said in (
        ([[0.0, 0.05], [-0.1, 0.05]], 'same y: phi'),
        ([[0.1, 0.05], [0.1, -0.05]], 'same x: omega'),
        (THREE, 'two PSDs'),
    ):
        geometry = Geometry(np.array(centers), np.zeros((len(centers), 2)), np.zeros(len(centers)), 0.585)
        with pytest.raises(SolverError, match=said):
            tilt_branches(geometry, (0.0,) * (2 * len(centers)), 0.0)


def test_no_tilt_lengthens_the_base_line_beyond_the_beams(golden: Any) -> None:
    """Dots closer together than the beams, along y and along x: no branch."""
    geometry = golden.geometry()
    assert tilt_branches(geometry, (0.0, -1e-4, 0.0, 0.0), 0.0) == ()
    assert tilt_branches(geometry, (-1e-4, 0.0, 0.0, 0.0), 0.0) == ()
