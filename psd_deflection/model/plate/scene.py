# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the viewers draw of a rig: the bent link and the boxes of the tip."""

from __future__ import annotations

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]
"""Centre and size, m."""


def bend(places: FloatArray) -> FloatArray:
    """Deflection at ``places`` (1: the tip) over that of the tip: a cantilever under a force at its tip."""
    return np.asarray(places**2 * (3.0 - places) / 2.0)


def tip_boxes(rig: Rig) -> list[Box]:
    """The plate, then each detector, in ``link_tip`` (the plate's axes)."""
    xs, ys = ([0.0, *(p.center[i] for p in rig.psds)] for i in (0, 1))
    side = 0.03
    middle = ((max(xs) + min(xs)) / 2, (max(ys) + min(ys)) / 2, 0.003)
    plate = (middle, (max(xs) - min(xs) + side, max(ys) - min(ys) + side, 0.004))
    return [plate, *(((*p.center, p.height), (*p.active_area, 0.002)) for p in rig.psds)]
