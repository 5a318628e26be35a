# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``iterative``: the thesis's section 2.2, corrected.

Turn both dots back about the tip's centroid by one trial angle theta; each PSD then gives a
translation of the tip (2.18, 2.19),

    Delta_i = l_i - R(theta) q_i.

At the right angle they agree. The thesis steps the angle by 0.01 degree, with its own angle for
each PSD. It stops at the first trial at which the signed differences are *below* a tolerance
(2.20-2.23). That is up to 57 mdeg too early, or at zero. Here both PSDs share the trial angle, and
the disagreement counts equally in x and y and in both signs. The disagreement gives a correction of
the angle, repeated until the angle no longer changes. d is then the mean of the Delta_i.
"""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.plate.plate import Number
from psd_deflection.model.solvers.interface import Solution, Solutions, Solver, SolverStatus, flat_solutions
from psd_deflection.model.solvers.plane import Nine, checked_variances, turn_covariance
from psd_deflection.records import FloatArray

_MAX_TRIALS = 50
_LAST_STEP = 1e-8
"""rad. What is left after a correction is a third of its cube, below the last digit."""


_LARGEST_STEP = 0.5
"""rad. For a larger correction the tangent is not a good approximation."""


class IterativeSolver(Solver):
    """Trial angles until the PSDs agree, P >= 2 PSDs. All dots have equal weight, whatever their noise.

    The covariance is that of this unweighted answer: G V G^T, V the dots' own.
    """

    name: ClassVar[str] = 'iterative'
    budgeted_as: ClassVar[str] = 'exact'

    def __init__(self, geometry: Geometry) -> None:
        """Bind to ``geometry``. Raises SolverError if the beams coincide."""
        self._count = check_twist(geometry)
        beams = np.asarray(geometry.beams)
        xp = self._xp = geometry.arithmetic
        middle = xp.sum(beams, axis=0) / len(beams)
        self._lx, self._ly = middle.tolist()
        self._squares = float(xp.sum(((beams - middle) ** 2).ravel(), axis=0))
        self._rows = tuple(map(tuple, np.hstack((geometry.centers, beams - middle)).tolist()))

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block, pure floats. See :class:`Solver`."""
        plate = self._plate(dots)
        mx, my, along, across = self._products(plate)
        cos_sin = self._xp.cos_sin
        theta, c, s = 0.0, 1.0, 0.0
        status = SolverStatus.NOT_CONVERGED
        trials = 0
        while trials < _MAX_TRIALS:
            trials += 1
            disagreement = across * c - along * s
            agreement = along * c + across * s
            step = disagreement / abs(agreement) if agreement else 1.0
            step = max(-_LARGEST_STEP, min(_LARGEST_STEP, step))
            theta += step
            c, s = cos_sin(theta)
            if abs(step) < _LAST_STEP:
                status = SolverStatus.OK
                break
        (dx, dy), residual, covariance = self._answer(plate, mx, my, c, s, variances)
        return Solution(dx, dy, theta, 0.0, 0.0, covariance, tuple(residual), status, trials)

    def solve_many(self, dots: FloatArray, variances: FloatArray) -> Solutions:
        """N blocks, together if all have the same variances. See :class:`Solver`."""
        v = checked_variances(variances)
        if len(v) > 1:
            return super().solve_many(dots, v)
        plate = self._plate(list(np.atleast_2d(np.asarray(dots, dtype=np.float64)).T))
        mx, my, along, across = self._products(plate)
        theta, c, s = np.zeros(len(mx)), np.ones(len(mx)), np.zeros(len(mx))
        converged = np.zeros(len(mx), dtype=bool)
        for _ in range(_MAX_TRIALS):
            disagreement = across * c - along * s
            agreement = along * c + across * s
            step = np.divide(disagreement, np.abs(agreement), out=np.ones(len(mx)), where=agreement != 0.0)
            theta = np.where(converged, theta, theta + np.clip(step, -_LARGEST_STEP, _LARGEST_STEP))
            c, s = self._xp.cos_many(theta), self._xp.sin_many(theta)
            converged |= np.abs(step) < _LAST_STEP
            if converged.all():
                break
        moved, residual, covariance = self._answer(plate, mx, my, c, s, tuple(v[0].tolist()))
        return flat_solutions((*moved, theta), covariance, residual, converged)

    def _plate(self, dots: Sequence[Number]) -> list[tuple[Number, Number, float, float]]:
        """Plate point, m, and place of the beam about the beams' middle of each PSD."""
        return [(r[0] + dots[2 * i], r[1] + dots[2 * i + 1], r[2], r[3]) for i, r in enumerate(self._rows)]

    def _products(self, plate: Sequence[tuple[Number, Number, float, float]]) -> tuple[Number, Number, Number, Number]:
        """Middle of the plate points; dot and cross product of them and the beams: all that a trial needs."""
        count = self._count
        mx = my = along = across = 0.0 * plate[0][0]
        for qx, qy, _, _ in plate:
            mx = mx + qx
            my = my + qy
        mx = mx / count
        my = my / count
        for qx, qy, lx, ly in plate:
            along = along + ((qx - mx) * lx + (qy - my) * ly)
            across = across + ((qx - mx) * ly - (qy - my) * lx)
        return mx, my, along, across

    def _answer(
        self,
        plate: Sequence[tuple[Number, Number, float, float]],
        mx: Number,
        my: Number,
        c: Number,
        s: Number,
        variances: tuple[float, ...],
    ) -> tuple[tuple[Number, Number], list[Number], Nine[Number]]:
        """dX and dY, residual and covariance at the turn (``c``, ``s``), of one block or of arrays of them."""
        moved = self._lx - c * mx + s * my, self._ly - s * mx - c * my
        residual: list[Number] = []
        for qx, qy, lx, ly in plate:
            residual.append(qx - mx - c * lx - s * ly)
            residual.append(qy - my + s * lx - c * ly)
        return moved, residual, self._covariance(c, s, mx, my, variances)

    def gain(self, dots: tuple[float, ...], variances: tuple[float, ...], solution: Solution) -> FloatArray:
        """In closed form: the disagreement stays 0 if a dot moves. See :class:`Solver`."""
        return np.array(self._gain(self._plate(dots), *self._xp.cos_sin(solution.theta)))

    def gain_many(self, dots: FloatArray, variances: tuple[float, ...], solutions: Solutions) -> FloatArray:
        """In closed form. See :class:`Solver`."""
        theta = solutions.pose[:, 2]
        rows = self._gain(self._plate(list(dots.T)), self._xp.cos_many(theta), self._xp.sin_many(theta))
        return np.array(rows).transpose(2, 0, 1)

    def _gain(
        self, plate: Sequence[tuple[Number, Number, float, float]], c: Number, s: Number
    ) -> tuple[list[Number], list[Number], list[Number]]:
        """Rows of dX, dY, theta, of one block or of arrays of blocks."""
        count = self._count
        mx = my = agreement = 0.0 * c
        for qx, qy, lx, ly in plate:
            mx = mx + qx
            my = my + qy
            # The beams are about their mean, so the dots' mean counts for nothing.
            agreement = agreement + (c * (qx * lx + qy * ly) + s * (qx * ly - qy * lx))
        mx = mx / count
        my = my / count
        gx, gy = s * mx + c * my, s * my - c * mx
        rows: tuple[list[Number], list[Number], list[Number]] = ([], [], [])
        for _, _, lx, ly in plate:
            for ax, ay, lever in ((-c, -s, c * ly - s * lx), (s, -c, -c * lx - s * ly)):
                theta = lever / agreement
                rows[0].append(ax / count + gx * theta)
                rows[1].append(ay / count + gy * theta)
                rows[2].append(theta)
        return rows

    def _covariance(self, c: Number, s: Number, mx: Number, my: Number, variances: tuple[float, ...]) -> Nine[Number]:
        """G V G^T in plate axes, turned to the base's; (mx, my) is the centroid of the plate points."""
        count = self._count
        sum_x = sum_y = 0.0
        with_x = with_y = vtt = 0.0 * c
        for i, (_, _, lx, ly) in enumerate(self._rows):
            vx = variances[2 * i]
            vy = variances[2 * i + 1]
            px = (c * lx + s * ly) / self._squares
            py = (c * ly - s * lx) / self._squares
            sum_x += vx
            sum_y += vy
            with_x = with_x + py * vx
            with_y = with_y - px * vy
            vtt = vtt + (py * py * vx + px * px * vy)
        with_x = with_x / count
        with_y = with_y / count
        squared = count * count
        return turn_covariance(
            c,
            s,
            sum_x / squared - 2.0 * my * with_x + my * my * vtt,
            mx * with_x - my * with_y - mx * my * vtt,
            sum_y / squared + 2.0 * mx * with_y + mx * mx * vtt,
            my * vtt - with_x,
            -mx * vtt - with_y,
            vtt,
        )
