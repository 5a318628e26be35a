# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``wls``: weighted least squares on the linearised plate, with the corrected design matrix.

The thesis's section 4.3 with the corrected rows of ``model.plate.linear`` and the pre-load readings
subtracted. The weights are the inverse variances. The thesis's own choice, rows scaled by
Po = [0.03, 0.5, 10, 0.1], makes W = Po^2 (its 4.25 and its code differ on that). This choice is
kept under the name ``thesis``. It does not describe the noise: it takes dX from x2 alone and dY
from y1 alone. It ignores x1, and that hides the wrong sign in the thesis's matrix.

With the inverse variances each axis has its own weighted mean, which leaves one equation for theta;
no matrix is inverted. The linear model still leaves d unrotated; ``wls_exact`` corrects this.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from psd_deflection.base.arithmetic import Arithmetic
from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.plate.linear import design_matrix
from psd_deflection.model.plate.plate import Number
from psd_deflection.model.solvers.interface import (
    Solution,
    Solutions,
    Solver,
    SolverStatus,
    flat_solutions,
    weighted_gain,
)
from psd_deflection.model.solvers.ols import FixedGain
from psd_deflection.model.solvers.plane import checked_variances
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig

THESIS_ROW_SCALING = (0.03, 0.5, 10.0, 0.1)
"""Po of x1, y1, x2, y2 for the thesis's loads on the sidebar (section 5.5, Figs 5.12-5.20)."""

_Rows = tuple[tuple[float, float, float, float], ...]

Weights = Literal['inverse_variance', 'thesis']


class WlsSolver(Solver):
    """Weighted linear least squares, P >= 2 PSDs.

    With the weights ``thesis`` the covariance is G V G^T for the gain G of those weights. (A^T W
    A)^-1 would be wrong, because they are not the inverse variances.
    """

    name: ClassVar[str] = 'wls'
    budgeted_as: ClassVar[str] = 'wls'

    def __init__(
        self,
        geometry: Geometry,
        weights: Weights = 'inverse_variance',
        row_scaling: tuple[float, ...] = THESIS_ROW_SCALING,
    ) -> None:
        """Bind to ``geometry``.

        ``weights``: from the variances that ``solve`` is given, or ``thesis``: the squares of
        ``row_scaling`` (2P,), each above 0. Raises SolverError if the beams coincide and
        ConfigError for a row scaling of another length.
        """
        check_twist(geometry)
        beams, zeros = np.asarray(geometry.beams).tolist(), np.asarray(geometry.zeros).tolist()
        self._rows = tuple((lx, ly, x0, y0) for (lx, ly), (x0, y0) in zip(beams, zeros, strict=True))
        self._xp = geometry.arithmetic
        self._known: _Weighted | None = None
        self._fixed = fixed_weights(geometry, weights, row_scaling)

    @classmethod
    def options_from_rig(cls, rig: Rig) -> dict[str, Any]:
        """``wls.weights`` and ``wls.row_scaling``. Raises ConfigError for the thesis's weights with more than two PSDs.

        They are of two.
        """
        if len(rig.psds) > 2 and rig.estimator.wls_weights == 'thesis':
            raise ConfigError(
                f'wls.weights = thesis: its weights are of two PSDs, the rig has {len(rig.psds)}; set inverse_variance'
            )
        return {'weights': rig.estimator.wls_weights, 'row_scaling': rig.estimator.wls_row_scaling}

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block, pure floats. See :class:`Solver`."""
        if self._fixed is not None:
            return self._fixed.solve(dots, variances)
        known = self._weighted(variances)
        (dx, dy, theta), residual = self._answer(dots, known)
        status = SolverStatus.OK if theta - theta == 0.0 else SolverStatus.NOT_CONVERGED
        return Solution(dx, dy, theta, 0.0, 0.0, known.covariance, tuple(residual), status, 0)

    def solve_many(self, dots: FloatArray, variances: FloatArray) -> Solutions:
        """N blocks, together if all have the same variances. See :class:`Solver`."""
        v = checked_variances(variances)
        if self._fixed is not None or len(v) > 1:
            return super().solve_many(dots, v)
        known = self._weighted(tuple(v[0].tolist()))
        pose, residual = self._answer(list(np.atleast_2d(np.asarray(dots, dtype=np.float64)).T), known)
        return flat_solutions(pose, known.covariance, residual, np.isfinite(pose[2]))

    def _answer(self, dots: Sequence[Number], known: _Weighted) -> tuple[tuple[Number, Number, Number], list[Number]]:
        """dX, dY, theta and the residual of one block, or of arrays of blocks."""
        shift_x = shift_y = moment = 0.0 * dots[0]
        terms = []
        for i, ((lx, ly, x0, y0), (wx, wy)) in enumerate(zip(self._rows, known.weights, strict=True)):
            x = dots[2 * i] - x0
            y = dots[2 * i + 1] - y0
            shift_x = shift_x + wx * x
            shift_y = shift_y + wy * y
            terms.append((x, y, lx, ly))
        for (x, y, _, _), (wx_ty, wy_tx) in zip(terms, known.levers, strict=True):
            moment = moment + (wx_ty * x - wy_tx * y)
        theta = moment * known.variance
        dx = known.mean_y * theta - shift_x / known.sum_x
        dy = -known.mean_x * theta - shift_y / known.sum_y
        residual: list[Number] = []
        for x, y, lx, ly in terms:
            residual.append(x + dx - ly * theta)
            residual.append(y + dy + lx * theta)
        return (dx, dy, theta), residual

    def gain(self, dots: tuple[float, ...], variances: tuple[float, ...], solution: Solution) -> FloatArray:
        """In closed form: that of the beams' places without twist. See :class:`Solver`."""
        if self._fixed is not None:
            return self._fixed.gain(dots, variances, solution)
        return self._weighted(variances).gain

    def gain_many(self, dots: FloatArray, variances: tuple[float, ...], solutions: Solutions) -> FloatArray:
        """The same for all blocks. See :class:`Solver`."""
        if self._fixed is not None:
            return super().gain_many(dots, variances, solutions)
        return np.broadcast_to(self._weighted(variances).gain, (len(dots), 3, dots.shape[1]))

    def _weighted(self, variances: tuple[float, ...]) -> _Weighted:
        known = self._known
        # In a run all blocks without a finding have the same variances.
        if known is None or known.variances != variances:
            known = self._known = _Weighted(self._rows, variances, self._xp)
        return known


class _Weighted:
    """What does not depend on the dots: all but the answer and its residual. ``variances`` (2P,), m^2: as given.

    ``weights`` (P, 2): of x and y, 1/m^2; ``levers`` (P, 2): those times the places across, 1/m. ``sum_x``, ``sum_y``:
    of the weights. ``mean_x``, ``mean_y`` m: of the beams, with the weights of the other axis. ``covariance``: as of
    :class:`Solution`; ``variance`` rad^2: of the twist.
    """

    def __init__(self, rows: _Rows, variances: tuple[float, ...], xp: Arithmetic) -> None:
        """``rows``: lx, ly, x0, y0 of each PSD, m. Raises SolverError if a variance is 0."""
        self._rows, self.variances, self._xp = rows, variances, xp
        try:
            self.weights = [(1.0 / variances[2 * i], 1.0 / variances[2 * i + 1]) for i in range(len(rows))]
        except ZeroDivisionError:
            raise SolverError('solve: variances must be above 0 m^2') from None
        sum_x = sum_y = mean_x = mean_y = 0.0
        for (lx, ly, _, _), (wx, wy) in zip(rows, self.weights, strict=True):
            sum_x += wx
            sum_y += wy
            mean_y += wx * ly
            mean_x += wy * lx
        mean_y /= sum_x
        mean_x /= sum_y
        information = 0.0
        self.levers = []
        for (lx, ly, _, _), (wx, wy) in zip(rows, self.weights, strict=True):
            ty = ly - mean_y
            tx = lx - mean_x
            self.levers.append((wx * ty, wy * tx))
            information += wx * ty * ty + wy * tx * tx
        self.sum_x, self.sum_y, self.mean_x, self.mean_y = sum_x, sum_y, mean_x, mean_y
        vtt = self.variance = 1.0 / information
        vxt = mean_y * vtt
        vyt = -mean_x * vtt
        vxy = mean_y * vyt
        vxx, vyy = 1.0 / sum_x + mean_y * vxt, 1.0 / sum_y - mean_x * vyt
        self.covariance = (vxx, vxy, vxt, vxy, vyy, vyt, vxt, vyt, vtt)

    @functools.cached_property
    def gain(self) -> FloatArray:
        """See :class:`Solver`."""
        places = tuple([place for lx, ly, _, _ in self._rows for place in (lx, ly)])
        out = np.array(weighted_gain(places, self._xp.cos_sin(0.0), self.variances, self.covariance))
        # Every block gets this one.
        out.setflags(write=False)
        return out


def fixed_weights(geometry: Geometry, weights: Weights, row_scaling: tuple[float, ...]) -> FixedGain | None:
    """The gain of the ``thesis`` weights; None if the weights follow the noise.

    Raises ConfigError for other weights and for a row scaling of another length or not above 0.
    """
    if weights == 'inverse_variance':
        return None
    if weights != 'thesis':
        raise ConfigError(f'wls.weights = {weights!r}: must be one of inverse_variance, thesis')
    count = 2 * len(geometry.centers)
    if len(row_scaling) != count or not all(0.0 < s < float('inf') for s in row_scaling):
        raise ConfigError(
            f'wls.row_scaling = {list(row_scaling)}: must have {count} elements above 0, '
            'one for x and one for y of each PSD'
        )
    scaling = np.array(row_scaling, dtype=np.float64)
    return FixedGain(design_matrix(geometry.beams), np.asarray(geometry.zeros), scaling, geometry.arithmetic)
