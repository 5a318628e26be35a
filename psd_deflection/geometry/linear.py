"""The linearised plate of the thesis's chapter 4, put right: matrix, gain, condition, error bound.

A b = m - m_0 with rows [-1, 0, l_iy] for x_i and [0, -1, -l_ix] for y_i. The source writes absolute
coordinates on the left (4.5, 4.6, 4.14) and, in its code, two rows of another rig (4.7-4.12 with
theta_1 = -90 deg, theta_2 = -180 deg); its rank condition (4.21 and 4.22) is met by 4.21 *or* 4.22.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from psd_deflection.records import FloatArray


def design_matrix(beams: FloatArray) -> FloatArray:
    """A (2P, 3) of ``beams`` (P, 2) m: rows x1, y1, x2, y2, ...; columns dX, dY (1) and theta (m/rad).

    4.5 and 4.6 corrected.
    """
    a = np.zeros((2 * len(beams), 3))
    a[0::2, 0] = -1.0
    a[0::2, 2] = beams[:, 1]
    a[1::2, 1] = -1.0
    a[1::2, 2] = -beams[:, 0]
    return a


def gain_matrix(design: FloatArray, row_scaling: FloatArray | None = None) -> FloatArray:
    """G (3, 2P) of x = G b: the pseudo-inverse of diag(Po) A, times diag(Po); W = Po^2.

    ``design`` (2P, 3); ``row_scaling`` (2P,): Po, None for ordinary least squares. The angle is scaled by the
    size of the rig first, so that the inverse does not depend on the unit of length.
    """
    if row_scaling is None:
        row_scaling = np.ones(len(design))
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
    m, entry by entry. ``row_scaling`` (2P,): Po, if the answer is a weighted one. Infinite if
    errors of that size could hide the pose altogether.

    Replaces 4.33 and 4.34. Those add metres to radians in one norm, so that the number depends on the
    unit (in mm it is a thousand times too large for the thesis's own example), and 4.32, on which they
    stand, holds for consistent equations only: with a residual r it lacks (A^T A)^-1 dA^T r, and 4.33 is
    broken by up to nine times. Asked for the distance to the *pose* x*, the residual drops out: with
    (A + dA) x* = b + db and x = G b, G A = I,

        x - x* = G (dA x* - db),     |x - x*| <= (I - |G| E)^-1 |G| (e + E |x|),

    where E >= |dA|, e >= |db|, in magnitudes, and nothing is neglected.
    """
    gain = np.abs(gain_matrix(design, row_scaling))
    e_a = np.abs(design_error)
    k = gain @ e_a
    if np.abs(np.linalg.eigvals(k)).max() >= 1.0:
        return np.full(3, np.inf)
    bound: FloatArray = np.linalg.solve(np.eye(3) - k, gain @ (np.abs(reading_error) + e_a @ np.abs(pose)))
    return bound
