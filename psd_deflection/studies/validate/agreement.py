# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What two instruments that measured the same motion differ by: bias and 95 % limits (Bland and Altman, Lancet 327,
307, 1986), and scale and noise by regression of the reference on the estimate, the less noisy of the two."""

import math
from dataclasses import dataclass

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.studies.validate.clock import variance_of_sum

MOVES, CERTAIN = 0.2, 0.1
"""Slope of the reference on the estimate beyond which both move, and its largest standard deviation: without motion
the slope is that of noise on noise."""


@dataclass(frozen=True)
class Agreement:
    """Estimate minus reference on one axis, in m or rad.

    ``bias``: mean difference. ``limits``: bias ± 1.96 standard deviations of the differences. ``scale``: by how much
    the estimate is larger, as a share. ``noise``: standard deviation of what bias and scale leave. ``rms``,
    ``largest``: of the differences. ``share``: ``rms`` as a share of the largest deflection of the reference. ``*_sd``:
    standard deviations of the figures. ``scale`` and ``share`` are NaN if the link did not move along this axis.
    ``mirrored``: the reference moves the other way.
    """

    bias: float
    bias_sd: float
    limits: tuple[float, float]
    scale: float
    scale_sd: float
    noise: float
    rms: float
    largest: float
    share: float
    mirrored: bool = False


def agreement(estimate: FloatArray, reference: FloatArray) -> Agreement:
    """Compare ``estimate`` (k,) with ``reference`` (k,), both finite, of one axis."""
    k = len(estimate)
    difference = estimate - reference
    bias = float(difference.mean())
    scatter = difference - bias
    sd = float(np.sqrt((scatter * scatter).sum() / (k - 1)))
    centred = estimate - estimate.mean()
    power = float(centred @ centred)
    slope, slope_sd, noise, mirrored = math.nan, math.nan, sd, False
    if power > 0.0:
        slope = float(centred @ reference) / power
        residual = reference - reference.mean() - slope * centred
        noise = float(np.sqrt((residual * residual).sum() / (k - 2)))
        slope_sd = math.sqrt(max(variance_of_sum(centred * residual), noise**2 * power)) / power
        mirrored = slope < -MOVES and slope_sd < CERTAIN
        if not (slope > MOVES and slope_sd < CERTAIN):
            slope, slope_sd = math.nan, math.nan
            noise = sd
    rms = float(np.sqrt((difference * difference).mean()))
    deflection = float(np.abs(reference).max())
    return Agreement(
        bias=bias,
        bias_sd=math.sqrt(max(variance_of_sum(scatter), sd * sd * k)) / k,
        limits=(bias - 1.96 * sd, bias + 1.96 * sd),
        scale=1.0 / slope - 1.0,
        scale_sd=slope_sd / slope**2,
        noise=noise,
        rms=rms,
        largest=float(np.abs(difference).max()),
        share=rms / deflection if math.isfinite(slope) else math.nan,
        mirrored=mirrored,
    )
