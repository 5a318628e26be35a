# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``pose``: three or more PSDs at different heights see the tilts themselves, without a beam theory.

Coplanar surfaces under parallel beams see a tilt only through foreshortening: nothing at zero tilt, a
noise of 0.2 degree at 0.3 degree, and never its sign. Surfaces at different heights turn a tilt into
a displacement of h tan(tilt): with h = (+100, -50, -50) mm and 2 um of noise the tilts have a
deviation of about a millidegree. Five unknowns, 2P readings, Gauss-Newton from the flat plate's
answer.
"""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate.layout import SMALLEST_BASE_LINE, Geometry, check_twist
from psd_deflection.model.plate.plate import Tilts, crossing, crossings, flat_poses
from psd_deflection.model.solvers.gauss_newton import answer, fit
from psd_deflection.model.solvers.interface import Solution, Solver
from psd_deflection.records import FloatArray


class PoseSolver(Solver):
    """dX, dY, theta, phi and omega, all free; P >= 3 PSDs whose surfaces are not in one plane."""

    name: ClassVar[str] = 'pose'
    budgeted_as: ClassVar[str] = ''
    tilts: ClassVar[Tilts] = 'free'

    def __init__(self, geometry: Geometry) -> None:
        """Bind to ``geometry``.

        Raises SolverError with the reason if the tilts cannot be seen: two PSDs, surfaces at one
        height, or surfaces on one line in space.
        """
        if check_twist(geometry) == 2:
            raise SolverError(
                'two PSDs give 4 readings for 5 unknowns (ΔX, ΔY, θ, φ, ω): a tilt about their base line '
                'changes nothing; use a third PSD, or the beam solver, which ties the tilts to the deflection'
            )
        heights = np.asarray(geometry.heights, dtype=np.float64)
        if np.ptp(heights) < SMALLEST_BASE_LINE:
            raise SolverError(
                f'all PSD surfaces are at height {heights[0]:g} m: coplanar surfaces do not see a tilt at rest, '
                'nor ever its sign; stagger psd_N.height'
            )
        places = np.column_stack((geometry.beams, heights))
        singular_values = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        if singular_values[1] < SMALLEST_BASE_LINE:
            raise SolverError(
                'the PSD surfaces lie on one line in space: turning the plate about it changes no dot, so that '
                'twist and tilt cannot be distinguished; move one PSD off the line'
            )
        self._centers = np.asarray(geometry.centers, dtype=np.float64)
        self._beams = np.asarray(geometry.beams, dtype=np.float64)
        self._heights = heights
        self._xp = geometry.arithmetic
        self._rows = tuple(map(tuple, places.tolist()))

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block. See :class:`Solver`."""
        points = np.asarray(dots).reshape(-1, 2) + self._centers
        start = flat_poses(points, self._beams, self._xp).tolist()
        minimum = fit(self._model, [*start, 0.0, 0.0], points.ravel().tolist(), variances, self._xp)
        return answer(minimum, minimum.parameters, minimum.covariance)

    def gain(self, dots: tuple[float, ...], variances: tuple[float, ...], solution: Solution) -> FloatArray:
        """(J^T W J)^-1 J^T W at the answer. See :class:`Solver`."""
        xp = self._xp
        slopes = crossings(np.array(solution[:5]), self._beams, self._heights, xp)[1].reshape(-1, 5)
        weighted = slopes.T / np.array(variances)
        return xp.solve(xp.product(weighted, slopes), weighted)[:3]

    def _model(self, x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
        dx, dy, theta, phi, omega = x
        predicted: list[float] = []
        rows: list[Sequence[float]] = []
        for place in self._rows:
            qx, qy, jx, jy = crossing(place, (dx, dy, theta, phi, omega), self._xp)
            predicted.append(qx)
            predicted.append(qy)
            rows.append(jx)
            rows.append(jy)
        return predicted, rows
