# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``base_pair``: lasers at the tip, PSDs at the base, in two planes (the thesis's section 5.3).

Here the tip's tilt turns the beams: PSD i, a distance L_i = -h_i below the tip, sees

    X_i = dX + a_ix/cos(omega) - L_i tan(omega),
    Y_i = dY + a_iy/cos(phi) - a_ix tan(omega) tan(phi) + L_i tan(phi)/cos(omega),     a_i = R(theta) l_i,

which is exact for R = Ry(omega) Rx(phi) Rz(theta). 5.4-5.7 are its small-angle form with theta = 0
(their tan phi is -tan phi here; 5.3's factor of 1.5 *opposes* the translation: for PSDs at the clamp
a dot moves by (1 - k) dY, which at k = 1 is Fig. 5.9, nothing at all).

5.6 assumes equal translations of both lasers, which is false under torsion: then 0.1 degree of twist
is read as 1 mm of dY. Four readings cannot give five unknowns, so the caller must choose an
assumption: ``no_twist`` (5.3's own assumption: dX, dY, phi, omega), or ``beam`` (phi = -k dY/L, omega
= +k dX/L: dX, dY, theta, and one plane is enough unless k L_i/L = 1).
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.model.plate.landing import landing
from psd_deflection.model.plate.layout import SMALLEST_BASE_LINE, Geometry, check_twist
from psd_deflection.model.plate.plate import tie_matrix
from psd_deflection.model.solvers.beam import slope_per_metre
from psd_deflection.model.solvers.gauss_newton import answer, fit
from psd_deflection.model.solvers.interface import Solution, Solver
from psd_deflection.rig.config import Rig

Assume = Literal['beam', 'no_twist', 'nothing']

_SMALLEST_GAIN = 1e-3
"""If a dot moves by less than this per unit of an unknown, the unknown counts as unseen."""


class BasePairSolver(Solver):
    """PSDs fixed to the base, lasers on the tip plate, beams along -Z of the plate; P >= 2.

    ``Geometry.centers``: of the PSDs, in base axes. ``heights``: of their planes over the tip section,
    below zero: -L_i. ``beams`` = centers + zeros: the lasers' places on the plate. Dots are in base axes.
    """

    name: ClassVar[str] = 'base_pair'
    budgeted_as: ClassVar[str] = ''
    psds_at: ClassVar[Literal['tip', 'base']] = 'base'

    def __init__(self, geometry: Geometry, assume: Assume = 'beam') -> None:
        """Bind to ``geometry`` under the assumption ``assume`` (see the module).

        Raises ConfigError for another assumption, SolverError with the reason if an unknown cannot be seen.
        """
        self._count = check_twist(geometry)
        self._xp = geometry.arithmetic
        heights = np.asarray(geometry.heights, dtype=np.float64)
        for i, height in enumerate(heights.tolist()):
            if height >= 0.0:
                raise SolverError(
                    f'psd_{i + 1}.height = {height:g} m: a PSD at the base stands below the tip section; '
                    'base_pair takes psd_N.height = -(its distance from the lasers)'
                )
        self._centers = np.asarray(geometry.centers).ravel().tolist()
        self._rows = tuple(map(tuple, np.column_stack((geometry.beams, heights)).tolist()))
        # From the unknowns that are solved for to (dX, dY, theta, phi, omega).
        if assume == 'beam':
            slope_per_metre(geometry)
            self._matrix = tie_matrix(geometry.slope_ratio, geometry.link_length)
        elif assume == 'no_twist':
            self._matrix = np.eye(5)[:, [0, 1, 3, 4]]
        elif assume == 'nothing':
            self._matrix = np.eye(5)
        else:
            raise ConfigError(f'assume = {assume!r}: must be one of beam, no_twist, nothing')
        self._to_pose, self._columns = self._matrix.tolist(), self._matrix.T.tolist()
        self._reject_what_is_unseen(geometry, assume)

    @classmethod
    def options_from_rig(cls, rig: Rig) -> dict[str, Any]:
        """``base_pair.assume``."""
        return {'assume': rig.estimator.base_pair_assume}

    def _reject_what_is_unseen(self, geometry: Geometry, assume: Assume) -> None:
        heights = np.asarray(geometry.heights)
        at_rest = [landing(place, (0.0, 0.0, 0.0, 0.0, 0.0)) for place in self._rows]
        jacobian = np.array([row for rows in at_rest for row in rows[2:]])
        if assume == 'nothing' and self._count == 2:
            null = np.linalg.svd(jacobian)[2][4]
            per_degree = abs(null[1] / null[2]) * np.pi / 180.0
            raise SolverError(
                'two PSDs at the base give 4 readings for 5 unknowns: with torsion, one degree of twist looks like '
                f'{per_degree * 1e3:.3g} mm of ΔY; assume no_twist, or beam (tilts tied to the deflection), '
                'or put the PSDs at the tip'
            )
        if assume == 'no_twist' and np.ptp(heights) < SMALLEST_BASE_LINE:
            raise SolverError(
                f'all PSD planes are {-heights[0]:g} m from the lasers: translation and tilt move the dots alike; '
                'put psd_1 and psd_2 in two planes (psd_N.height), or assume beam'
            )
        if assume == 'beam':
            k = geometry.slope_ratio
            gains = 1.0 + k * heights / geometry.link_length
            if np.abs(gains).max() < _SMALLEST_GAIN:
                raise SolverError(
                    f'link.slope_ratio = {k:g} with all PSDs {-heights[0]:g} m from the lasers: the tilt carries each '
                    'dot back by what the deflection moved it (Fig. 5.9): the deflection cannot be seen; '
                    'put the PSDs in another plane'
                )
        observed = jacobian @ self._matrix
        observed /= np.linalg.norm(observed, axis=0)
        if np.linalg.svd(observed, compute_uv=False)[-1] < _SMALLEST_GAIN:
            raise SolverError(
                f'base_pair, assuming {assume}: some motion of the tip moves no dot with this geometry '
                '(PSDs on one line in space, or in one plane); move one PSD'
            )

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block, pure floats. See :class:`Solver`."""
        measured = [c + m for c, m in zip(self._centers, dots, strict=True)]
        minimum = fit(self._model, (0.0,) * self._matrix.shape[1], measured, variances, self._xp)
        xp, of_beams = self._xp, np.array(minimum.covariance)
        covariance = xp.product(xp.product(self._matrix[:3], of_beams), self._matrix[:3].T).tolist()
        return answer(minimum, xp.product(self._matrix, np.array(minimum.parameters)).tolist(), covariance)

    def _model(self, x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
        total = self._xp.total
        dx, dy, theta, phi, omega = [total([a * b for a, b in zip(row, x, strict=True)]) for row in self._to_pose]
        predicted: list[float] = []
        rows: list[Sequence[float]] = []
        for place in self._rows:
            px, py, jx, jy = landing(place, (dx, dy, theta, phi, omega), self._xp)
            predicted.append(px)
            predicted.append(py)
            for j in (jx, jy):
                rows.append([total([a * b for a, b in zip(j, column, strict=True)]) for column in self._columns])
        return predicted, rows
