# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Shared algebra of the flat plate: from motion to dots, and from dot noise to the estimate.

With p_i = R(-theta)(l_i - d) the plate point under beam i and f = R(-theta) d, a small change of
pose moves dot i by

    dx_i = -df_x + p_iy dtheta,      dy_i = -df_y - p_ix dtheta,

the corrected rows of the thesis's design matrix (4.5, 4.6) with p_i for l_i. Each axis has its own
weighted mean. This eliminates f and leaves one unknown, so neither the estimate nor its covariance
needs a matrix.
"""

import numpy as np

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate.plate import Number
from psd_deflection.records import FloatArray

Four = tuple[Number, Number, Number, Number]
Nine = tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]

Covariance = Nine[float]


def turn_covariance(
    c: Number, s: Number, vxx: Number, vxy: Number, vyy: Number, vxt: Number, vyt: Number, vtt: Number
) -> Nine[Number]:
    """Turn a covariance of (f_x, f_y, theta) in plate axes into one of (dX, dY, theta): R(theta)."""
    # R V R^T, written out.
    cs = c * s
    mixed = 2.0 * cs * vxy
    cc = c * c
    ss = s * s
    xx = cc * vxx - mixed + ss * vyy
    yy = ss * vxx + mixed + cc * vyy
    xy = cs * (vxx - vyy) + (cc - ss) * vxy
    xt = c * vxt - s * vyt
    yt = s * vxt + c * vyt
    return (xx, xy, xt, xy, yy, yt, xt, yt, vtt)


def checked_variances(variances: FloatArray) -> FloatArray:
    """Variances as (n or 1, 2P). Raises SolverError if one is not above 0."""
    v = np.atleast_2d(np.asarray(variances, dtype=np.float64))
    if not (v > 0.0).all():
        raise SolverError('solve: variances must be above 0 m^2')
    return v
