"""``wls``: least squares on the linearised plate, with the design matrix put right.

The thesis's chapter 4, corrected: rows [-1, 0, l_iy] for x_i and [0, -1, -l_ix] for y_i (4.5, 4.6
with both PSDs on the same rig), and the pre-load reading subtracted, b = m - m_0 (4.14 leaves it
in). The weights are the inverse variances. The thesis's own choice, rows scaled by
[0.03, 0.5, 10, 0.1], has W = Po^2 (it prints W = Po, 4.25); it is kept under the name ``thesis``.

Linear means: theta comes out as sin theta and d as R(-theta) d + (1 - cos theta) times a mean of
the l_i, which at 1 degree and 2 mm is 40 um off. ``wls_exact`` undoes that.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from psd_deflection.errors import ConfigError, SolverError
from psd_deflection.records import FloatArray
from psd_deflection.solvers._geometry import check_twist
from psd_deflection.solvers._interface import Geometry, Solution, Solutions, Solver, SolverStatus
from psd_deflection.solvers._plane import interleave, split, weighted_covariance

THESIS_ROW_SCALING = (0.03, 0.5, 10.0, 0.1)
"""Po of x1, y1, x2, y2 for the thesis's sidebar loads (section 5.4); the weights are its squares."""

Weights = Literal['inverse_variance', 'thesis']


def design_matrix(geometry: Geometry) -> FloatArray:
    """A (2P, 3), metres: rows x1, y1, x2, y2, ...; columns dX, dY, theta (4.5, 4.6 corrected)."""
    beams = geometry.beams
    a = np.zeros((2 * len(beams), 3))
    a[0::2, 0] = -1.0
    a[0::2, 2] = beams[:, 1]
    a[1::2, 1] = -1.0
    a[1::2, 2] = -beams[:, 0]
    return a


class WlsSolver(Solver):
    """Weighted linear least squares, P >= 2 PSDs.

    With the weights ``thesis`` the covariance is G V G^T for the gain G that those weights make:
    they are not the noise's, so (A^T W A)^-1 would not be the estimate's covariance.
    """

    name: ClassVar[str] = 'wls'

    def __init__(
        self,
        geometry: Geometry,
        weights: Weights = 'inverse_variance',
        row_scaling: tuple[float, ...] = THESIS_ROW_SCALING,
    ) -> None:
        """Bind to ``geometry``.

        ``weights``: from the variances that ``solve`` is given, or ``thesis``: the squares of
        ``row_scaling`` (2P,), each above 0. Raises SolverError where the beams coincide and
        ConfigError for a row scaling of another length.
        """
        self._count = check_twist(geometry)
        self._beams = np.asarray(geometry.beams, dtype=np.float64)
        self._zeros = np.asarray(geometry.zeros, dtype=np.float64)
        self._rows = tuple(
            (lx, ly, x0, y0) for (lx, ly), (x0, y0) in zip(self._beams.tolist(), self._zeros.tolist(), strict=True)
        )
        self._design = design_matrix(geometry)
        self._gain: FloatArray | None = None
        self._gain_rows: tuple[tuple[float, ...], ...] = ()
        if weights == 'thesis':
            if len(row_scaling) != 2 * self._count:
                raise ConfigError(
                    f'wls.row_scaling = {list(row_scaling)}: must have {2 * self._count} elements, '
                    f'one for x and one for y of each PSD'
                )
            self._gain = gain_matrix(self._design, np.array(row_scaling))
            self._gain_rows = tuple(tuple(row) for row in self._gain.tolist())

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block, pure floats. See :class:`Solver`."""
        if self._gain_rows:
            return self._solve_fixed(dots, variances)
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
            _status(theta),
            0,
        )

    def _solve_fixed(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        b: list[float] = []
        for i, (_, _, x0, y0) in enumerate(self._rows):
            b.append(dots[2 * i] - x0)
            b.append(dots[2 * i + 1] - y0)
        gx, gy, gt = self._gain_rows
        dx = dy = theta = vxx = vxy = vxt = vyy = vyt = vtt = 0.0
        for r, v, x, y, t in zip(b, variances, gx, gy, gt, strict=True):
            dx += x * r
            dy += y * r
            theta += t * r
            xv = x * v
            yv = y * v
            vxx += xv * x
            vxy += xv * y
            vxt += xv * t
            vyy += yv * y
            vyt += yv * t
            vtt += t * v * t
        residual: list[float] = []
        for i, (lx, ly, _, _) in enumerate(self._rows):
            residual.append(b[2 * i] + dx - ly * theta)
            residual.append(b[2 * i + 1] + dy + lx * theta)
        return Solution(
            dx,
            dy,
            theta,
            0.0,
            0.0,
            (vxx, vxy, vxt, vxy, vyy, vyt, vxt, vyt, vtt),
            tuple(residual),
            _status(theta),
            0,
        )

    def solve_many(self, dots: FloatArray, variances: FloatArray) -> Solutions:
        """N blocks. See :class:`Solver`."""
        x, y, vx, vy = split(dots, variances)
        n = x.shape[0]
        bx = x - self._zeros[:, 0]
        by = y - self._zeros[:, 1]
        lx = self._beams[:, 0]
        ly = self._beams[:, 1]
        if self._gain is not None:
            v = np.broadcast_to(interleave(vx, vy), (n, 2 * self._count))
            pose = interleave(bx, by) @ self._gain.T
            covariance = np.einsum('ij,nj,kj->nik', self._gain, v, self._gain)
        else:
            wx = 1.0 / vx
            wy = 1.0 / vy
            sum_x = wx.sum(axis=1)
            sum_y = wy.sum(axis=1)
            mean_y = (wx * ly).sum(axis=1) / sum_x
            mean_x = (wy * lx).sum(axis=1) / sum_y
            tx = lx - mean_x[:, None]
            ty = ly - mean_y[:, None]
            information = (wx * ty * ty + wy * tx * tx).sum(axis=1)
            theta = (wx * ty * bx - wy * tx * by).sum(axis=1) / information
            shift_x = (wx * bx).sum(axis=1) / sum_x
            shift_y = (wy * by).sum(axis=1) / sum_y
            pose = np.column_stack((mean_y * theta - shift_x, -mean_x * theta - shift_y, theta))
            one = np.ones(sum_x.shape)
            covariance = np.broadcast_to(
                weighted_covariance(
                    np.broadcast_to(lx, wx.shape), np.broadcast_to(ly, wy.shape), wx, wy, one, np.zeros(sum_x.shape)
                ),
                (n, 3, 3),
            ).copy()
        residual = interleave(
            bx + pose[:, :1] - ly * pose[:, 2:],
            by + pose[:, 1:2] + lx * pose[:, 2:],
        )
        status = np.where(np.isfinite(pose[:, 2]), SolverStatus.OK, SolverStatus.NOT_CONVERGED).astype(np.int8)
        return Solutions(pose, np.zeros((n, 2)), covariance, residual, status)


def gain_matrix(design: FloatArray, row_scaling: FloatArray) -> FloatArray:
    """G (3, 2P) of x = G b: the pseudo-inverse of diag(Po) A, times diag(Po).

    The angle is scaled by the size of the rig first, so that the inverse does not depend on the
    unit of length.
    """
    length = float(np.abs(design[:, 2]).max())
    units = np.array([1.0, 1.0, length])
    scaled = row_scaling[:, None] * design / units
    gain: FloatArray = np.linalg.pinv(scaled) * row_scaling / units[:, None]
    return gain


def _status(theta: float) -> SolverStatus:
    return SolverStatus.OK if theta == theta else SolverStatus.NOT_CONVERGED
