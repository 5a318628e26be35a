# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How far the simulation itself is believed: what it explains may be wrong by a small share, per channel and band.

Two integrators of the same equations differ, sensors are not exactly what their formula says, a weight is not exactly
its number. So what remains after a large effect is only taken for another effect if it is more than ``RELATIVE`` of
what the model explains there: in that channel, in that frequency band. A share of the whole would hide a small effect
behind a large one that shows elsewhere.
"""

from __future__ import annotations

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison

RELATIVE = 0.002
"""Share of the explained movement, as an amplitude, by which the simulation may be wrong."""

BANDS = (0.0, 2.0, 9.0, 17.0, 25.0, 60.0, 125.0)
"""Edges, Hz; the last band has no upper end."""


def energies(workspace: Comparison, vector: FloatArray) -> FloatArray:
    """Chi-square of a whitened vector (D,) by recording, channel and band: (recordings, channels, bands)."""
    out = []
    for part, period in zip(workspace.split(vector), workspace.periods, strict=True):
        n = part.shape[1]
        power = np.abs(np.fft.rfft(part, axis=1)) ** 2 * (2.0 / n)
        power[:, 0] *= 0.5
        if n % 2 == 0:
            power[:, -1] *= 0.5
        starts = np.searchsorted(np.fft.rfftfreq(n, period), BANDS[:-1])
        padded = np.concatenate((power, np.zeros((len(power), 1))), axis=1)
        band = np.add.reduceat(padded, np.minimum(starts, power.shape[1]), axis=1)
        # reduceat gives the element itself for a band without frequencies.
        out.append(np.where(np.diff([*starts, power.shape[1]]) > 0, band, 0.0))
    return np.stack(out)


def gain_beyond(workspace: Comparison, smaller: FloatArray, larger: FloatArray, explained: FloatArray) -> float:
    """Chi-square gained from residual ``smaller`` to residual ``larger`` (D,), whitened, beyond the simulation's error.

    ``explained`` (D,): what the smaller model explains. A gain in a channel and band in which this error alone may give
    as much does not count; a loss counts.
    """
    if not np.any(explained):
        return float(smaller @ smaller - larger @ larger)
    gain = energies(workspace, smaller) - energies(workspace, larger)
    allowed = RELATIVE**2 * energies(workspace, explained)
    return float(gain[(gain > allowed) | (gain < 0.0)].sum())
