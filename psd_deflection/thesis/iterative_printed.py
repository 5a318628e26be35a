"""``iterative_printed``: the thesis's section 2.2 as printed; for comparison only.

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

from __future__ import annotations

from math import cos, pi, sin
from typing import ClassVar, Literal, get_args

import numpy as np

from psd_deflection.errors import ConfigError, SolverError
from psd_deflection.geometry.layout import Geometry, check_twist
from psd_deflection.geometry.plate import flat_points
from psd_deflection.records import FloatArray
from psd_deflection.solvers.interface import Solution, Solutions, Solver, SolverStatus
from psd_deflection.solvers.plane import split

Criterion = Literal['printed', 'absolute', 'argmin']

TOLERANCE = 0.1e-3
"""m: the "arbitrary tolerance" of 2.20-2.23, as in the code of Appendix D."""

STEP_DEG = 0.01
LAST_TRIAL = 400
"""Trials go to 4 degrees, as in Appendix D."""

NO_COVARIANCE = (float('nan'),) * 9
"""A threshold has no derivative, so there is no covariance."""

_CHUNK = 4096


class IterativePrintedSolver(Solver):
    """Section 2.2 with its threshold; two PSDs. ``NO_HIT``, without numbers, if no trial passes.

    The covariance is NaN: the answer is a step function of the readings.
    """

    name: ClassVar[str] = 'iterative_printed'
    budgeted_as: ClassVar[str] = 'thesis_iteration'

    def __init__(self, geometry: Geometry, criterion: Criterion = 'printed') -> None:
        """Bind to ``geometry``. Raises SolverError if the beams coincide or there are not two."""
        if check_twist(geometry) != 2:
            raise SolverError(f'{self.name} takes two PSDs')
        if criterion not in get_args(Criterion):
            raise ConfigError(f'criterion = {criterion!r}: must be one of {", ".join(get_args(Criterion))}')
        self._criterion = criterion
        self._centers = np.asarray(geometry.centers, dtype=np.float64)
        self._beams = np.asarray(geometry.beams, dtype=np.float64)
        self._c = tuple(self._centers.ravel().tolist())
        self._l = tuple(self._beams.ravel().tolist())

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block, pure floats. See :class:`Solver`."""
        q1x, q1y, q2x, q2y = (c + m for c, m in zip(self._c, dots, strict=True))
        l1x, l1y, l2x, l2y = self._l
        absolute = self._criterion == 'absolute'
        argmin = self._criterion == 'argmin'
        least = float('inf')
        best: tuple[float, float, float] | None = None
        trials = 0
        for trial in range(LAST_TRIAL + 1):
            trials += 1
            # Clockwise first (2.18), then counter-clockwise (2.19).
            for theta in (-STEP_DEG * trial * pi / 180.0, STEP_DEG * trial * pi / 180.0):
                c = cos(theta)
                s = sin(theta)
                dx = l1x - (c * q1x - s * q1y)
                dy = l1y - (s * q1x + c * q1y)
                gap_x = dx - (l2x - (c * q2x - s * q2y))
                gap_y = dy - (l2y - (s * q2x + c * q2y))
                if argmin:
                    square = gap_x * gap_x + gap_y * gap_y
                    if square < least:
                        least = square
                        best = (dx - 0.5 * gap_x, dy - 0.5 * gap_y, theta)
                    continue
                if absolute:
                    gap_x = abs(gap_x)
                    gap_y = abs(gap_y)
                if gap_x < TOLERANCE and gap_y < TOLERANCE:
                    return self._solution(dx, dy, theta, dots, trials)
        if best is None:
            nan = float('nan')
            return Solution(nan, nan, nan, 0.0, 0.0, NO_COVARIANCE, (nan,) * 4, SolverStatus.NO_HIT, trials)
        return self._solution(*best, dots, trials)

    def _solution(self, dx: float, dy: float, theta: float, dots: tuple[float, ...], trials: int) -> Solution:
        c = cos(theta)
        s = sin(theta)
        residual: list[float] = []
        for i in (0, 2):
            ux = self._l[i] - dx
            uy = self._l[i + 1] - dy
            residual.append(dots[i] + self._c[i] - (c * ux + s * uy))
            residual.append(dots[i + 1] + self._c[i + 1] - (c * uy - s * ux))
        return Solution(dx, dy, theta, 0.0, 0.0, NO_COVARIANCE, tuple(residual), SolverStatus.OK, trials)

    def solve_many(self, dots: FloatArray, variances: FloatArray) -> Solutions:
        """N blocks. See :class:`Solver`."""
        x, y, _, _ = split(dots, variances)
        n = len(x)
        pose = np.full((n, 3), np.nan)
        for start in range(0, n, _CHUNK):
            part = slice(start, start + _CHUNK)
            self._search(self._centers[:, 0] + x[part], self._centers[:, 1] + y[part], pose[part])
        points = np.stack((x, y), axis=-1) + self._centers
        residual = (points - flat_points(pose, self._beams)).reshape(n, -1)
        status = np.where(np.isfinite(pose[:, 2]), SolverStatus.OK, SolverStatus.NO_HIT).astype(np.int8)
        return Solutions(pose, np.zeros((n, 2)), np.full((n, 3, 3), np.nan), residual, status)

    def _search(self, qx: FloatArray, qy: FloatArray, pose: FloatArray) -> None:
        """Fill ``pose`` (n, 3) in place; a row without a hit stays NaN."""
        l1x, l1y, l2x, l2y = self._l
        open_ = np.ones(len(qx), dtype=bool)
        least = np.full(len(qx), np.inf)
        for trial in range(LAST_TRIAL + 1):
            for theta in (-STEP_DEG * trial * pi / 180.0, STEP_DEG * trial * pi / 180.0):
                c = cos(theta)
                s = sin(theta)
                dx = l1x - (c * qx[:, 0] - s * qy[:, 0])
                dy = l1y - (s * qx[:, 0] + c * qy[:, 0])
                gap_x = dx - (l2x - (c * qx[:, 1] - s * qy[:, 1]))
                gap_y = dy - (l2y - (s * qx[:, 1] + c * qy[:, 1]))
                if self._criterion == 'argmin':
                    square = gap_x * gap_x + gap_y * gap_y
                    hit = square < least
                    least[hit] = square[hit]
                    dx -= 0.5 * gap_x
                    dy -= 0.5 * gap_y
                else:
                    if self._criterion == 'absolute':
                        gap_x = np.abs(gap_x)
                        gap_y = np.abs(gap_y)
                    hit = open_ & (gap_x < TOLERANCE) & (gap_y < TOLERANCE)
                    open_ &= ~hit
                pose[hit, 0] = dx[hit]
                pose[hit, 1] = dy[hit]
                pose[hit, 2] = theta
            if not open_.any():
                break
