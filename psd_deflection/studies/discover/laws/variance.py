# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Noise that follows a variable: the likelihood of whitened values whose variance grows with its square."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from psd_deflection.records import FloatArray, channel_names
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.workspace import Workspace


def most_jitter(
    ws: Workspace, fit: Fit, known: Mapping[str, Sequence[FloatArray]]
) -> tuple[tuple[float, str, str, float, float] | None, int]:
    """Gain, channel, variable, slope and its greatest square, where the noise follows a variable most; how many were
    tried.
    """
    best: tuple[float, str, str, float, float] | None = None
    tried = 0
    for c, channel in enumerate(channel_names(ws.psds)):
        squares = np.concatenate([part[c] for part in ws.split(fit.residual)]) ** 2
        there = squares > 0.0
        for name, values in known.items():
            v2 = np.concatenate(values) ** 2
            full = float(v2.max())
            if full <= 0.0:
                continue
            tried += 1
            a, b = variance(squares[there], v2[there] / full)
            gain = likelihood(squares[there], a + b * v2[there] / full) - likelihood(
                squares[there], squares[there].mean()
            )
            if best is None or gain > best[0]:
                best = gain, channel, name, b / full, full
    return best, tried


def likelihood(squares: FloatArray, variance: FloatArray | float) -> float:
    """Twice the log-likelihood of whitened values, up to a constant."""
    v = np.broadcast_to(np.asarray(variance), squares.shape)
    return float(-np.sum(np.log(v) + squares / v))


def variance(squares: FloatArray, v2: FloatArray) -> tuple[float, float]:
    """a and b of variance = a + b v2, the likeliest: weighted least squares on the squares, in turn."""
    a, b = float(squares.mean()), 0.0
    columns = np.stack([np.ones_like(v2), v2], axis=1)
    for _ in range(8):
        weight = 1.0 / (a + b * v2)
        solution = np.linalg.lstsq(columns * weight[:, None], squares * weight, rcond=None)[0]
        a, b = max(float(solution[0]), 0.05), max(float(solution[1]), 0.0)
    return a, b
