# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``wls_exact``: the linear answer of ``wls``, with the linearisation error removed exactly.

On a flat plate b = m - m_0 = (R(-theta) - I) l_i - f, f = R(-theta) d. Put into the weighted linear
solution this gives, for any weights and any size of angle,

    theta' = sin theta - kappa (1 - cos theta),
    dX'    = f_x - ybar_x (sin theta - theta') + xbar_x (1 - cos theta),
    dY'    = f_y + xbar_y (sin theta - theta') + ybar_y (1 - cos theta),

with means of the beams weighted by wx (.._x) and wy (.._y) and kappa a number of the rig and the
weights (0 if the weights of x and y agree: then theta = asin theta'). One arcsine inverts it. The
readings are combined as ``wls`` combines them, ``thesis`` weights included.
"""

from typing import Any, ClassVar

import numpy as np

from psd_deflection.model.plate.layout import Geometry
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus
from psd_deflection.model.solvers.plane import turn_covariance
from psd_deflection.model.solvers.wls import THESIS_ROW_SCALING, Weights, WlsSolver
from psd_deflection.rig.config import Rig


class WlsExactSolver(Solver):
    """``wls`` without the small-angle approximation, P >= 2 PSDs; same options as :class:`WlsSolver`.

    ``INADMISSIBLE``: the readings need a sine above 1. The residual is that of the linear model of
    ``wls``, because the readings are combined in the same way.
    """

    name: ClassVar[str] = 'wls_exact'
    budgeted_as: ClassVar[str] = 'exact'

    def __init__(
        self,
        geometry: Geometry,
        weights: Weights = 'inverse_variance',
        row_scaling: tuple[float, ...] = THESIS_ROW_SCALING,
    ) -> None:
        """Bind to ``geometry``; same options and errors as :class:`WlsSolver`."""
        self._xp = geometry.arithmetic
        self._wls = WlsSolver(geometry, weights, row_scaling)
        self._rows = tuple((lx, ly) for lx, ly in np.asarray(geometry.beams).tolist())
        self._fixed = tuple([s * s for s in row_scaling]) if weights == 'thesis' else None

    @classmethod
    def options_from_rig(cls, rig: Rig) -> dict[str, Any]:
        """The same as for ``wls``."""
        return WlsSolver.options_from_rig(rig)

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block, pure floats. See :class:`Solver`."""
        linear = self._wls.solve(dots, variances)
        w = self._fixed if self._fixed is not None else tuple([1.0 / v for v in variances])
        sum_x = sum_y = xx = xy = yx = yy = 0.0
        for i, (lx, ly) in enumerate(self._rows):
            wx = w[2 * i]
            wy = w[2 * i + 1]
            sum_x += wx
            sum_y += wy
            xx += wx * lx
            xy += wx * ly
            yx += wy * lx
            yy += wy * ly
        xx /= sum_x
        xy /= sum_x
        yx /= sum_y
        yy /= sum_y
        xp = self._xp
        squares = mixed = 0.0
        for i, (lx, ly) in enumerate(self._rows):
            wx = w[2 * i]
            wy = w[2 * i + 1]
            squares += wx * xp.square(ly - xy) + wy * xp.square(lx - yx)
            mixed += wx * (ly - xy) * lx - wy * (lx - yx) * ly
        kappa = mixed / squares
        sine = (linear.theta + kappa) / xp.hypot(1.0, kappa)
        if not -1.0 <= sine <= 1.0:
            status = SolverStatus.INADMISSIBLE if sine == sine else SolverStatus.NOT_CONVERGED
            return linear._replace(status=status)
        theta = xp.asin(sine) - xp.atan(kappa)
        c, s = xp.cos_sin(theta)
        # (1 - cos) by the half angle: no digits are lost at small angles.
        versine = 2.0 * xp.square(xp.sin(0.5 * theta))
        fx = linear.dx + xy * (s - linear.theta) - xx * versine
        fy = linear.dy - yx * (s - linear.theta) - yy * versine
        # Derivative of this answer by the linear answer, in plate axes.
        slope = 1.0 / (c - kappa * s)
        tx = -fy * slope + xy * (c * slope - 1.0) - xx * s * slope
        ty = fx * slope - yx * (c * slope - 1.0) - yy * s * slope
        vxx, vxy, vxt, _, vyy, vyt, _, _, vtt = linear.covariance
        covariance = turn_covariance(
            c,
            s,
            vxx + 2.0 * tx * vxt + tx * tx * vtt,
            vxy + tx * vyt + ty * vxt + tx * ty * vtt,
            vyy + 2.0 * ty * vyt + ty * ty * vtt,
            (vxt + tx * vtt) * slope,
            (vyt + ty * vtt) * slope,
            vtt * slope * slope,
        )
        return linear._replace(dx=c * fx - s * fy, dy=s * fx + c * fy, theta=theta, covariance=covariance)
