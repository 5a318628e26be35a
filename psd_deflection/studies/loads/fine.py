# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Means of a few samples each: short enough for the motion of the link."""

from __future__ import annotations

import numpy as np

from psd_deflection.records import FloatArray

FINE_SECONDS = 0.004


def fine_means(rows: FloatArray, size: int, present: FloatArray | None = None) -> FloatArray:
    """Means (k, n // size) over ``size`` samples of rows (k, n).

    ``present`` (k, n): 1 for the samples that count, else 0; all of them by default. A mean of none is 0.
    """
    n = rows.shape[1] // size
    cut = rows[:, : n * size].reshape(rows.shape[0], n, size)
    if present is None:
        return _sums(cut) / size
    weights = present[:, : n * size].reshape(cut.shape)
    return _sums(cut * weights) / np.maximum(_sums(weights), 1.0)


def _sums(cut: FloatArray) -> FloatArray:
    """Sums over the last axis of ``cut`` (k, n, size): numpy's own sum over so few is several times slower."""
    total = cut[:, :, 0].copy()
    for i in range(1, cut.shape[2]):
        total += cut[:, :, i]
    return total
