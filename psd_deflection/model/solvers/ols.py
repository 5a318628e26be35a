# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``ols``: ordinary least squares on the linearised plate, with the corrected design matrix.

The thesis's section 4.2 (4.24, x = A+ b) with the corrected rows of ``model.plate.linear`` and the pre-load
readings subtracted. On exact data of a flat plate it gives theta' = sin theta and
d' = R(-theta) d + (1 - cos theta) lbar, lbar the mean of the l_i: the turn of d that it leaves out,
not the sine, is its largest error (43 um at 1 degree and 2 mm).
"""

from typing import ClassVar

import numpy as np

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.plate.linear import design_matrix, gain_matrix
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus
from psd_deflection.records import FloatArray


class FixedGain(Solver):
    """The driver of the linear methods: x = G (m - m_0) for a gain that does not depend on the noise; covariance
    G V G^T."""

    def __init__(
        self, design: FloatArray, zeros: FloatArray, row_scaling: FloatArray, arithmetic: Arithmetic = LIBRARY
    ) -> None:
        """``design`` (2P, 3); ``zeros`` (P, 2) m, subtracted first; ``row_scaling`` (2P,)."""
        gains = gain_matrix(design, row_scaling, arithmetic)
        self._columns = tuple(
            (zero, *gain, *row)
            for zero, gain, row in zip(zeros.ravel().tolist(), gains.T.tolist(), design.tolist(), strict=True)
        )

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block, pure floats. See :class:`Solver`."""
        dx = dy = theta = vxx = vxy = vxt = vyy = vyt = vtt = 0.0
        for m, v, (zero, x, y, t, _, _, _) in zip(dots, variances, self._columns, strict=True):
            b = m - zero
            dx += x * b
            dy += y * b
            theta += t * b
            xv = x * v
            yv = y * v
            vxx += xv * x
            vxy += xv * y
            vxt += xv * t
            vyy += yv * y
            vyt += yv * t
            vtt += t * v * t
        residual = tuple(
            [
                m - zero - ax * dx - ay * dy - at * theta
                for m, (zero, _, _, _, ax, ay, at) in zip(dots, self._columns, strict=True)
            ]
        )
        status = SolverStatus.OK if theta - theta == 0.0 else SolverStatus.NOT_CONVERGED
        covariance = (vxx, vxy, vxt, vxy, vyy, vyt, vxt, vyt, vtt)
        return Solution(dx, dy, theta, 0.0, 0.0, covariance, residual, status, 0)

    def gain(self, dots: tuple[float, ...], variances: tuple[float, ...], solution: Solution) -> FloatArray:
        """The gain itself. See :class:`Solver`."""
        return np.array([c[1:4] for c in self._columns]).T


class OlsSolver(FixedGain):
    """Unweighted linear least squares, P >= 2 PSDs; covariance G V G^T with V the dots' own."""

    name: ClassVar[str] = 'ols'
    budgeted_as: ClassVar[str] = 'wls'

    def __init__(self, geometry: Geometry) -> None:
        """Bind to ``geometry``. Raises SolverError if the beams coincide."""
        count = check_twist(geometry)
        super().__init__(
            design_matrix(geometry.beams), np.asarray(geometry.zeros), np.ones(2 * count), geometry.arithmetic
        )
