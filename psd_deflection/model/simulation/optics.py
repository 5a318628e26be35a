# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where the beams fall: on a plate that has moved, twisted and tilted, or from such a plate on PSDs at the base."""

from __future__ import annotations

import numpy as np

from psd_deflection.model.plate.landing import landings
from psd_deflection.model.plate.plate import points_under, points_under_leaning
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray


def dots_on_plate(pose: FloatArray, beams: FloatArray, physics: Physics) -> FloatArray:
    """Dots x1 y1 x2 y2 ... (2P, n), m, from the PSD centres; ``pose`` (3, n), ``beams`` (2P, n).

    The tilts are those of a cantilever, phi = -k dY/L and omega = k dX/L; k = 0 is a plate that stays parallel.
    """
    k = physics.slope_ratio / physics.length
    phi, omega = (-k * pose[1], k * pose[0]) if k != 0.0 else (np.zeros(1), np.zeros(1))
    places = beams[0::2], beams[1::2], physics.heights[:, None]
    moved = pose[0], pose[1], pose[2], phi, omega
    if physics.slopes.any() and not physics.psds_at_base:
        slopes = physics.slopes[:, :1], physics.slopes[:, 1:]
        qx, qy = points_under_leaning(places, slopes, moved, physics.xp)
    else:
        fall = landings if physics.psds_at_base else points_under
        qx, qy = fall(places, moved, physics.xp)
    dots = np.empty_like(beams)
    np.subtract(qx, physics.centers[:, :1], out=dots[0::2])
    np.subtract(qy, physics.centers[:, 1:], out=dots[1::2])
    return dots
