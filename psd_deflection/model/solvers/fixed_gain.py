# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The driver of the linear methods: a gain matrix that does not depend on the noise."""

import numpy as np

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.model.plate.linear import gain_matrix
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus
from psd_deflection.records import FloatArray


class FixedGain(Solver):
    """x = G (m - m_0) for a gain that does not depend on the noise; covariance G V G^T."""

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
