"""Lasers on the tip plate, PSDs at the base (thesis 5.3): where each laser falls, scalar and for many poses.

A beam leaves the plate at (lx, ly) along the plate's normal and meets the base plane of its PSD, ``height`` above the
reference section (negative towards the base). The plate is turned by R = Ry(omega) Rx(phi) Rz(theta).
"""

from __future__ import annotations

from math import cos, sin, tan

import numpy as np

from psd_deflection.geometry.plate import Row
from psd_deflection.records import FloatArray


def landing(
    lx: float, ly: float, height: float, dx: float, dy: float, theta: float, phi: float, omega: float
) -> tuple[float, float, Row, Row]:
    """Where laser (lx, ly) falls in the plane at ``height``, and the derivatives of that."""
    ct = cos(theta)
    st = sin(theta)
    ax = ct * lx - st * ly
    ay = st * lx + ct * ly
    co = cos(omega)
    cp = cos(phi)
    to = tan(omega)
    tp = tan(phi)
    return (
        dx + ax / co + height * to,
        dy + ay / cp - ax * to * tp - height * tp / co,
        (1.0, 0.0, -ay / co, 0.0, (ax * sin(omega) + height) / (co * co)),
        (
            0.0,
            1.0,
            ax / cp + ay * to * tp,
            (ay * sin(phi) - ax * to - height / co) / (cp * cp),
            -tp * (ax + height * sin(omega)) / (co * co),
        ),
    )


def landings(beams: FloatArray, heights: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same for n poses (n, 5): places (n, 2P) and derivatives (n, 2P, 5)."""
    dx, dy, theta, phi, omega = (poses[:, i, None] for i in range(5))
    ax, ay = _turned(beams[:, 0], beams[:, 1], theta)
    co = np.cos(omega)
    cp = np.cos(phi)
    to = np.tan(omega)
    tp = np.tan(phi)
    n, count = ax.shape
    place = np.empty((n, 2 * count))
    place[:, 0::2], place[:, 1::2] = landing_places(beams[:, 0], beams[:, 1], heights, dx, dy, theta, phi, omega)
    j = np.zeros((n, 2 * count, 5))
    j[:, 0::2, 0] = 1.0
    j[:, 1::2, 1] = 1.0
    j[:, 0::2, 2] = -ay / co
    j[:, 1::2, 2] = ax / cp + ay * to * tp
    j[:, 1::2, 3] = (ay * np.sin(phi) - ax * to - heights / co) / (cp * cp)
    j[:, 0::2, 4] = (ax * np.sin(omega) + heights) / (co * co)
    j[:, 1::2, 4] = -tp * (ax + heights * np.sin(omega)) / (co * co)
    return place, j


def landing_places(
    lx: FloatArray,
    ly: FloatArray,
    height: FloatArray,
    dx: FloatArray,
    dy: FloatArray,
    theta: FloatArray,
    phi: FloatArray,
    omega: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """x and y of the places alone, m, one array for each coordinate, of any shapes that broadcast."""
    ax, ay = _turned(lx, ly, theta)
    tilt = np.tan(phi)
    lean = np.tan(omega)
    co = np.cos(omega)
    return dx + ax / co + height * lean, dy + ay / np.cos(phi) - ax * lean * tilt - height * tilt / co


def _turned(lx: FloatArray, ly: FloatArray, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    return np.cos(theta) * lx - np.sin(theta) * ly, np.sin(theta) * lx + np.cos(theta) * ly
