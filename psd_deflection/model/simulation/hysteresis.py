# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The play operator y <- min(max(y, x - r), x + r) of half width r, which makes a loop.

Each sample clamps the state, and a composition of clamps is a clamp. So a prefix scan computes the whole samples
without a loop.
"""

from __future__ import annotations

import numpy as np

from psd_deflection.records import FloatArray


def play(x: FloatArray, half_width: float, start: float) -> FloatArray:
    """Play operator over (n,) inputs from state ``start``; exact selections, no rounding of its own."""
    moved = np.flatnonzero(np.diff(x)) + 1
    kept = np.concatenate(([0], moved))
    low, high = x[kept] - half_width, x[kept] + half_width
    reach = 1
    while reach < len(kept):
        low0, high0 = low[:-reach], high[:-reach]
        low1, high1 = low[reach:], high[reach:]
        low = np.concatenate((low[:reach], np.minimum(np.maximum(low0, low1), high1)))
        high = np.concatenate((high[:reach], np.minimum(np.maximum(high0, low1), high1)))
        reach *= 2
    settled = np.minimum(np.maximum(start, low), high)
    return np.repeat(settled, np.diff(np.concatenate((kept, [len(x)]))))
