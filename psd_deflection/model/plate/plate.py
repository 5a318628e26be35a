# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The tip plate under parallel beams: pose -> dots with derivatives, and flat dots -> pose.

Theory of operation. The beams are parallel to Z, beam i at l_i. PSD i has its surface at height h_i over the
reference section, so that R (q_ix, q_iy, h_i) + (dX, dY, .) lies on beam i; dZ drops out. With
R = Ry(omega) Rx(phi) Rz(theta),

    u = l_x - dX - h sin(omega) cos(phi),      v = l_y - dY + h sin(phi),
    y' = v / cos(phi),      x' = (u - y' sin(omega) sin(phi)) / cos(omega),      q = Rz(-theta)(x', y').

The reading is q_i - c_i. The derivatives are those of these lines, in the order dX, dY, theta, phi, omega;
at rest the first three are the rows [-1, 0, l_y], [0, -1, -l_x] of the design matrix (``linear``). Beam and
translation enter only as l - d, so dq/dl = -dq/d(dX, dY).

``crossing`` and ``flat_pose`` take floats: a solver calls them once a block in real time, where numpy's cost per
call would dominate. ``crossings`` and ``flat_poses`` are the same formulas for arrays.
"""

from collections.abc import Sequence
from typing import Literal, TypeVar

import numpy as np

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.records import FloatArray

Number = TypeVar('Number', float, FloatArray)

Rotations = tuple[Number, Number, Number, Number, Number, Number]
"""Cosine and sine of theta, of phi, of omega."""

Five = tuple[Number, Number, Number, Number, Number]
"""Derivatives of one coordinate by dX, dY (m/m), theta, phi, omega (m/rad)."""

Row = Five[float]

Beam = tuple[Number, Number, Number]
"""l_x, l_y and the height h of the surface that the beam meets, m."""

Pose = tuple[Number, Number, Number, Number, Number]
"""dX, dY m, theta, phi, omega rad."""


def _point(
    beam: Beam[Number], dx: Number, dy: Number, rotations: Rotations[Number]
) -> tuple[Number, Number, Number, Number]:
    """x', y', q_x, q_y as in the module's docstring."""
    lx, ly, height = beam
    ct, st, cp, sp, co, so = rotations
    y = (ly - dy + height * sp) / cp
    x = (lx - dx - height * so * cp - y * so * sp) / co
    return x, y, ct * x + st * y, ct * y - st * x


def _rows(
    x: Number, y: Number, qx: Number, qy: Number, height: Number, rotations: Rotations[Number]
) -> tuple[Five[Number], Five[Number]]:
    """Derivatives of q_x and of q_y."""
    ct, st, cp, sp, co, so = rotations
    # (x', y') by dX: (-1/co, 0); by dY: (y_dx, y_dy); by phi; by omega: (o, 0).
    y_dy = -1.0 / cp
    y_dx = so * sp / (co * cp)
    p_dy = height + y * sp / cp
    p_dx = (height * so * sp - y * so * cp - so * sp * p_dy) / co
    o_dx = (x * so - height * co * cp - y * co * sp) / co
    return (
        (-ct / co, ct * y_dx + st * y_dy, qy, ct * p_dx + st * p_dy, ct * o_dx),
        (st / co, ct * y_dy - st * y_dx, -qx, ct * p_dy - st * p_dx, -st * o_dx),
    )


def crossing(beam: Beam[float], pose: Pose[float], arithmetic: Arithmetic = LIBRARY) -> tuple[float, float, Row, Row]:
    """(q_x, q_y, dq_x, dq_y) of one beam: m; m/m for dX, dY and m/rad for the angles."""
    dx, dy, theta, phi, omega = pose
    cos_sin = arithmetic.cos_sin
    rotations = *cos_sin(theta), *cos_sin(phi), *cos_sin(omega)
    x, y, qx, qy = _point(beam, dx, dy, rotations)
    row_x, row_y = _rows(x, y, qx, qy, beam[2], rotations)
    return qx, qy, row_x, row_y


def rotations_of(
    theta: FloatArray, phi: FloatArray, omega: FloatArray, arithmetic: Arithmetic = LIBRARY
) -> Rotations[FloatArray]:
    """Cosine and sine of each angle."""
    sin, cos = arithmetic.sin_many, arithmetic.cos_many
    return cos(theta), sin(theta), cos(phi), sin(phi), cos(omega), sin(omega)


def crossings(
    poses: FloatArray, beams: FloatArray, heights: FloatArray, arithmetic: Arithmetic = LIBRARY
) -> tuple[FloatArray, FloatArray]:
    """The plate points under the beams, (..., P, 2) m, and their derivatives by the pose, (..., P, 2, 5).

    ``poses`` (..., 5): dX, dY m, theta, phi, omega rad; ``beams`` (P, 2) or (..., P, 2) m; ``heights`` (P,) m.
    """
    dx, dy, theta, phi, omega = (poses[..., i, None] for i in range(5))
    rotations = rotations_of(theta, phi, omega, arithmetic)
    x, y, qx, qy = _point((beams[..., 0], beams[..., 1], heights), dx, dy, rotations)
    points = np.stack((qx, qy), axis=-1)
    jacobian = np.empty((*points.shape, 5))
    for axis, row in enumerate(_rows(x, y, qx, qy, heights, rotations)):
        for i, derivative in enumerate(row):
            jacobian[..., axis, i] = derivative
    return points, jacobian


def plate_points(
    poses: FloatArray, beams: FloatArray, heights: FloatArray, arithmetic: Arithmetic = LIBRARY
) -> FloatArray:
    """The points of :func:`crossings` alone, (..., P, 2) m."""
    dx, dy, theta, phi, omega = (poses[..., i, None] for i in range(5))
    beam = beams[..., 0], beams[..., 1], heights
    qx, qy = points_under(beam, (dx, dy, theta, phi, omega), arithmetic)
    return np.stack((qx, qy), axis=-1)


def points_under(
    beam: Beam[FloatArray], pose: Pose[FloatArray], arithmetic: Arithmetic = LIBRARY
) -> tuple[FloatArray, FloatArray]:
    """q_x and q_y, m, from arrays whose shapes broadcast; for long runs of samples."""
    dx, dy, theta, phi, omega = pose
    return _point(beam, dx, dy, rotations_of(theta, phi, omega, arithmetic))[2:]


def points_under_leaning(
    beam: Beam[FloatArray],
    slopes: tuple[FloatArray, FloatArray],
    pose: Pose[FloatArray],
    arithmetic: Arithmetic = LIBRARY,
) -> tuple[FloatArray, FloatArray]:
    """:func:`points_under` for beams that lean by ``slopes`` in x and y (m/m) along Z.

    (l_x, l_y): where the beam crosses the surface of the plate at rest, z = h. The surface meets it at z, where the
    beam is at l + slope (z - h). Each pass leaves the product of the plate's tilt and the slope, below 1e-3, of the
    error before it.
    """
    lx, ly, height = beam
    dx, dy, theta, phi, omega = pose
    rotations = rotations_of(theta, phi, omega, arithmetic)
    _, _, cp, sp, co, so = rotations
    x, y, qx, qy = _point(beam, dx, dy, rotations)
    for _ in range(3):
        # (x', y') is q turned by theta about the plate's normal; what is left of R is Ry(omega) Rx(phi).
        z = -so * x + co * sp * y + co * cp * height
        met = lx + slopes[0] * (z - height), ly + slopes[1] * (z - height), height
        x, y, qx, qy = _point(met, dx, dy, rotations)
    return qx, qy


def flat_points(poses: FloatArray, beams: FloatArray, arithmetic: Arithmetic = LIBRARY) -> FloatArray:
    """q_i = R(-theta)(l_i - d), (..., P, 2) m: the points of a plate that does not tilt; ``poses`` (..., 3)."""
    c = arithmetic.cos_many(poses[..., 2, None])
    s = arithmetic.sin_many(poses[..., 2, None])
    ux = beams[..., 0] - poses[..., 0, None]
    uy = beams[..., 1] - poses[..., 1, None]
    return np.stack((c * ux + s * uy, c * uy - s * ux), axis=-1)


def flat_pose(
    points: Sequence[float], beams: Sequence[tuple[float, float]], arithmetic: Arithmetic = LIBRARY
) -> tuple[float, float, float]:
    """(dX, dY, theta) of a flat plate whose ``points`` (q_1x, q_1y, q_2x, ...) are under ``beams``; m, rad.

    Unweighted: theta from the cross and dot products about the centroids, d from the centroids (the orthogonal
    Procrustes problem: Schoenemann 1966; Arun, Huang & Blostein 1987).
    """
    count = len(beams)
    total = arithmetic.total
    mx = total(points[0::2]) / count
    my = total(points[1::2]) / count
    nx = total([lx for lx, _ in beams]) / count
    ny = total([ly for _, ly in beams]) / count
    along = across = 0.0
    for i, (lx, ly) in enumerate(beams):
        qx = points[2 * i] - mx
        qy = points[2 * i + 1] - my
        along += qx * (lx - nx) + qy * (ly - ny)
        across += qx * (ly - ny) - qy * (lx - nx)
    theta = arithmetic.atan2(across, along)
    c, s = arithmetic.cos_sin(theta)
    return nx - c * mx + s * my, ny - s * mx - c * my, theta


def flat_poses(points: FloatArray, beams: FloatArray, arithmetic: Arithmetic = LIBRARY) -> FloatArray:
    """:func:`flat_pose` for arrays: (..., 3) of ``points`` and ``beams``, (..., P, 2) each."""
    middle = arithmetic.sum(beams, axis=-2) / beams.shape[-2]
    mean = arithmetic.sum(points, axis=-2) / points.shape[-2]
    lx = beams[..., 0] - middle[..., 0, None]
    ly = beams[..., 1] - middle[..., 1, None]
    ux = points[..., 0] - mean[..., 0, None]
    uy = points[..., 1] - mean[..., 1, None]
    across, along = arithmetic.sum(ux * ly - uy * lx, axis=-1), arithmetic.sum(ux * lx + uy * ly, axis=-1)
    theta = arithmetic.atan2_many(across, along)
    c = arithmetic.cos_many(theta)
    s = arithmetic.sin_many(theta)
    mx, my = mean[..., 0], mean[..., 1]
    return np.stack((middle[..., 0] - c * mx + s * my, middle[..., 1] - s * mx - c * my, theta), axis=-1)


def tied_pose(pose: FloatArray, slope_ratio: FloatArray | float, link_length: float) -> FloatArray:
    """(..., 5) from (..., 3): the tilts of a cantilever, phi = -k dY/L, omega = +k dX/L.

    ``slope_ratio`` k: one for all poses, or (...,) one for each.
    """
    tilt = np.asarray(slope_ratio)[..., None] / link_length * np.stack([-pose[..., 1], pose[..., 0]], axis=-1)
    return np.concatenate([np.broadcast_to(pose, (*tilt.shape[:-1], 3)), tilt], axis=-1)


def tie_matrix(slope_ratio: float, link_length: float) -> FloatArray:
    """(5, 3): d(dX, dY, theta, phi, omega)/d(dX, dY, theta) of a cantilever with slope ratio k."""
    out = np.eye(5, 3)
    out[3, 1] = -slope_ratio / link_length
    out[4, 0] = slope_ratio / link_length
    return out


Tilts = Literal['none', 'tied', 'bounded', 'free']
"""What a method says of the plate's tilts: it has none; they follow from the deflection, by a k that is given or only
bounded; they are unknowns."""


def reading_slopes(
    beams: FloatArray,
    heights: FloatArray,
    pose: FloatArray,
    tilts: Tilts,
    slope_ratio: float,
    link_length: float,
    arithmetic: Arithmetic = LIBRARY,
) -> FloatArray:
    """How the dots go with the unknowns at ``pose`` (5,): (2P, 3), (2P, 5) if the tilts are free; m/m and m/rad."""
    if tilts == 'none':
        heights, pose = np.zeros(len(beams)), np.array([*pose[:3], 0.0, 0.0])
    jacobian = crossings(pose, beams, heights, arithmetic)[1].reshape(-1, 5)
    if tilts == 'free':
        return jacobian
    # A flat plate's readings do not go with tilts at rest, to first order.
    return arithmetic.product(jacobian, tie_matrix(slope_ratio, link_length))
