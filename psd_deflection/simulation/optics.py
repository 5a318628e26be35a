"""Where parallel beams fall on a plate that has moved, twisted and tilted."""

from __future__ import annotations

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.simulation.physics import Physics


def dots_on_plate(pose: FloatArray, beams: FloatArray, physics: Physics) -> FloatArray:
    """Dots x1 y1 x2 y2 (4, n), m, from the PSD centres; ``pose`` (3, n), ``beams`` (4, n).

    The plate point q_i under beam l_i has d + R (q_i, h_i) = l_i in X and Y, with
    R = Ry(omega) Rx(phi) Rz(theta), phi = -k dY/L, omega = k dX/L (docs/methods.md). The upper
    left of Ry Rx is triangular, so that the system solves in closed form; without tilt it is
    q = Rz(-theta)(l - d).
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dots = np.empty_like(beams)
    k = physics.slope_ratio / physics.length
    if k != 0.0:
        phi, omega = -k * pose[1], k * pose[0]
        cp, sp, co, so = np.cos(phi), np.sin(phi), np.cos(omega), np.sin(omega)
    for i in range(2):
        u = beams[2 * i] - pose[0]
        v = beams[2 * i + 1] - pose[1]
        if k != 0.0:
            h = float(physics.heights[i])
            v = (v + sp * h) / cp
            u = (u - so * cp * h - so * sp * v) / co
        dots[2 * i] = c * u + s * v - physics.centers[i, 0]
        dots[2 * i + 1] = c * v - s * u - physics.centers[i, 1]
    return dots
