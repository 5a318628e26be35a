# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Quaternion of the tip's rotation R = Ry(omega) Rx(phi) Rz(theta), and back."""

import math
from collections.abc import Mapping

Quaternion = dict[str, float]


def quaternion(theta: float, phi: float = 0.0, omega: float = 0.0) -> Quaternion:
    """Unit quaternion of R = Ry(omega) Rx(phi) Rz(theta); angles in rad.

    The product q_y q_x q_z, each (sin(a/2) axis, cos(a/2)); normalised once more, so that rounding
    does not leave it off unit length.
    """
    sx, cx = math.sin(0.5 * phi), math.cos(0.5 * phi)
    sy, cy = math.sin(0.5 * omega), math.cos(0.5 * omega)
    sz, cz = math.sin(0.5 * theta), math.cos(0.5 * theta)
    x = cy * sx * cz + sy * cx * sz
    y = sy * cx * cz - cy * sx * sz
    z = cy * cx * sz - sy * sx * cz
    w = cy * cx * cz + sy * sx * sz
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return {'x': x / length, 'y': y / length, 'z': z / length, 'w': w / length}


def angles(q: Mapping[str, float]) -> tuple[float, float, float]:
    """(theta, phi, omega), rad, of a quaternion of any non-zero length; phi in [-pi/2, pi/2].

    A quaternion of length zero (a message that was never filled in) gives NaN.
    """
    x, y, z, w = (float(q[k]) for k in 'xyzw')
    n = x * x + y * y + z * z + w * w
    if not 0.0 < n < math.inf:
        return (math.nan, math.nan, math.nan)
    phi = math.asin(min(1.0, max(-1.0, 2.0 * (x * w - y * z) / n)))
    theta = math.atan2(2.0 * (x * y + z * w), n - 2.0 * (x * x + z * z))
    omega = math.atan2(2.0 * (x * z + y * w), n - 2.0 * (x * x + y * y))
    return (theta, phi, omega)
