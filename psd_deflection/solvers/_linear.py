"""The linearised plate of the thesis's chapter 4, put right: matrix, gain, condition, error bound.

A b = m - m_0 with rows [-1, 0, l_iy] for x_i and [0, -1, -l_ix] for y_i. The source writes absolute
coordinates on the left (4.5, 4.6, 4.14) and, in its code, two rows of another rig (4.7-4.12 with
theta_1 = -90 deg, theta_2 = -180 deg); its rank condition (4.21 and 4.22) is met by 4.21 *or* 4.22.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.solvers._plane import interleave, split
from psd_deflection.solvers.interface import Geometry, Solution, Solutions, SolverStatus


def design_matrix(geometry: Geometry) -> FloatArray:
    """A (2P, 3): rows x1, y1, x2, y2, ...; columns dX, dY (1) and theta (m/rad). 4.5, 4.6 corrected."""
    beams = geometry.beams
    a = np.zeros((2 * len(beams), 3))
    a[0::2, 0] = -1.0
    a[0::2, 2] = beams[:, 1]
    a[1::2, 1] = -1.0
    a[1::2, 2] = -beams[:, 0]
    return a


def gain_matrix(design: FloatArray, row_scaling: FloatArray) -> FloatArray:
    """G (3, 2P) of x = G b: the pseudo-inverse of diag(Po) A, times diag(Po); W = Po^2.

    The angle is scaled by the size of the rig first, so that the inverse does not depend on the
    unit of length.
    """
    length = float(np.abs(design[:, 2]).max())
    units = np.array([1.0, 1.0, length])
    gain: FloatArray = np.linalg.pinv(row_scaling[:, None] * design / units) * row_scaling / units[:, None]
    return gain


class ConditionNumber(NamedTuple):
    """||A|| ||A+|| in the Frobenius norm (4.29) and in the 2-norm.

    ``angle_length``: the length, m, that an angle of 1 rad is counted as. The number means nothing
    without it: 0.001 gives the thesis's (A in mm), 1.0 that of A in m. In the Frobenius norm it is
    3 at best, not 1, for three unknowns.
    """

    frobenius: float
    two: float
    angle_length: float


def condition_number(design: FloatArray, angle_length: float) -> ConditionNumber:
    """4.28, 4.29 with their unit named; ``design`` (2P, 3) in m, ``angle_length`` in m."""
    scaled = design / np.array([1.0, 1.0, angle_length])
    inverse = np.linalg.pinv(scaled)
    return ConditionNumber(
        float(np.linalg.norm(scaled) * np.linalg.norm(inverse)),
        float(np.linalg.norm(scaled, 2) * np.linalg.norm(inverse, 2)),
        angle_length,
    )


def error_bound(
    design: FloatArray,
    pose: FloatArray,
    design_error: FloatArray,
    reading_error: FloatArray,
    row_scaling: FloatArray | None = None,
) -> FloatArray:
    """How far (dX, dY, theta) can be from the true pose, each by itself (3,): m, m, rad.

    ``pose`` (3,) as solved with ``design`` (2P, 3). The true matrix is off by at most ``design_error``
    (2P, 3) and the readings, with all that the linear model lacks, by at most ``reading_error`` (2P,)
    m, entry by entry. ``row_scaling`` (2P,): Po, where the answer is a weighted one. Infinite where
    errors of that size could hide the pose altogether.

    Replaces 4.33 and 4.34. Those add metres to radians in one norm, so that the number depends on the
    unit (in mm it is a thousand times too large for the thesis's own example), and 4.32, on which they
    stand, holds for consistent equations only: with a residual r it lacks (A^T A)^-1 dA^T r, and 4.33 is
    broken by up to nine times. Asked for the distance to the *pose* x*, the residual drops out: with
    (A + dA) x* = b + db and x = G b, G A = I,

        x - x* = G (dA x* - db),     |x - x*| <= (I - |G| E)^-1 |G| (e + E |x|),

    where E >= |dA|, e >= |db|, in magnitudes, and nothing is neglected.
    """
    scale = np.ones(len(design)) if row_scaling is None else np.asarray(row_scaling, dtype=np.float64)
    gain = np.abs(gain_matrix(design, scale))
    e_a = np.abs(design_error)
    k = gain @ e_a
    if np.abs(np.linalg.eigvals(k)).max() >= 1.0:
        return np.full(3, np.inf)
    bound: FloatArray = np.linalg.solve(np.eye(3) - k, gain @ (np.abs(reading_error) + e_a @ np.abs(pose)))
    return bound


class FixedGain:
    """x = G (m - m_0) for a gain that does not depend on the noise; covariance G V G^T."""

    def __init__(self, design: FloatArray, zeros: FloatArray, row_scaling: FloatArray) -> None:
        """``design`` (2P, 3); ``zeros`` (P, 2) m, subtracted first; ``row_scaling`` (2P,)."""
        self.design = design
        self.gain = gain_matrix(design, row_scaling)
        self._zeros = zeros.ravel()
        self._columns = tuple(
            (zero, *gain, *row)
            for zero, gain, row in zip(self._zeros.tolist(), self.gain.T.tolist(), design.tolist(), strict=True)
        )

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block, pure floats."""
        dx = dy = theta = vxx = vxy = vxt = vyy = vyt = vtt = 0.0
        for m, v, (zero, x, y, t, _, _, _) in zip(dots, variances, self._columns, strict=True):
            b = m - zero
            dx += x * b
            dy += y * b
            theta += t * b
            xv = x * v
            yv = y * v
            vxx += xv * x
            vxy += xv * y
            vxt += xv * t
            vyy += yv * y
            vyt += yv * t
            vtt += t * v * t
        residual = tuple(
            [
                m - zero - ax * dx - ay * dy - at * theta
                for m, (zero, _, _, _, ax, ay, at) in zip(dots, self._columns, strict=True)
            ]
        )
        status = SolverStatus.OK if theta - theta == 0.0 else SolverStatus.NOT_CONVERGED
        covariance = (vxx, vxy, vxt, vxy, vyy, vyt, vxt, vyt, vtt)
        return Solution(dx, dy, theta, 0.0, 0.0, covariance, residual, status, 0)

    def solve_many(self, dots: FloatArray, variances: FloatArray) -> Solutions:
        """N blocks."""
        x, y, vx, vy = split(dots, variances)
        b = interleave(x, y) - self._zeros
        v = interleave(np.broadcast_to(vx, x.shape), np.broadcast_to(vy, x.shape))
        pose = b @ self.gain.T
        covariance = np.einsum('ij,nj,kj->nik', self.gain, v, self.gain)
        return Solutions(pose, np.zeros((len(b), 2)), covariance, b - pose @ self.design.T, status_of(pose))


def status_of(pose: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.int8]]:
    """OK where the pose (n, 3) is finite, int8 (n,)."""
    return np.where(np.isfinite(pose).all(axis=1), SolverStatus.OK, SolverStatus.NOT_CONVERGED).astype(np.int8)
