"""Lasers on the tip plate, PSDs at the base (thesis 5.3): where each laser falls.

A beam leaves the plate at (lx, ly) along the plate's normal and meets the base plane of its PSD, ``height`` above the
reference section (negative towards the base). The plate is turned by R = Ry(omega) Rx(phi) Rz(theta).
"""

from __future__ import annotations

from math import cos, sin, tan

from psd_deflection.geometry.plate import Row


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
