# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""PSDs at the base under lasers on the plate: pose -> dots, with derivatives.

Laser i sits at (l_x, l_y) on the plate and shines along the plate's normal; PSD i has its surface at height h_i over
the reference section. The plate is turned by R = Ry(omega) Rx(phi) Rz(theta) (thesis 5.3, exact), so with
(a_x, a_y) = Rz(theta)(l_x, l_y) the dot is at

    x = dX + a_x/cos(omega) + h tan(omega),
    y = dY + a_y/cos(phi) - a_x tan(omega) tan(phi) - h tan(phi)/cos(omega).

``landing`` takes floats: a solver calls it once a block. ``landings`` is the same formula for arrays.
"""

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.model.plate.plate import Beam, Number, Pose, Rotations, Row, rotations_of
from psd_deflection.records import FloatArray


def _place(
    beam: Beam[Number], dx: Number, dy: Number, rotations: Rotations[Number]
) -> tuple[Number, Number, Number, Number]:
    """a_x, a_y, x, y as in the module's text."""
    lx, ly, height = beam
    ct, st, cp, sp, co, so = rotations
    ax, ay = ct * lx - st * ly, st * lx + ct * ly
    across = ax * so + height
    return ax, ay, dx + (ax + height * so) / co, dy + ay / cp - across * sp / (cp * co)


def landing(beam: Beam[float], pose: Pose[float], arithmetic: Arithmetic = LIBRARY) -> tuple[float, float, Row, Row]:
    """(x, y, dx, dy) of one laser's dot: m; m/m for dX, dY and m/rad for the angles."""
    dx, dy, theta, phi, omega = pose
    height = beam[2]
    cos_sin = arithmetic.cos_sin
    rotations = *cos_sin(theta), *cos_sin(phi), *cos_sin(omega)
    _, _, cp, sp, co, so = rotations
    ax, ay, x, y = _place(beam, dx, dy, rotations)
    return (
        x,
        y,
        (1.0, 0.0, -ay / co, 0.0, (ax * so + height) / (co * co)),
        (
            0.0,
            1.0,
            ax / cp + ay * so * sp / (co * cp),
            (ay * sp - (ax * so + height) / co) / (cp * cp),
            -sp * (ax + height * so) / (cp * co * co),
        ),
    )


def landings(
    beam: Beam[FloatArray], pose: Pose[FloatArray], arithmetic: Arithmetic = LIBRARY
) -> tuple[FloatArray, FloatArray]:
    """x and y, m, from arrays whose shapes broadcast; for long runs of samples."""
    dx, dy, theta, phi, omega = pose
    return _place(beam, dx, dy, rotations_of(theta, phi, omega, arithmetic))[2:]
