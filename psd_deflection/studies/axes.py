"""The three axes of the tip as people read them: symbols, units, and the factor from SI to what is shown."""

from __future__ import annotations

import math

AXES = ('dx', 'dy', 'theta')
SYMBOLS = ('ΔX', 'ΔY', 'θ')
UNITS = ('m', 'm', 'rad')
SHOWN = (1e6, 1e6, math.degrees(1e3))
SHOWN_UNITS = ('µm', 'µm', 'mdeg')
