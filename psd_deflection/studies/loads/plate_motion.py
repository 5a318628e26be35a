# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Readings taken apart: a movement of the plate, and the 2P - 3 combinations of P PSDs that no movement of a plate
makes."""

import numpy as np
from scipy.linalg import null_space

from psd_deflection.model.plate.linear import design_matrix
from psd_deflection.records import FloatArray, dot_channels
from psd_deflection.rig.config import Rig


def dot_rows(psds: int) -> list[int]:
    """Which of the channels of so many PSDs are coordinates of the dots, as an index."""
    return list(dot_channels(psds))


def dots_of(rig: Rig, volts: FloatArray) -> FloatArray:
    """Return the dots x1 y1 x2 ... (2P, m), m, of readings (3P, m), V."""
    return np.asarray(volts[dot_rows(len(rig.psds))] * rig.sensitivities.reshape(-1, 1))


def moved_plate(rig: Rig, volts: FloatArray, there: FloatArray) -> FloatArray:
    """Return the plate's movement (3, m), m, m, rad, of readings (3P, m), V; NaN where one is missing (``there`` 0)."""
    dots = dots_of(rig, volts)
    out = np.linalg.pinv(design_matrix(rig.centers + rig.zeros)) @ dots
    out[:, (there[dot_rows(len(rig.psds))] <= 0.0).any(axis=0)] = np.nan
    return np.asarray(out)


def across_plate(rig: Rig, volts: FloatArray) -> FloatArray:
    """What no movement of the plate makes (2P - 3, m), m, of readings (3P, m), V."""
    dots = dots_of(rig, volts)
    return np.array([row @ dots for row in across_of(rig)])


def across_of(rig: Rig) -> FloatArray:
    """(2P - 3, 2P): the combinations of the dots, orthonormal, that no movement of the plate moves."""
    return np.asarray(null_space(design_matrix(rig.centers + rig.zeros).T).T)


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
