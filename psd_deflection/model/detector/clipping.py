# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the edges of a detector's active area leave of a spot. A run needs none of it: nothing takes it back."""

import numpy as np
from scipy.special import ndtr

from psd_deflection.records import FloatArray

_LEAST_SHARE = 1e-9
"""Share of a spot that is left at least: of less light no detector reads a place."""


def cut_by_edges(
    place: FloatArray, half: float | FloatArray, radius: float | FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Share of a Gaussian spot between two edges at +-``half``, m, and the shift of its centroid, m.

    ``radius``: where the intensity is 1/e^2 of its peak, m: two standard deviations. The edges cut x and y
    independently, so each coordinate is the mean of a truncated normal.
    """
    sigma = 0.5 * radius
    a, b = (-half - place) / sigma, (half - place) / sigma
    share = np.maximum(ndtr(b) - ndtr(a), _LEAST_SHARE)
    density = np.exp(-0.5 * a * a) - np.exp(-0.5 * b * b)
    return share, sigma * density / (np.sqrt(2.0 * np.pi) * share)


def cut_disc(distance: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """Share of an even disc that one edge at ``distance`` from its centre leaves, and how far its centroid moves, m."""
    u = np.clip(distance / radius, -0.999, 1.0)
    root = np.sqrt(1.0 - u * u)
    share = 1.0 - (np.arccos(u) - u * root) / np.pi
    return share, (2.0 / (3.0 * np.pi)) * radius * root**3 / share
