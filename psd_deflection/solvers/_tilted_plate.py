"""The plate with tilts: where the beams cross it, and how that moves with each unknown.

The beams stay parallel to Z. PSD i has its surface at height h_i over the reference section, so that
R (q_ix, q_iy, h_i) + (dX, dY, .) lies on beam i; dZ drops out. With R = Ry(omega) Rx(phi) Rz(theta),

    u = l_x - dX - h sin(omega) cos(phi),      v = l_y - dY + h sin(phi),
    y' = v / cos(phi),      x' = (u - y' sin(omega) sin(phi)) / cos(omega),      q = Rz(-theta)(x', y').

The derivatives are those of these lines, in the order dX, dY, theta, phi, omega.
"""

from __future__ import annotations

from math import cos, sin

import numpy as np

from psd_deflection.records import FloatArray

Row = tuple[float, float, float, float, float]


def crossing(
    lx: float, ly: float, height: float, dx: float, dy: float, theta: float, phi: float, omega: float
) -> tuple[float, float, Row, Row]:
    """(q_x, q_y, dq_x, dq_y) of one beam: m; m/m for dX, dY and m/rad for the angles."""
    ct = cos(theta)
    st = sin(theta)
    cp = cos(phi)
    sp = sin(phi)
    co = cos(omega)
    so = sin(omega)
    y = (ly - dy + height * sp) / cp
    x = (lx - dx - height * so * cp - y * so * sp) / co
    qx = ct * x + st * y
    qy = ct * y - st * x
    # (x', y') by dX: (-1/co, 0); by dY: (y_dx, y_dy); by phi; by omega: (o, 0).
    y_dy = -1.0 / cp
    y_dx = so * sp / (co * cp)
    p_dy = height + y * sp / cp
    p_dx = (height * so * sp - y * so * cp - so * sp * p_dy) / co
    o_dx = (x * so - height * co * cp - y * co * sp) / co
    return (
        qx,
        qy,
        (-ct / co, ct * y_dx + st * y_dy, qy, ct * p_dx + st * p_dy, ct * o_dx),
        (st / co, ct * y_dy - st * y_dx, -qx, ct * p_dy - st * p_dx, -st * o_dx),
    )


def crossings(beams: FloatArray, heights: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same for n poses (n, 5) and P beams (P, 2): q (n, 2P) and its derivatives (n, 2P, 5)."""
    dx, dy, theta, phi, omega = (poses[:, i, None] for i in range(5))
    ct = np.cos(theta)
    st = np.sin(theta)
    cp = np.cos(phi)
    sp = np.sin(phi)
    co = np.cos(omega)
    so = np.sin(omega)
    y = (beams[:, 1] - dy + heights * sp) / cp
    x = (beams[:, 0] - dx - heights * so * cp - y * so * sp) / co
    n, count = x.shape
    q = np.empty((n, 2 * count))
    q[:, 0::2] = ct * x + st * y
    q[:, 1::2] = ct * y - st * x
    y_dy = -1.0 / cp
    y_dx = so * sp / (co * cp)
    p_dy = heights + y * sp / cp
    p_dx = (heights * so * sp - y * so * cp - so * sp * p_dy) / co
    o_dx = (x * so - heights * co * cp - y * co * sp) / co
    j = np.empty((n, 2 * count, 5))
    j[:, 0::2, 0] = -ct / co
    j[:, 1::2, 0] = st / co
    j[:, 0::2, 1] = ct * y_dx + st * y_dy
    j[:, 1::2, 1] = ct * y_dy - st * y_dx
    j[:, 0::2, 2] = q[:, 1::2]
    j[:, 1::2, 2] = -q[:, 0::2]
    j[:, 0::2, 3] = ct * p_dx + st * p_dy
    j[:, 1::2, 3] = ct * p_dy - st * p_dx
    j[:, 0::2, 4] = ct * o_dx
    j[:, 1::2, 4] = -st * o_dx
    return q, j
