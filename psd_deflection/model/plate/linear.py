# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The linearised plate of the thesis's chapter 4, corrected: matrix, gain, condition, error bound.

A b = m - m_0 with rows [-1, 0, l_iy] for x_i and [0, -1, -l_ix] for y_i. The thesis has absolute
coordinates on the left (4.5, 4.6, 4.14). Its code has two rows of another rig (4.7-4.12 with
theta_1 = -90 deg, theta_2 = -180 deg). For full rank it asks for 4.21 and 4.22; either is enough.
"""

from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
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


def gain_matrix(
    design: FloatArray, row_scaling: FloatArray | None = None, arithmetic: Arithmetic = LIBRARY
) -> FloatArray:
    """G (3, 2P) of x = G b: the pseudo-inverse of diag(Po) A, times diag(Po); W = Po^2.

    ``design`` (2P, 3); ``row_scaling`` (2P,): Po, None for ordinary least squares. The angle is scaled by the
    size of the rig first, so that the inverse does not depend on the unit of length.
    """
    if row_scaling is None:
        row_scaling = np.ones(len(design))
    length = float(np.abs(design[:, 2]).max())
    units = np.array([1.0, 1.0, length])
    gain = arithmetic.pseudo_inverse(row_scaling[:, None] * design / units) * row_scaling / units[:, None]
    return np.asarray(gain)


class ConditionNumber(NamedTuple):
    """||A|| ||A+|| in the Frobenius norm (4.29) and in the 2-norm.

    ``angle_length``: the length, m, that counts as an angle of 1 rad. The condition number has no
    meaning without it: 0.001 gives the thesis's number (A in mm), 1.0 the number for A in m. For
    three unknowns the best value is 3 in the Frobenius norm, not 1.
    """

    frobenius: float
    two: float
    angle_length: float


def condition_number(design: FloatArray, angle_length: float) -> ConditionNumber:
    """4.28 and 4.29 with the unit stated; ``design`` (2P, 3) in m, ``angle_length`` in m."""
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
    """Largest error of dX, dY and theta, one by one, (3,): m, m, rad.

    ``pose`` (3,) as solved with ``design`` (2P, 3). ``design_error`` (2P, 3) bounds the error of each
    entry of the matrix. ``reading_error`` (2P,) m bounds the error of each reading, including what the
    linear model leaves out. ``row_scaling`` (2P,): Po, if the answer is weighted. The result is
    infinite if such errors could hide the pose completely.

    It replaces 4.33 and 4.34. These add metres to radians in one norm, so the number depends on the unit
    (in mm it is a thousand times too large for the thesis's own example). They also rest on 4.32, which
    holds for consistent equations only: with a residual r it lacks (A^T A)^-1 dA^T r, and the true error
    exceeds 4.33 by up to nine times. The distance to the *pose* x* does not contain the residual. With
    (A + dA) x* = b + db and x = G b, G A = I,

        x - x* = G (dA x* - db),     |x - x*| <= (I - |G| E)^-1 |G| (e + E |x|),

    where E >= |dA| and e >= |db| entry by entry. No term is neglected.
    """
    gain = np.abs(gain_matrix(design, row_scaling))
    e_a = np.abs(design_error)
    k = gain @ e_a
    if np.abs(np.linalg.eigvals(k)).max() >= 1.0:
        return np.full(3, np.inf)
    bound: FloatArray = np.linalg.solve(np.eye(3) - k, gain @ (np.abs(reading_error) + e_a @ np.abs(pose)))
    return bound
