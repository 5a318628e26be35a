# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
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

from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus

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
