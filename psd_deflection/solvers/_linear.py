"""The linearised plate of the thesis's chapter 4, put right: matrix, gain, condition, error bound.

A b = m - m_0 with rows [-1, 0, l_iy] for x_i and [0, -1, -l_ix] for y_i. The source writes absolute
coordinates on the left (4.5, 4.6, 4.14) and, in its code, two rows of another rig (4.7-4.12 with
theta_1 = -90 deg, theta_2 = -180 deg); its rank condition (4.21 and 4.22) is met by 4.21 *or* 4.22.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.solvers._interface import Geometry, Solution, Solutions, SolverStatus
from psd_deflection.solvers._plane import interleave, split


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
    residual: FloatArray,
    design_error: FloatArray,
    reading_error: FloatArray,
    row_scaling: FloatArray | None = None,
) -> FloatArray:
    """How far (dX, dY, theta) can be off, each by itself (3,): m, m, rad. Replaces 4.33 and 4.34.

    ``pose`` (3,) and ``residual`` (2P,) m as solved with ``design`` (2P, 3); the true matrix is off
    by at most ``design_error`` (2P, 3) and the readings by at most ``reading_error`` (2P,) m, entry
    by entry. ``row_scaling`` (2P,): Po, where the answer is a weighted one. Entries are infinite
    where errors of that size could make the matrix singular.

    With A' = A + dA the matrix used, r its residual, N = A'^T A' and E >= |dA|, e >= |db|, the
    normal equations of both systems subtract to

        (N - dN) dx = A^T (db - dA x) + dA^T r,

    of which 4.32 has only the first term, and 4.33 a norm that adds metres to radians. In magnitudes,
    with v = e + E |x|:  |dx| <= (I - K)^-1 ( |A'+| v + |N^-1| E^T (v + |r|) ),
    K = |A'+| E + |N^-1| E^T (|A'| + E). Nothing is neglected.
    """
    scale = np.ones(len(design)) if row_scaling is None else np.asarray(row_scaling, dtype=np.float64)
    a = scale[:, None] * design
    e_a = scale[:, None] * np.abs(design_error)
    e_b = scale * np.abs(reading_error)
    inverse = np.abs(np.linalg.pinv(a))
    normal = np.abs(np.linalg.inv(a.T @ a))
    v = e_b + e_a @ np.abs(pose)
    k = inverse @ e_a + normal @ e_a.T @ (np.abs(a) + e_a)
    if np.abs(np.linalg.eigvals(k)).max() >= 1.0:
        return np.full(3, np.inf)
    first = inverse @ v + normal @ e_a.T @ (v + scale * np.abs(residual))
    bound: FloatArray = np.linalg.solve(np.eye(3) - k, first)
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
