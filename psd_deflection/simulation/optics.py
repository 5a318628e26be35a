"""Where the beams fall: on a plate that has moved, twisted and tilted, or from such a plate on PSDs at the base."""

from __future__ import annotations

import numpy as np

from psd_deflection.geometry.landing import landings
from psd_deflection.geometry.plate import points_under
from psd_deflection.records import FloatArray
from psd_deflection.simulation.physics import Physics


def dots_on_plate(pose: FloatArray, beams: FloatArray, physics: Physics) -> FloatArray:
    """Dots x1 y1 x2 y2 (4, n), m, from the PSD centres; ``pose`` (3, n), ``beams`` (4, n).

    The tilts are those of a cantilever, phi = -k dY/L and omega = k dX/L; k = 0 is a plate that stays parallel.
    """
    k = physics.slope_ratio / physics.length
    phi, omega = (-k * pose[1], k * pose[0]) if k != 0.0 else (np.zeros(1), np.zeros(1))
    fall = landings if physics.psds_at_base else points_under
    qx, qy = fall(beams[0::2], beams[1::2], physics.heights[:, None], pose[0], pose[1], pose[2], phi, omega)
    dots = np.empty_like(beams)
    np.subtract(qx, physics.centers[:, :1], out=dots[0::2])
    np.subtract(qy, physics.centers[:, 1:], out=dots[1::2])
    return dots
