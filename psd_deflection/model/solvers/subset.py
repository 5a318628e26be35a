# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Methods for some of a rig's PSDs, while the others cannot be believed.

A method takes what is left as it would take a rig that has no more. ``pose`` needs three PSDs at different heights to
see the tilts; from fewer it cannot. Then the tilts are taken from the deflection, phi = -k dY/L and omega = +k dX/L as
in ``beam``, but how much the plate tilts is not known: k is somewhere between 0 (a plate that stays parallel) and
``link.slope_ratio``. The answer is that of the middle, and its covariance allows for either end.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate.layout import Geometry
from psd_deflection.model.plate.plate import Tilts
from psd_deflection.model.solvers.beam import BeamSolver
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus
from psd_deflection.model.solvers.registry import make_solver, solver_class
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig


class PoseOfFew(Solver):
    """``pose`` from PSDs that do not see the tilts; see the module's text."""

    name: ClassVar[str] = 'pose'
    budgeted_as: ClassVar[str] = ''
    tilts: ClassVar[Tilts] = 'bounded'

    def __init__(self, geometry: Geometry) -> None:
        """Bind to ``geometry``. Raises SolverError as :class:`BeamSolver`."""
        half = geometry.slope_ratio / 2.0
        self._middle = BeamSolver(replace(geometry, slope_ratio=half))
        self._end = BeamSolver(geometry)

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block. See :class:`Solver`."""
        middle, end = self._middle.solve(dots, variances), self._end.solve(dots, variances)
        if end.status is not SolverStatus.OK:
            return end
        unknown = self.unknown(middle, end)
        covariance = np.add(np.reshape(middle.covariance, (3, 3)), unknown[:, None] * unknown)
        return middle._replace(covariance=tuple(covariance.ravel().tolist()))

    @staticmethod
    def unknown(middle: Solution, end: Solution) -> FloatArray:
        """(3,): m, m, rad, by which the answer goes from the middle to an end of what k may be."""
        return np.array([b - a for a, b in zip(middle[:3], end[:3], strict=True)])

    def allowance(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> FloatArray:
        """That of the unknown tilt. See :class:`Solver`."""
        unknown = self.unknown(self._middle.solve(dots, variances), self._end.solve(dots, variances))
        return np.asarray(unknown[:, None] * unknown)

    def gain(self, dots: tuple[float, ...], variances: tuple[float, ...], solution: Solution) -> FloatArray:
        """That of the middle. See :class:`Solver`."""
        return self._middle.gain(dots, variances, self._middle.solve(dots, variances))


def geometry_of(rig: Rig, psds: Sequence[int]) -> Geometry:
    """The geometry of ``psds`` (from 0)."""
    full = Geometry.from_rig(rig)
    at = list(psds)
    return replace(full, centers=full.centers[at], zeros=full.zeros[at], heights=full.heights[at])


def subset_solver(name: str, rig: Rig, psds: Sequence[int]) -> Solver | None:
    """The method ``name`` for ``psds`` (from 0), with the rig's options; None if it cannot do with them."""
    geometry = geometry_of(rig, psds)
    try:
        return make_solver(name, geometry, **solver_class(name).options_from_rig(rig))
    except SolverError:
        if solver_class(name).tilts != 'free':
            return None
    try:
        return PoseOfFew(geometry)
    except SolverError:
        return None


NAME = 'one_psd'


class OnePsd:
    """Bound to ``geometry``; see the module's text.

    One dot gives two equations; three unknowns stay undetermined. With the twist *given* as
    theta +- sd, the flat plate's model m = R(-theta)(l - d) - c gives d = l - R(theta)(c + m), and its
    covariance says what that costs: the dot's own noise, and sd times the arm |c + m|. Nothing is
    estimated of the twist: it comes out as it went in.
    """

    def __init__(self, geometry: Geometry) -> None:
        self._xp = geometry.arithmetic
        self._centers = [(float(x), float(y)) for x, y in np.asarray(geometry.centers)]
        self._beams = [(float(x), float(y)) for x, y in np.asarray(geometry.beams)]

    def solve(
        self, psd: int, dot: tuple[float, float], variances: tuple[float, float], theta: float, theta_variance: float
    ) -> tuple[float, float, tuple[float, ...]]:
        """(dX, dY) m and the 3 x 3 covariance of (dX, dY, theta), row by row.

        ``psd``: 0 or 1. ``dot``: its reading, m; ``variances`` of it, m^2. ``theta`` rad,
        ``theta_variance`` rad^2.
        """
        qx = self._centers[psd][0] + dot[0]
        qy = self._centers[psd][1] + dot[1]
        lx, ly = self._beams[psd]
        c, s = self._xp.cos_sin(theta)
        vx, vy = variances
        # d(d)/d(theta) = -R'(theta) q
        gx = s * qx + c * qy
        gy = -c * qx + s * qy
        xx = c * c * vx + s * s * vy + gx * gx * theta_variance
        yy = s * s * vx + c * c * vy + gy * gy * theta_variance
        xy = c * s * (vx - vy) + gx * gy * theta_variance
        xt, yt = gx * theta_variance, gy * theta_variance
        return lx - (c * qx - s * qy), ly - (s * qx + c * qy), (xx, xy, xt, xy, yy, yt, xt, yt, theta_variance)
