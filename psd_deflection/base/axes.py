# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The three axes of the tip as people read them: symbols, units, and the factor from SI to what is shown."""

import math

import numpy as np

from psd_deflection.records import FloatArray

AXES = ('dx', 'dy', 'theta')
SYMBOLS = ('ΔX', 'ΔY', 'θ')
UNITS = ('m', 'm', 'rad')
MDEG = math.degrees(1e3)
"""Thousandths of a degree in a radian."""
SHOWN = (1e6, 1e6, MDEG)
"""µm, µm, mdeg of an SI unit."""
SHOWN_UNITS = ('µm', 'µm', 'mdeg')


def ranges(poses: FloatArray) -> list[tuple[str, str]]:
    """Symbol, and least and greatest in words, of ``poses`` (n, 3), m, m, rad; NaN is passed over."""
    low, high = np.nanmin(poses, axis=0) * SHOWN, np.nanmax(poses, axis=0) * SHOWN
    words = [f'{a:+.2f} … {b:+.2f} {unit}' for a, b, unit in zip(low, high, SHOWN_UNITS, strict=True)]
    return list(zip(SYMBOLS, words, strict=True))
