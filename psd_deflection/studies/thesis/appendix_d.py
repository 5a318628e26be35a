# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The thesis's methods as printed: sections 2.2 and 2.3, and the MATLAB code of Appendix D; for comparison only."""

from math import acos, atan, atan2, cos, hypot, inf, nan, pi, remainder, sin, sqrt, tan
from typing import ClassVar, Literal, NamedTuple, get_args

import numpy as np

from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.plate.plate import flat_points, plate_points
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus
from psd_deflection.model.solvers.ols import FixedGain
from psd_deflection.model.solvers.wls import THESIS_ROW_SCALING
from psd_deflection.records import FloatArray

Criterion = Literal['printed', 'absolute', 'argmin']

TOLERANCE = 0.1e-3
"""m: the "arbitrary tolerance" of 2.20-2.23, as in the code of Appendix D."""

STEP_DEG = 0.01
LAST_TRIAL = 400
"""Trials go to 4 degrees, as in Appendix D."""

NO_COVARIANCE = (float('nan'),) * 9
"""A threshold has no derivative, so there is no covariance."""

_THETA = [sign * STEP_DEG * trial * pi / 180.0 for trial in range(LAST_TRIAL + 1) for sign in (-1.0, 1.0)]
"""rad: at each trial clockwise first (2.18), then counter-clockwise (2.19)."""

_C = np.array([cos(theta) for theta in _THETA])
_S = np.array([sin(theta) for theta in _THETA])


class IterativePrintedSolver(Solver):
    """PageSection 2.2 with its threshold; two PSDs. ``NO_HIT``, without numbers, if no trial passes.

    The covariance is NaN: the answer is a step function of the readings.

    Trial angles a = 0, 0.01, ... degree; both dots are rotated back clockwise, then counter-clockwise.
    The answer is the first trial at which PSD 1's translation minus PSD 2's is below a tolerance of 0.1
    mm in x and in y (2.20-2.23). There are three variants of the test:

    - ``printed``: no magnitudes, as printed. A large negative difference passes too.
    - ``absolute``: with magnitudes, as probably intended. The first trial inside a window of 0.1 mm over the
      base line's reach is taken, so that |theta| comes out up to 57 mdeg too small and dX, dY, taken from
      PSD 1 alone, off by that times its lever of 70 mm: about 0.07 mm.
    - ``argmin``: on the same grid of angles, the least difference, and the mean of both PSDs. Off by half a
      step at most.

    ``iterative`` is the corrected method.
    """

    name: ClassVar[str] = 'iterative_printed'
    budgeted_as: ClassVar[str] = 'thesis_iteration'

    def __init__(self, geometry: Geometry, criterion: Criterion = 'printed') -> None:
        """Bind to ``geometry``. Raises SolverError if the beams coincide or there are not two."""
        if check_twist(geometry) != 2:
            raise SolverError(f'{self.name} takes two PSDs; of more take exact, or pose if their heights differ')
        if criterion not in get_args(Criterion):
            raise ConfigError(f'criterion = {criterion!r}: must be one of {", ".join(get_args(Criterion))}')
        self._criterion = criterion
        self._c = tuple(np.asarray(geometry.centers).ravel().tolist())
        self._l = tuple(np.asarray(geometry.beams).ravel().tolist())

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """Return one block, all trials at once. See :class:`Solver`."""
        q1x, q1y, q2x, q2y = (c + m for c, m in zip(self._c, dots, strict=True))
        l1x, l1y, l2x, l2y = self._l
        # The translation that each PSD gives at each trial.
        dx = l1x - (_C * q1x - _S * q1y)
        dy = l1y - (_S * q1x + _C * q1y)
        gap_x = dx - (l2x - (_C * q2x - _S * q2y))
        gap_y = dy - (l2y - (_S * q2x + _C * q2y))
        at, converged = 0, False
        if self._criterion == 'argmin':
            square = gap_x * gap_x + gap_y * gap_y
            dx, dy = dx - 0.5 * gap_x, dy - 0.5 * gap_y
            at, converged = int(np.argmin(square)), bool(np.isfinite(square).all())
        else:
            if self._criterion == 'absolute':
                gap_x, gap_y = np.abs(gap_x), np.abs(gap_y)
            hits = (gap_x < TOLERANCE) & (gap_y < TOLERANCE)
            at, converged = int(np.argmax(hits)), bool(hits.any())
        if not converged:
            nan = float('nan')
            return Solution(nan, nan, nan, 0.0, 0.0, NO_COVARIANCE, (nan,) * 4, SolverStatus.NO_HIT, LAST_TRIAL + 1)
        x, y, c, s = float(dx[at]), float(dy[at]), float(_C[at]), float(_S[at])
        residual: list[float] = []
        for i in (0, 2):
            ux = self._l[i] - x
            uy = self._l[i + 1] - y
            residual.append(dots[i] + self._c[i] - (c * ux + s * uy))
            residual.append(dots[i + 1] + self._c[i + 1] - (c * uy - s * ux))
        trials = LAST_TRIAL + 1 if self._criterion == 'argmin' else at // 2 + 1
        return Solution(x, y, _THETA[at], 0.0, 0.0, NO_COVARIANCE, tuple(residual), SolverStatus.OK, trials)


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
    dots_mm: tuple[float, ...], init_mm: tuple[float, ...], centers_mm: tuple[float, ...] = (0.0, 70.0, -100.0, 0.0)
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
        angle = 0.01 * pi / 180.0 * a
        x1_a = d1 * sin(start_1 + angle)
        y1_a = d1 * cos(start_1 + angle)
        x1_b = d1 * sin(start_1 - angle)
        y1_b = d1 * cos(start_1 - angle)
        x2_a = -d2 * cos(start_2 + angle)
        y2_a = d2 * sin(start_2 + angle)
        x2_b = -d2 * cos(start_2 - angle)
        y2_b = d2 * sin(start_2 - angle)
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


def printed_design_matrix(geometry: Geometry) -> FloatArray:
    """Return a (4, 3) of 4.12 as the code fills it in, in m; its angle is positive clockwise.

    R_1 and R_2 are the centres' distances from the tip's origin; -90 and -180 degrees are constants of
    the code, whatever the rig.
    """
    r1, r2 = np.hypot(*np.asarray(geometry.centers, dtype=np.float64).T).tolist()
    return np.array([[-1.0, 0.0, r1], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, -r2]])


class AppendixDOlsSolver(FixedGain):
    """Appendix D, "Simple Least Squares". theta is the code's angle, clockwise, with its sign changed.

    Its matrix (4.12 with theta_1 = -90, theta_2 = -180 degrees) has rows of two different rigs: with PSD 1
    above and PSD 2 on the -X side, the torsion entries of the two PSDs disagree in sign. A twist theta then
    comes out as 0.342 theta in plain least squares, 0.912 theta with the sidebar's weights (which suppress x1
    and with it most of the contradiction: the thesis found them "closest to calibration data"), and -0.995
    theta with those for direct loads (which suppress y2). The pre-load readings are not subtracted.
    """

    name: ClassVar[str] = 'appendix_d_ols'
    budgeted_as: ClassVar[str] = ''

    def __init__(self, geometry: Geometry, row_scaling: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)) -> None:
        """Bind to ``geometry``; ``row_scaling`` (4,): Po. Raises SolverError unless there are two PSDs."""
        if check_twist(geometry) != 2:
            raise SolverError(f'{self.name} takes two PSDs; of more take exact, or pose if their heights differ')
        design = printed_design_matrix(geometry) * np.array([1.0, 1.0, -1.0])
        super().__init__(design, np.zeros((2, 2)), np.array(row_scaling, dtype=np.float64), geometry.arithmetic)


class AppendixDWlsSolver(AppendixDOlsSolver):
    """Appendix D, "Weighted Least Squares": the same matrix with rows scaled by Po."""

    name: ClassVar[str] = 'appendix_d_wls'

    def __init__(self, geometry: Geometry, row_scaling: tuple[float, ...] = THESIS_ROW_SCALING) -> None:
        """Bind to ``geometry``; ``row_scaling`` (4,): Po. Raises SolverError unless there are two PSDs."""
        super().__init__(geometry, row_scaling)


class TiltBranch(NamedTuple):
    """One of the tilts that explain the dots at a given twist: m and rad."""

    dx: float
    dy: float
    phi: float
    omega: float


class Compared(NamedTuple):
    """What an equation gives: ``printed`` (NaN: imaginary), ``corrected``, and what is ``true``, in ``unit``."""

    equation: str
    unit: str
    printed: float
    corrected: float
    true: float


def hats(geometry: Geometry, dots: tuple[float, ...], theta: float) -> FloatArray:
    """(2.32), corrected: coordinates (2, 2), m, of both dots on the axes that are turned back by ``theta``."""
    c, s = cos(theta), sin(theta)
    places = np.asarray(geometry.centers) + np.reshape(dots, (2, 2))
    return np.asarray(places @ np.array([[c, s], [-s, c]]))


def tilt_branches(geometry: Geometry, dots: tuple[float, ...], theta: float) -> tuple[TiltBranch, ...]:
    """Return all (dX, dY, phi, omega) that give exactly these dots at twist ``theta``: none, or four.

    (2.33) to (2.43), corrected:

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
    for axis, angle, apart in (('y', 'phi', l1y - l2y), ('x', 'omega', l1x - l2x)):
        if abs(apart) < 1e-6:
            raise SolverError(f'both beams have the same {axis}: {angle} has no part in their base line')
    (x1, y1), (x2, y2) = hats(geometry, dots, theta).tolist()
    # Rounding may carry an untilted plate past 1 by a few digits; more is a contradiction.
    cos_phi = (l1y - l2y) / (y1 - y2) if y1 != y2 else nan
    if not abs(cos_phi) <= 1.0 + 1e-12:
        return ()
    cos_phi = min(1.0, cos_phi)
    phi = acos(cos_phi)
    dy = l2y - y2 * cos_phi
    branches = []
    for signed in (phi, -phi):
        p1 = y1 * sin(signed)
        p2 = y2 * sin(signed)
        cosine = (l1x - l2x) / hypot(p1 - p2, x1 - x2)
        if not abs(cosine) <= 1.0 + 1e-12:
            return ()
        apart = acos(max(-1.0, min(1.0, cosine)))
        middle = atan2(p1 - p2, x1 - x2)
        for sum_ in (middle + apart, middle - apart):
            omega = remainder(sum_, 2.0 * np.pi)
            branches.append(TiltBranch(l1x - x1 * cos(omega) - p1 * sin(omega), dy, signed, omega))
    return tuple(branches)


def compared(geometry: Geometry, pose: FloatArray) -> list[Compared]:
    """(2.36) to (2.45) at the true twist of ``pose`` (5,): dX, dY m, theta, phi, omega rad.

    The chain as printed ends at (2.38), whose root is imaginary. So each printed equation is given the corrected values
    of those before it. Two PSDs at height 0. theta is counter-clockwise, the thesis's clockwise; ``x_i`` of (2.32) is
    read as X_i, and its distances as the coordinates whose signs the text asks for: (X^_i, Y^_i) = R(theta) q_i.
    """
    dx, dy, theta, phi, omega = pose.tolist()
    dots = tuple((plate_points(pose[None], geometry.beams, geometry.heights)[0] - geometry.centers).ravel().tolist())
    (x1, y1), (x2, y2) = hats(geometry, dots, theta).tolist()
    p1, p2 = y1 * sin(phi), y2 * sin(phi)
    (l1x, l1y), (l2x, l2y) = geometry.beams.tolist()
    g_x, g_y = l2x - l1x, l1y - l2y

    def off(branch: TiltBranch) -> float:
        return hypot(branch.phi - phi, branch.omega - omega)

    best = min(tilt_branches(geometry, dots, theta), key=off)
    by_sum = hypot(p1 - p2, x1 - x2)
    difference = (p2 - p1) ** 2 - (x2 - x1) ** 2
    # 2.39-2.41, given the corrected DT, and lengths for G_x and the difference.
    summed = acos(abs(x2 - x1) / by_sum) + acos(min(abs(g_x) / by_sum, 1.0))
    # 2.42: consistent, with omega counted the other way.
    by_printed = -(x1 * cos(-omega) - p1 * sin(-omega))
    out = [
        Compared('2.36 ΔY', 'm', g_y / (y1 / y2 - 1.0) if y2 else 0.0, best.dy, dy),
        Compared('2.38 DT', 'm', sqrt(difference) if difference >= 0.0 else nan, by_sum, by_sum),
        Compared('2.41 |ω|', 'rad', summed, abs(best.omega), abs(omega)),
        Compared('2.42 ΔX', 'm', by_printed, best.dx, dx),
    ]
    for psd, x, p, l_x in ((1, x1, p1, l1x), (2, x2, p2, l2x)):
        # 2.44 and 2.45 along X^: what takes the dot of the tilted plate to that of a flat one.
        first, stretch = p * tan(omega), 1.0 / cos(omega) - 1.0
        out.append(
            Compared(
                f'2.44, 2.45 δX^ of PSD {psd}', 'm', first - dx * stretch, first - (l_x - dx) * stretch, l_x - dx - x
            )
        )
    return out


def mismatch(geometry: Geometry, dots: tuple[float, ...], theta: float) -> float:
    """The stopping test (2.46) to (2.49), corrected: how far any branch at a trial ``theta`` is off the readings, m.

    ``inf`` if the trial angle has no branch.
    """
    poses = np.array([[b.dx, b.dy, theta, b.phi, b.omega] for b in tilt_branches(geometry, dots, theta)])
    if not len(poses):
        return inf
    made = plate_points(poses, geometry.beams, geometry.heights) - geometry.centers
    return float(np.abs(made.reshape(len(poses), 4) - dots).max())
