"""Where the dots fall for a pose of the tip, exactly, and how they move with it.

Theory of operation. Beam i stands parallel to Z at l_i. A point of the plate (q, h), q in its plane
and h above the reference section, is at M q + h m + d across the beams, with d = (dX, dY), M the
upper left 2 x 2 block of R = Ry(omega) Rx(phi) Rz(theta) and m the upper two of its third column.
The dot is the point under the beam::

    q_i = M^-1 (l_i - d - h_i m),        reading m_i = q_i - c_i

so dZ never enters. The derivatives follow by turning M q + h m + d = l into differences::

    dq = -M^-1 (dd + (dM q + h dm) dangle)

At rest, dq/d(dX, dY, theta) are the rows [-1, 0, l_y], [0, -1, -l_x]: the design matrix of the
thesis (4.5/4.6 with the left side read as local displacement).

Poses are (..., 5): dX, dY m; theta, phi, omega rad. Sensors are indexed by P.
"""

from __future__ import annotations

import numpy as np

from psd_deflection.records import FloatArray


def _blocks(pose: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """M (..., 2, 2), m (..., 2) and their derivatives (..., 3, 2, 2), (..., 3, 2) by theta, phi, omega."""
    theta, phi, omega = pose[..., 2], pose[..., 3], pose[..., 4]
    ct, st = np.cos(theta), np.sin(theta)
    cp, sp = np.cos(phi), np.sin(phi)
    co, so = np.cos(omega), np.sin(omega)
    zero = np.zeros_like(ct)

    def matrix(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
        return np.stack([np.stack([a, b], axis=-1), np.stack([c, d], axis=-1)], axis=-2)

    m_block = matrix(co * ct + so * sp * st, so * sp * ct - co * st, cp * st, cp * ct)
    m_third = np.stack([so * cp, -sp], axis=-1)
    by_angle = np.stack(
        [
            matrix(so * sp * ct - co * st, -so * sp * st - co * ct, cp * ct, -cp * st),
            matrix(so * cp * st, so * cp * ct, -sp * st, -sp * ct),
            matrix(co * sp * st - so * ct, co * sp * ct + so * st, zero, zero),
        ],
        axis=-3,
    )
    third_by_angle = np.stack(
        [
            np.stack([zero, zero], axis=-1),
            np.stack([-so * sp, -cp], axis=-1),
            np.stack([co * cp, zero], axis=-1),
        ],
        axis=-2,
    )
    return m_block, m_third, by_angle, third_by_angle


def plate_points(pose: FloatArray, beams: FloatArray, heights: FloatArray) -> FloatArray:
    """q_i (..., P, 2), m: the points of the plate under the beams.

    ``pose`` (..., 5); ``beams`` (P, 2) or (..., P, 2) m; ``heights`` (P,) m.
    """
    m_block, m_third, _, _ = _blocks(pose)
    across = beams - pose[..., None, :2] - heights[:, None] * m_third[..., None, :]
    return np.asarray(np.linalg.solve(m_block[..., None, :, :], across[..., None])[..., 0])


def plate_jacobian(pose: FloatArray, points: FloatArray, heights: FloatArray) -> FloatArray:
    """dq/dpose (..., P, 2, 5): m/m for dX, dY, m/rad for theta, phi, omega, at ``points`` (..., P, 2)."""
    m_block, _, by_angle, third_by_angle = _blocks(pose)
    moved = np.einsum('...aij,...pj->...pia', by_angle, points)
    moved = moved + heights[:, None, None] * np.swapaxes(third_by_angle, -1, -2)[..., None, :, :]
    shift = np.broadcast_to(np.eye(2), (*moved.shape[:-1], 2))
    return np.asarray(-np.linalg.solve(m_block[..., None, :, :], np.concatenate([shift, moved], axis=-1)))


def beam_jacobian(pose: FloatArray) -> FloatArray:
    """dq/dl = M^-1 (..., 2, 2): how a plate point follows its beam, the same for every sensor."""
    return np.asarray(np.linalg.inv(_blocks(pose)[0]))


def tied_pose(pose: FloatArray, slope_ratio: FloatArray | float, link_length: float) -> FloatArray:
    """(..., 5) from (..., 3): the tilts of a cantilever, phi = -k dY/L, omega = +k dX/L.

    ``slope_ratio`` k: one, or (...,) of its own for each pose.
    """
    tilt = np.asarray(slope_ratio)[..., None] / link_length * np.stack([-pose[..., 1], pose[..., 0]], axis=-1)
    return np.concatenate([np.broadcast_to(pose, (*tilt.shape[:-1], 3)), tilt], axis=-1)


def tie_matrix(slope_ratio: float, link_length: float) -> FloatArray:
    """(5, 3): d(dX, dY, theta, phi, omega)/d(dX, dY, theta) of a cantilever with slope ratio k."""
    out = np.eye(5, 3)
    out[3, 1] = -slope_ratio / link_length
    out[4, 0] = slope_ratio / link_length
    return out
