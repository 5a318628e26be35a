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

from typing import Any, ClassVar, Literal

import numpy as np

from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.plate.linear import design_matrix
from psd_deflection.model.solvers.fixed_gain import FixedGain
from psd_deflection.model.solvers.interface import Solution, Solver, SolverStatus, weighted_gain
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig

THESIS_ROW_SCALING = (0.03, 0.5, 10.0, 0.1)
"""Po of x1, y1, x2, y2 for the thesis's loads on the sidebar (section 5.5, Figs 5.12-5.20)."""

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
        self._places = tuple(np.asarray(geometry.beams, dtype=np.float64).ravel().tolist())
        self._arithmetic = geometry.arithmetic
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
        sum_x = sum_y = mean_x = mean_y = shift_x = shift_y = 0.0
        terms = []
        try:
            for i, (lx, ly, x0, y0) in enumerate(self._rows):
                wx = 1.0 / variances[2 * i]
                wy = 1.0 / variances[2 * i + 1]
                bx = dots[2 * i] - x0
                by = dots[2 * i + 1] - y0
                sum_x += wx
                sum_y += wy
                mean_y += wx * ly
                mean_x += wy * lx
                shift_x += wx * bx
                shift_y += wy * by
                terms.append((wx, wy, bx, by, lx, ly))
        except ZeroDivisionError:
            raise SolverError('solve: variances must be above 0 m^2') from None
        mean_y /= sum_x
        mean_x /= sum_y
        shift_x /= sum_x
        shift_y /= sum_y
        moment = information = 0.0
        for wx, wy, bx, by, lx, ly in terms:
            ty = ly - mean_y
            tx = lx - mean_x
            moment += wx * ty * bx - wy * tx * by
            information += wx * ty * ty + wy * tx * tx
        vtt = 1.0 / information
        theta = moment * vtt
        dx = mean_y * theta - shift_x
        dy = -mean_x * theta - shift_y
        vxt = mean_y * vtt
        vyt = -mean_x * vtt
        vxy = mean_y * vyt
        residual: list[float] = []
        for _, _, bx, by, lx, ly in terms:
            residual.append(bx + dx - ly * theta)
            residual.append(by + dy + lx * theta)
        return Solution(
            dx,
            dy,
            theta,
            0.0,
            0.0,
            (1.0 / sum_x + mean_y * vxt, vxy, vxt, vxy, 1.0 / sum_y - mean_x * vyt, vyt, vxt, vyt, vtt),
            tuple(residual),
            SolverStatus.OK if theta - theta == 0.0 else SolverStatus.NOT_CONVERGED,
            0,
        )

    def gain(self, dots: tuple[float, ...], variances: tuple[float, ...], solution: Solution) -> FloatArray:
        """In closed form: that of the beams' places without twist. See :class:`Solver`."""
        if self._fixed is not None:
            return self._fixed.gain(dots, variances, solution)
        return weighted_gain(self._places, 0.0, variances, solution, self._arithmetic)


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
