"""Readings taken apart: a movement of the plate, and what no movement of a plate makes of four readings."""

from __future__ import annotations

import numpy as np
from scipy.linalg import null_space

from psd_deflection.model.plate.linear import design_matrix
from psd_deflection.records import DOT_CHANNELS, FloatArray
from psd_deflection.rig.config import Rig

DOTS = list(DOT_CHANNELS)


def moved_plate(rig: Rig, volts: FloatArray, there: FloatArray) -> FloatArray:
    """The plate's movement (3, m), m, m, rad, of readings (6, m), V; NaN where one is missing (``there`` 0)."""
    dots = volts[DOTS] * rig.sensitivities.reshape(4, 1)
    out = np.linalg.pinv(design_matrix(rig.centers + rig.zeros)) @ dots
    out[:, (there[DOTS] <= 0.0).any(axis=0)] = np.nan
    return np.asarray(out)


def across_plate(rig: Rig, volts: FloatArray) -> FloatArray:
    """What no movement of the plate makes (m,), m, of readings (6, m), V."""
    return np.asarray(across_of(rig) @ (volts[DOTS] * rig.sensitivities.reshape(4, 1)))


def across_of(rig: Rig) -> FloatArray:
    """(4,): the combination of the dots, of length 1, that no movement of the plate moves."""
    return np.asarray(null_space(design_matrix(rig.centers + rig.zeros).T)[:, 0])
