# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Loads that a load cell measured: their mean from one step to the next, and how exact that is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from psd_deflection.records import FloatArray

SHARE = 0.02
"""Loads that change at more than this share of the samples were measured, not noted by a person."""
STEP = 8.0
"""Standard deviations of a load cell's noise beyond which the load itself has changed."""
VALUES = 20
"""Between two steps there are at least so many values, or nothing tells noise from motion."""
WHITE = 0.15
"""Largest correlation of neighbouring values that is still noise."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredLoad:
    """The mean of what a load cell measured at samples ``first`` to ``last``; ``sd`` (3,) of the mean, N, N, N m."""

    first: int
    last: int
    sd: FloatArray


def without_cell_noise(loads: FloatArray) -> tuple[FloatArray, tuple[MeasuredLoad, ...]]:
    """``loads`` (n, 3) as measured by a load cell, with the mean from one step to the next, and how exact each is.

    A load of 0.05 N more or less at every sample moves the simulated link as no hung weight does. What is not white
    between two steps is motion, and stays.
    """
    changed = np.flatnonzero(np.any(np.diff(loads, axis=0) != 0.0, axis=1)) + 1
    if len(changed) < max(SHARE * len(loads), 50):
        return loads, ()
    at = np.concatenate(([0], changed))
    values = loads[at]
    apart = np.diff(values, axis=0)
    noise = 1.4826 * np.median(np.abs(apart), axis=0) / math.sqrt(2.0)
    # A channel that measures nothing has no steps either.
    steps = np.flatnonzero(np.any(np.abs(apart) > STEP * np.maximum(noise, 1e-9), axis=1)) + 1
    edges = np.concatenate(([0], steps, [len(values)]))
    out = loads.copy()
    measured = []
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        part = values[a:b]
        last = at[b] if b < len(at) else len(loads)
        if b - a < VALUES:
            continue
        centred = part - part.mean(axis=0)
        memory = np.abs((centred[1:] * centred[:-1]).sum(axis=0)) / np.maximum((centred**2).sum(axis=0), 1e-300)
        if np.any(memory[noise > 0.0] > max(WHITE, 4.0 / math.sqrt(b - a))):
            continue
        lengths = np.diff(np.append(at[a:b], last))
        out[at[a] : last] = (part * lengths[:, None]).sum(axis=0) / lengths.sum()
        sd = np.sqrt((centred**2).mean(axis=0) / (b - a))
        measured.append(MeasuredLoad(int(at[a]), int(last), sd))
    return out, tuple(measured)
