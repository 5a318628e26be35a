# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The one criterion for whatever moves an arm: no step between two commands is larger than its rate times the time."""

import itertools
from collections.abc import Sequence

import numpy as np

from psd_deflection.records import FloatArray


def largest_step(stamps: Sequence[float], commands: Sequence[FloatArray], max_rate: float) -> float:
    """The largest step over ``max_rate`` times the time between the two, 1 at most if all is well; 0 of fewer than two.
    ``stamps`` (n,): when ``commands`` (n, joints) were sent, s. Infinite if one is not finite or time stands still."""
    if len(commands) < 2:
        return 0.0
    sent = np.array(commands)
    steps = np.abs(np.diff(sent, axis=0)).max(axis=1)
    if not np.all(np.isfinite(sent)):
        return float('inf')
    allowed = max_rate * np.diff(np.array(stamps))
    # A nanosecond is the resolution of a stamp.
    with np.errstate(divide='ignore', invalid='ignore'):
        shares = np.where(steps <= 1e-9 * max_rate, 0.0, steps / np.maximum(allowed, 0.0))
    return float(shares.max())


def largest_step_in_time(
    stamps: Sequence[float], commands: Sequence[FloatArray], max_rate: float, late: Sequence[int]
) -> float:
    """The same without the steps to the commands of the numbers ``late``, before which something came too late."""
    cuts = sorted({0, *(n for n in late if 0 < n < len(stamps)), len(stamps)})
    parts = [slice(a, b) for a, b in itertools.pairwise(cuts)]
    return max((largest_step(stamps[part], commands[part], max_rate) for part in parts), default=0.0)
