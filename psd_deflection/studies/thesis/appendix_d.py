# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``appendix_d``: the thesis's MATLAB code for the iterative method, unchanged; for comparison only.

It is kept to explain the thesis's published figures. The code has these faults:

- ``tA || tB && rA && ...`` binds as ``tA || (tB && rA)``: direction A (clockwise) is taken on the x test
  alone, and the ``elseif`` of direction B is reached by ``tB && rB`` only;
- the y test is a ratio within 3 %, so its window closes as dY goes to 0: 84 % of counter-clockwise
  twists with |dY| < 50 um find no trial, and the code returns its initial zeros as a measurement;
- if dY is about 100 mm times theta, direction A accepts a counter-clockwise twist, with the wrong sign.

Text missing from the printed listing is restored from similar lines: the left side of ``PSD2_x_Diff_A =
...``, both ``Vert_Disp = ...``, and ``INIT_XI`` is ``INIT_X1``.
"""

from __future__ import annotations

from math import atan, cos, pi, sin, sqrt
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.plate.plate import flat_points
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus
from psd_deflection.studies.thesis.iterative_printed import NO_COVARIANCE

Branch = Literal['A', 'B', 'none']

_MM = 1e3


class AppendixDResult(NamedTuple):
    """The code's result in its own units: mm, mm, degrees clockwise. ``branch``: the branch that returned."""

    horz_disp: float
    vert_disp: float
    angle_of_twist: float
    branch: Branch
    trials: int


def appendix_d_iterative(
    dots_mm: tuple[float, ...],
    init_mm: tuple[float, ...],
    centers_mm: tuple[float, ...] = (0.0, 70.0, -100.0, 0.0),
) -> AppendixDResult:
    """Return the code of Appendix D: dots x1, y1, x2, y2 and their pre-load values, mm.

    ``centers_mm``: its constants +70 (PSD 1, vertical) and -100 (PSD 2, horizontal), the others 0.
    """
    x1, y1, x2, y2 = (c + m for c, m in zip(centers_mm, dots_mm, strict=True))
    x1_init, y1_init, x2_init, y2_init = (c + m for c, m in zip(centers_mm, init_mm, strict=True))
    d1 = sqrt(x1**2 + y1**2)
    d2 = sqrt(x2**2 + y2**2)
    start_1 = atan(x1 / y1)
    start_2 = -atan(y2 / x2) if y2 != 0.0 and x2 < 0.0 else atan(y2 / x2)
    for a in range(401):
        turn = 0.01 * pi / 180.0 * a
        x1_a = d1 * sin(start_1 + turn)
        y1_a = d1 * cos(start_1 + turn)
        x1_b = d1 * sin(start_1 - turn)
        y1_b = d1 * cos(start_1 - turn)
        x2_a = -d2 * cos(start_2 + turn)
        y2_a = d2 * sin(start_2 + turn)
        x2_b = -d2 * cos(start_2 - turn)
        y2_b = d2 * sin(start_2 - turn)
        test_a = abs((x1_a - x1_init) - (x2_a - x2_init)) < 0.1
        test_b = abs((x1_b - x1_init) - (x2_b - x2_init)) < 0.1
        if test_a or (test_b and _ratio(y1_a - y1_init, y2_a - y2_init)):
            return AppendixDResult(x1_init - x1_a, y1_init - y1_a, 0.01 * a, 'A', a + 1)
        if test_b and _ratio(y1_b - y1_init, y2_b - y2_init):
            return AppendixDResult(x1_init - x1_b, y1_init - y1_b, -(0.01 * a), 'B', a + 1)
    return AppendixDResult(0.0, 0.0, 0.0, 'none', 401)


def _ratio(y1_diff: float, y2_diff: float) -> bool:
    return abs(0.97 * y2_diff) < abs(y1_diff) < abs(1.03 * y2_diff)


class AppendixDSolver(Solver):
    """The code of Appendix D in this package's units and signs; two PSDs.

    ``NO_HIT``: no trial passed; the pose is then the code's (0, 0, 0). The covariance is NaN.
    """

    name: ClassVar[str] = 'appendix_d'
    budgeted_as: ClassVar[str] = ''

    def __init__(self, geometry: Geometry) -> None:
        """Bind to ``geometry``. Raises SolverError if the code's arctangents have no meaning."""
        if check_twist(geometry) != 2:
            raise SolverError(f'{self.name} takes two PSDs; of more take exact, or pose if their heights differ')
        self._centers = np.asarray(geometry.centers, dtype=np.float64)
        self._beams = np.asarray(geometry.beams, dtype=np.float64)
        (_, c1y), (c2x, _) = self._centers.tolist()
        if c1y == 0.0 or c2x == 0.0:
            raise SolverError(
                f'psd_1.center y = {c1y:g} m, psd_2.center x = {c2x:g} m: appendix_d divides by both; '
                'PSD 1 must be above or below the link and PSD 2 to its side'
            )
        self._centers_mm = tuple((self._centers * _MM).ravel().tolist())
        self._init_mm = tuple((np.asarray(geometry.zeros) * _MM).ravel().tolist())

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """Return one block, pure floats. See :class:`Solver`."""
        got = appendix_d_iterative(tuple([m * _MM for m in dots]), self._init_mm, self._centers_mm)
        dx = got.horz_disp / _MM
        dy = got.vert_disp / _MM
        theta = -got.angle_of_twist * pi / 180.0 + 0.0
        status = SolverStatus.NO_HIT if got.branch == 'none' else SolverStatus.OK
        points = np.reshape(dots, (2, 2)) + self._centers
        residual = (points - flat_points(np.array([dx, dy, theta]), self._beams)).ravel().tolist()
        return Solution(dx, dy, theta, 0.0, 0.0, NO_COVARIANCE, tuple(residual), status, got.trials)
