# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``exact``: weighted rigid registration of the plate to the beams; the default.

The flat plate's model, m_i = R(-theta)(l_i - d) - c_i, has no small angle in it. Minimise

    F = sum_i wx_i rx_i^2 + wy_i ry_i^2,     r_i = q_i - R(-theta) l_i + f,   f = R(-theta) d,

with w the inverse variances. For a given theta the best f is a weighted mean for each axis; the
rest is a function of one angle,

    F/2 = (P c^2 + 2 Q c s + R s^2)/2 - A c - B s + constant,     c = cos theta, s = sin theta.

If the weights of x and y agree, Q = 0 and P = R, and tan theta = B/A is the closed form (the
orthogonal Procrustes problem: Schoenemann 1966; Arun, Huang & Blostein 1987). For two PSDs that is
the rotation of the base line between the dots, whatever the weights of the PSDs. Otherwise Newton's
method starts there and doubles its digits each time. The covariance is (J^T W J)^-1 at the answer.
"""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from psd_deflection.base.arithmetic import Arithmetic
from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.plate.plate import Number
from psd_deflection.model.solvers.interface import Solution, Solutions, Solver, SolverStatus, flat_gain, flat_gain_many
from psd_deflection.model.solvers.plane import Four, Nine, checked_variances, turn_covariance
from psd_deflection.records import FloatArray

_MAX_STEPS = 30
_LAST_STEP = 1e-10
"""rad. Newton's next correction would be of the order of its square, below the last digit."""

_CHUNK = 4096
"""Blocks worked on at once: their intermediate arrays stay in the processor's cache."""


class ExactSolver(Solver):
    """Maximum likelihood for a flat plate, P >= 2 PSDs, exact in the angle.

    Its model ignores ``Geometry.heights`` and tilts. On the thesis rig the cantilever's tilts cause
    errors of at most some micrometres (``docs/methods.md``); the ``beam`` solver removes them.
    """

    name: ClassVar[str] = 'exact'
    budgeted_as: ClassVar[str] = 'exact'

    def __init__(self, geometry: Geometry) -> None:
        """Bind to ``geometry``. Raises SolverError if the beams coincide."""
        self._count = check_twist(geometry)
        self._xp = geometry.arithmetic
        self._centers = np.asarray(geometry.centers, dtype=np.float64)
        self._beams = np.asarray(geometry.beams, dtype=np.float64)
        self._places = tuple(self._centers.ravel().tolist())
        (self._c1x, self._c1y), (self._c2x, self._c2y) = self._centers[:2].tolist()
        (self._l1x, self._l1y), (self._l2x, self._l2y) = self._beams[:2].tolist()

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block; pure floats for two PSDs. See :class:`Solver`."""
        if self._count != 2:
            return self._solve_any(dots, variances)
        xp = self._xp
        x1, y1, x2, y2 = dots
        vx1, vy1, vx2, vy2 = variances
        try:
            # Reduced weights of the differences between the two dots: 1/(1/w1 + 1/w2).
            mx = 1.0 / (vx1 + vx2)
            my = 1.0 / (vy1 + vy2)
        except ZeroDivisionError:
            raise SolverError('solve: variances must be above 0 m^2') from None
        q1x = self._c1x + x1
        q1y = self._c1y + y1
        l1x = self._l1x
        l1y = self._l1y
        qx = q1x - self._c2x - x2
        qy = q1y - self._c2y - y2
        lx = l1x - self._l2x
        ly = l1y - self._l2y
        across = qx * ly - qy * lx
        along = qx * lx + qy * ly
        theta = xp.atan2(across, along)
        steps = 0
        status = SolverStatus.OK
        if mx == my:
            # cos and sin of the arctangent with one square root.
            size = xp.hypot(along, across)
            c, s = (along / size, across / size) if size != 0.0 else (1.0, 0.0)
        else:
            theta, c, s, steps = _newton(
                theta,
                (mx - my) * (ly * ly - lx * lx),
                (mx - my) * lx * ly,
                mx * qx * lx + my * qy * ly,
                mx * qx * ly - my * qy * lx,
                xp,
            )
        if theta != theta or steps == _MAX_STEPS:
            status = SolverStatus.NOT_CONVERGED
        dx, dy, residual, covariance = self._answer(c, s, (q1x, q1y, qx, qy), (mx, my), variances)
        return Solution(dx, dy, theta, 0.0, 0.0, covariance, residual, status, steps)

    def _answer(
        self,
        c: Number,
        s: Number,
        points: tuple[Number, Number, Number, Number],
        reduced: tuple[Number, Number],
        variances: Sequence[Number],
    ) -> tuple[Number, Number, Four[Number], Nine[Number]]:
        """dX, dY, residual and covariance at the turn (``c``, ``s``), of one block or of arrays of them.

        ``points``: plate point 1 and its difference from plate point 2; ``reduced``: weights of that difference.
        """
        q1x, q1y, qx, qy = points
        mx, my = reduced
        vx1, vy1, vx2, vy2 = variances
        lx = self._l1x - self._l2x
        ly = self._l1y - self._l2y
        # The base line under the beams, in plate axes, and the dots' difference from it.
        px = c * lx + s * ly
        py = c * ly - s * lx
        ex = (qx - px) * mx
        ey = (qy - py) * my
        rx1 = ex * vx1
        ry1 = ey * vy1
        # The plate point under beam 1: where dot 1 is, less its residual.
        p1x = q1x - rx1
        p1y = q1y - ry1
        dx = self._l1x - c * p1x + s * p1y
        dy = self._l1y - s * p1x - c * p1y
        vtt = 1.0 / (mx * py * py + my * px * px)
        # Weighted means of the plate points: of y with the weights of x, and vice versa.
        mean_y = p1y - py * vx1 * mx
        mean_x = p1x - px * vy1 * my
        vxt = mean_y * vtt
        vyt = -mean_x * vtt
        covariance = turn_covariance(
            c, s, vx1 * vx2 * mx + mean_y * vxt, -mean_x * vxt, vy1 * vy2 * my - mean_x * vyt, vxt, vyt, vtt
        )
        return dx, dy, (rx1, ry1, -ex * vx2, -ey * vy2), covariance

    def _solve_any(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """Any number of PSDs."""
        (qx, qy), (lx, ly) = (self._centers + np.reshape(dots, (-1, 2))).T, self._beams.T
        wx, wy = 1.0 / checked_variances(np.array(variances)).reshape(-1, 2).T
        xp = self._xp

        def dot(a: FloatArray, b: FloatArray) -> float:
            return float(xp.product(a, b))

        sum_x, sum_y = float(xp.sum(wx, 0)), float(xp.sum(wy, 0))
        # Each axis is centred with its own weights.
        xx, xy, xq = (a - xp.product(wx, a) / sum_x for a in (lx, ly, qx))
        yx, yy, yq = (a - xp.product(wy, a) / sum_y for a in (lx, ly, qy))
        along = dot(wx, xq * xx) + dot(wy, yq * yy)
        across = dot(wx, xq * xy) - dot(wy, yq * yx)
        difference = dot(wx, xy * xy - xx * xx) + dot(wy, yx * yx - yy * yy)
        mixed = dot(wx, xx * xy) - dot(wy, yx * yy)
        theta, c, s, steps = _newton(xp.atan2(across, along), difference, mixed, along, across, xp)
        rx = xq - c * xx - s * xy
        ry = yq - c * yy + s * yx
        px, py = qx - rx, qy - ry
        fx, fy = float(c * lx[0] + s * ly[0] - px[0]), float(c * ly[0] - s * lx[0] - py[0])
        mean_x, mean_y = dot(wy, px) / sum_y, dot(wx, py) / sum_x
        vtt = 1.0 / (dot(wx, (py - mean_y) ** 2) + dot(wy, (px - mean_x) ** 2))
        vxt, vyt = mean_y * vtt, -mean_x * vtt
        covariance = turn_covariance(
            c, s, 1.0 / sum_x + mean_y * vxt, -mean_x * vxt, 1.0 / sum_y - mean_x * vyt, vxt, vyt, vtt
        )
        residual = tuple(np.column_stack((rx, ry)).ravel().tolist())
        status = SolverStatus.NOT_CONVERGED if steps == _MAX_STEPS else SolverStatus.OK
        return Solution(c * fx - s * fy, s * fx + c * fy, theta, 0.0, 0.0, covariance, residual, status, steps)

    def gain(self, dots: tuple[float, ...], variances: tuple[float, ...], solution: Solution) -> FloatArray:
        """In closed form. See :class:`Solver`."""
        return flat_gain(self._places, dots, variances, solution, self._xp)

    def gain_many(self, dots: FloatArray, variances: tuple[float, ...], solutions: Solutions) -> FloatArray:
        """In closed form. See :class:`Solver`."""
        return flat_gain_many(self._places, dots, variances, solutions, self._xp)

    def solve_many(self, dots: FloatArray, variances: FloatArray) -> Solutions:
        """N blocks; vectorised for two PSDs. See :class:`Solver`."""
        if self._count != 2:
            return super().solve_many(dots, variances)
        m = np.atleast_2d(np.asarray(dots, dtype=np.float64))
        v = checked_variances(variances)
        n = len(m)
        out = Solutions(np.empty((n, 3)), np.zeros((n, 2)), np.empty((n, 3, 3)), np.empty((n, 4)), np.empty(n, np.int8))
        for start in range(0, n, _CHUNK):
            part = slice(start, start + _CHUNK)
            self._chunk(m[part], v[part] if len(v) > 1 else v, out, part)
        return out

    def _chunk(self, m: FloatArray, v: FloatArray, out: Solutions, part: slice) -> None:
        """The lines of :meth:`solve`, for arrays."""
        xp = self._xp
        x1, y1, x2, y2 = m.T
        vx1, vy1, vx2, vy2 = v.T
        mx = 1.0 / (vx1 + vx2)
        my = 1.0 / (vy1 + vy2)
        q1x = self._c1x + x1
        q1y = self._c1y + y1
        qx = q1x - self._c2x - x2
        qy = q1y - self._c2y - y2
        lx = self._l1x - self._l2x
        ly = self._l1y - self._l2y
        across = qx * ly - qy * lx
        along = qx * lx + qy * ly
        theta = xp.atan2_many(across, along)
        converged = np.isfinite(theta)
        size = xp.hypot_many(along, across)
        with np.errstate(invalid='ignore'):
            c = np.where(size != 0.0, along / size, 1.0)
            s = np.where(size != 0.0, across / size, 0.0)
        same = mx == my
        if not same.all():
            rotated, ended = _newton_many(
                theta,
                (mx - my) * (ly * ly - lx * lx),
                (mx - my) * lx * ly,
                mx * qx * lx + my * qy * ly,
                mx * qx * ly - my * qy * lx,
                xp,
            )
            theta, converged = np.where(same, theta, rotated), np.where(same, converged, ended)
            c, s = np.where(same, c, xp.cos_many(rotated)), np.where(same, s, xp.sin_many(rotated))
        dx, dy, residual, covariance = self._answer(c, s, (q1x, q1y, qx, qy), (mx, my), tuple(v.T))
        for where, values in (
            (out.pose, (dx, dy, theta)),
            (out.residual, residual),
            (out.covariance.reshape(-1, 9), covariance),
        ):
            for i, value in enumerate(values):
                where[part, i] = value
        out.status[part] = np.where(converged, SolverStatus.OK, SolverStatus.NOT_CONVERGED)


def _newton(
    theta: float, difference: float, mixed: float, along: float, across: float, xp: Arithmetic
) -> tuple[float, float, float, int]:
    """Minimise F from ``theta``: difference R - P, mixed Q, along A, across B of the module's text."""
    c, s = xp.cos_sin(theta)
    steps = 0
    while steps < _MAX_STEPS:
        steps += 1
        cos_2 = c * c - s * s
        slope = difference * s * c + mixed * cos_2 + along * s - across * c
        curvature = difference * cos_2 - 4.0 * mixed * s * c + along * c + across * s
        # The magnitude of the curvature makes every step go downhill.
        step = slope / abs(curvature)
        theta -= step
        c, s = xp.cos_sin(theta)
        if abs(step) < _LAST_STEP:
            break
    return theta, c, s, steps


def _newton_many(
    theta: FloatArray, difference: FloatArray, mixed: FloatArray, along: FloatArray, across: FloatArray, xp: Arithmetic
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """:func:`_newton` for n blocks, until the slowest ends; also returns which converged."""
    converged = np.zeros(theta.shape, dtype=bool)
    for _ in range(_MAX_STEPS):
        c = xp.cos_many(theta)
        s = xp.sin_many(theta)
        cos_2 = c * c - s * s
        slope = difference * s * c + mixed * cos_2 + along * s - across * c
        curvature = difference * cos_2 - 4.0 * mixed * s * c + along * c + across * s
        step = np.where(converged, 0.0, slope / np.abs(curvature))
        theta = theta - step
        converged = np.abs(step) < _LAST_STEP
        if converged.all():
            break
    return theta, converged
