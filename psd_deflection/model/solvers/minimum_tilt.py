# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``minimum_tilt``: the part of the thesis's section 2.3 that four readings can determine.

Section 2.3 looks for two tilts besides dX, dY and theta. Four readings cannot give five unknowns:
one dot fixes the translation, and M(q_1 - q_2) = l_1 - l_2 is two equations for three angles. With
its errors corrected (docs/methods.md), the method reproduces all four readings for *any*
admissible trial angle. So its stopping test (2.46-2.49) has no meaning.

Two things can be measured: the azimuth alpha of the base line, and its foreshortening |l_12| = |q_12| cos beta.
The smallest tilt that explains it leans the plate by beta along the base line, one way *or the other*: the dots
are the same for (phi, omega) and (-phi, -omega). A tilt about the base line does not change the dots. The answer
gives the branch that leans PSD 1 towards the base; dX, dY and theta are the same for both.

The plate is turned by alpha and then leaned by B, which carries e = l_12/|l_12| to cos beta e - sin beta z and
keeps what is across. In R = Ry(omega) Rx(phi) Rz(theta) that is theta = alpha + psi with B = Ry Rx Rz(psi),

    tan psi = (cos beta - 1) e_x e_y / (e_x^2 + cos beta e_y^2),       psi = -phi omega/2 to second order,

so that the published angles have the dots that were read. alpha itself is theta with ``angles='azimuth'``.
"""

from math import sqrt
from typing import Any, ClassVar, Literal

import numpy as np

from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.solvers.exact import ExactSolver
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus
from psd_deflection.model.solvers.plane import Covariance, turn_covariance
from psd_deflection.rig.config import Rig

Angles = Literal['rotation', 'azimuth']

_TOO_SHORT = 3.0
"""The base line may be shorter than the distance of the beams by this many standard deviations."""


class MinimumTiltSolver(Solver):
    """The least tilt along the base line that explains its length; two PSDs at height 0.

    ``INADMISSIBLE``: the base line on the plate
    is shorter than between the beams by more than three standard deviations, which no tilt
    explains. Within that, the tilt is 0 and the answer is the flat plate's. The covariance holds
    away from zero tilt; near it the tilt is not a smooth function of the readings.
    """

    name: ClassVar[str] = 'minimum_tilt'
    budgeted_as: ClassVar[str] = 'exact'

    def __init__(self, geometry: Geometry, angles: Angles = 'rotation') -> None:
        """Bind to ``geometry``.

        ``angles``: theta, phi and omega of one rotation, or theta as the base line's azimuth. Raises SolverError if the
        beams coincide or there are not two, ConfigError for other angles.
        """
        if angles not in ('rotation', 'azimuth'):
            raise ConfigError(f'minimum_tilt.angles = {angles!r}: must be one of rotation, azimuth')
        self._rotation = angles == 'rotation'
        self._xp = geometry.arithmetic
        if check_twist(geometry) != 2:
            raise SolverError('minimum_tilt takes two PSDs; with three at different heights use pose')
        if np.any(geometry.heights):
            raise SolverError(
                f'psd heights {np.asarray(geometry.heights).tolist()} m: minimum_tilt takes both surfaces at 0; '
                'the beam solver has heights in its model'
            )
        ((self._c1x, self._c1y), (self._c2x, self._c2y)) = np.asarray(geometry.centers).tolist()
        (self._l1x, self._l1y), (self._l2x, self._l2y) = geometry.beams.tolist()
        lx = self._l1x - self._l2x
        ly = self._l1y - self._l2y
        self._flat = ExactSolver(geometry)
        self._length = self._xp.hypot(lx, ly)
        self._ex = lx / self._length
        self._ey = ly / self._length

    @classmethod
    def options_from_rig(cls, rig: Rig) -> dict[str, Any]:
        """``minimum_tilt.angles``."""
        return {'angles': rig.estimator.minimum_tilt_angles}

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block, pure floats. See :class:`Solver`."""
        xp = self._xp
        x1, y1, x2, y2 = dots
        q1x = self._c1x + x1
        q1y = self._c1y + y1
        qx = q1x - self._c2x - x2
        qy = q1y - self._c2y - y2
        ex = self._ex
        ey = self._ey
        long = xp.hypot(qx, qy)
        if not long > self._length:
            flat = self._flat.solve(dots, variances)
            if flat.status is SolverStatus.OK and self._too_short(long, flat.theta, variances):
                return flat._replace(status=SolverStatus.INADMISSIBLE)
            return flat
        theta = xp.atan2(qx * ey - qy * ex, qx * ex + qy * ey)
        c, s = xp.cos_sin(theta)
        cos_beta = self._length / long
        sin_beta = sqrt((1.0 - cos_beta) * (1.0 + cos_beta))
        # Plate point 1 in the base's axes, along and across the base line.
        px = c * q1x - s * q1y
        py = s * q1x + c * q1y
        reach = px * ex + py * ey
        off = py * ex - px * ey
        back_e = self._l1x * ex + self._l1y * ey - cos_beta * reach
        back_n = self._l1y * ex - self._l1x * ey - off
        covariance = self._covariance(c * ex + s * ey, c * ey - s * ex, reach, off, cos_beta, long, variances)
        psi = xp.atan2((cos_beta - 1.0) * ex * ey, ex * ex + cos_beta * ey * ey) if self._rotation else 0.0
        return Solution(
            back_e * ex - back_n * ey,
            back_e * ey + back_n * ex,
            theta + psi,
            -xp.asin(sin_beta * ey),
            xp.atan2(sin_beta * ex, cos_beta),
            covariance,
            (0.0, 0.0, 0.0, 0.0),
            SolverStatus.OK,
            0,
        )

    def _too_short(self, long: float, theta: float, variances: tuple[float, ...]) -> bool:
        """Whether noise along the base line cannot explain that it is too short for any tilt."""
        c, s = self._xp.cos_sin(theta)
        ax = c * self._ex + s * self._ey
        ay = c * self._ey - s * self._ex
        vx1, vy1, vx2, vy2 = variances
        return self._length - long > _TOO_SHORT * sqrt(ax * ax * (vx1 + vx2) + ay * ay * (vy1 + vy2))

    def _covariance(
        self, ax: float, ay: float, reach: float, off: float, cos_beta: float, long: float, variances: tuple[float, ...]
    ) -> Covariance:
        """Sensitivities to noise along (e) and across (n) the base line, dot by dot; (ax, ay) is e."""
        lever = reach / long
        side = cos_beta * off / long
        # Of psi, by the length of the base line on the plate.
        psi_slope = 0.0
        if self._rotation:
            leaning = (1.0 - cos_beta * cos_beta) * self._ey * self._ey
            psi_slope = -cos_beta / long * self._ex * self._ey / (1.0 - leaning)
        ee = en = et = nn = nt = tt = 0.0
        for i, (e_along, e_across, n_across, t_along, t_across) in enumerate(
            (
                (-cos_beta * (1.0 - lever), -side, lever - 1.0, psi_slope, -1.0 / long),
                (-cos_beta * lever, side, -lever, -psi_slope, 1.0 / long),
            )
        ):
            vx = variances[2 * i]
            vy = variances[2 * i + 1]
            along = ax * ax * vx + ay * ay * vy
            across = ay * ay * vx + ax * ax * vy
            mixed = ax * ay * (vy - vx)
            ee += e_along * e_along * along + 2.0 * e_along * e_across * mixed + e_across * e_across * across
            e_to_across = e_along * mixed + e_across * across
            en += n_across * e_to_across
            et += t_across * e_to_across + t_along * (e_along * along + e_across * mixed)
            nn += n_across * n_across * across
            nt += n_across * (t_across * across + t_along * mixed)
            tt += t_across * t_across * across + t_along * (t_along * along + 2.0 * t_across * mixed)
        return turn_covariance(self._ex, self._ey, ee, en, nn, et, nt, tt)
