"""Shared algebra of the flat plate: from motion to dots, and from dot noise to the estimate.

With p_i = R(-theta)(l_i - d) the plate point under beam i and f = R(-theta) d, a small change of
pose moves dot i by

    dx_i = -df_x + p_iy dtheta,      dy_i = -df_y - p_ix dtheta,

the corrected rows of the thesis's design matrix (4.5, 4.6) with p_i for l_i. Each axis has its own
weighted mean. This eliminates f and leaves one unknown, so neither the estimate nor its covariance
needs a matrix. Each method's ``solve`` writes these formulas out in floats; this module has them
for n blocks.
"""

from __future__ import annotations

import numpy as np

from psd_deflection.errors import SolverError
from psd_deflection.records import FloatArray

Covariance = tuple[float, float, float, float, float, float, float, float, float]


def turn_covariance(
    c: float, s: float, vxx: float, vxy: float, vyy: float, vxt: float, vyt: float, vtt: float
) -> Covariance:
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


def positive(variances: FloatArray) -> FloatArray:
    """Variances as (n or 1, 2P). Raises SolverError if one is not above 0."""
    v = np.atleast_2d(np.asarray(variances, dtype=np.float64))
    if not (v > 0.0).all():
        raise SolverError('solve: variances must be above 0 m^2')
    return v


def split(dots: FloatArray, variances: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """x, y (n, P) and their variances, each (n, P) or (1, P). Raises SolverError as :func:`positive`."""
    v = positive(variances)
    m = np.atleast_2d(np.asarray(dots, dtype=np.float64))
    return m[:, 0::2], m[:, 1::2], v[:, 0::2], v[:, 1::2]


def interleave(x: FloatArray, y: FloatArray) -> FloatArray:
    """(n, P) and (n, P) to (n, 2P): x1, y1, x2, y2, ..."""
    out = np.empty((x.shape[0], 2 * x.shape[1]))
    out[:, 0::2] = x
    out[:, 1::2] = y
    return out


def weighted_covariance(
    px: FloatArray, py: FloatArray, wx: FloatArray, wy: FloatArray, c: FloatArray, s: FloatArray
) -> FloatArray:
    """(J^T W J)^-1 of (dX, dY, theta), (n, 3, 3), for plate points (n, P), weights (n or 1, P).

    ``c``, ``s`` (n,): cosine and sine of theta.
    """
    sum_x = wx.sum(axis=1)
    sum_y = wy.sum(axis=1)
    mean_y = (wx * py).sum(axis=1) / sum_x
    mean_x = (wy * px).sum(axis=1) / sum_y
    information = (wx * (py - mean_y[:, None]) ** 2).sum(axis=1) + (wy * (px - mean_x[:, None]) ** 2).sum(axis=1)
    vtt = 1.0 / information
    vxt = mean_y * vtt
    vyt = -mean_x * vtt
    return turn_covariance_many(
        c, s, 1.0 / sum_x + mean_y * vxt, -mean_x * vxt, 1.0 / sum_y - mean_x * vyt, vxt, vyt, vtt
    )


def turn_covariance_many(
    c: FloatArray,
    s: FloatArray,
    vxx: FloatArray,
    vxy: FloatArray,
    vyy: FloatArray,
    vxt: FloatArray,
    vyt: FloatArray,
    vtt: FloatArray,
    out: FloatArray | None = None,
) -> FloatArray:
    """:func:`turn_covariance` for n blocks: (n, 3, 3), written into ``out`` if it is given."""
    if out is None:
        out = np.empty((c.shape[0], 3, 3))
    cs = c * s
    mixed = 2.0 * cs * vxy
    cc = c * c
    ss = s * s
    out[:, 0, 0] = cc * vxx - mixed + ss * vyy
    out[:, 1, 1] = ss * vxx + mixed + cc * vyy
    out[:, 0, 1] = out[:, 1, 0] = cs * (vxx - vyy) + (cc - ss) * vxy
    out[:, 0, 2] = out[:, 2, 0] = c * vxt - s * vyt
    out[:, 1, 2] = out[:, 2, 1] = s * vxt + c * vyt
    out[:, 2, 2] = vtt
    return out
