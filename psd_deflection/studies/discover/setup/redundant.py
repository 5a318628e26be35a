"""Two PSDs give four readings, a plate has three ways to move: the fourth reading, asked before any model of the link.

What the readings lack to the simulation is taken apart: a movement of the plate, and what no movement of a plate makes.
If the latter is noise, no detector, beam or amplifier is at fault, as far as its fault would show there; if it is more,
one of them is, and the link may be as well.
"""

from __future__ import annotations

import numpy as np

from psd_deflection.model.plate.linear import design_matrix
from psd_deflection.records import DOT_CHANNELS, FloatArray
from psd_deflection.rig.config import Rig

DOTS = list(DOT_CHANNELS)


def plate_of(rig: Rig) -> FloatArray:
    """(4, 3): movements of the dots, m, by dX, dY, m, and theta, rad."""
    return design_matrix(rig.centers + rig.zeros)


def moved_plate(rig: Rig, volts: FloatArray, there: FloatArray) -> FloatArray:
    """The plate's movement (3, m), m, m, rad, of readings (6, m), V; NaN where one is missing (``there`` 0)."""
    dots = volts[DOTS] * rig.sensitivities.reshape(4, 1)
    out = np.linalg.pinv(plate_of(rig)) @ dots
    out[:, (there[DOTS] <= 0.0).any(axis=0)] = np.nan
    return np.asarray(out)
