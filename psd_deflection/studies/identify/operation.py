# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The mode of a link that never rings alone: from the spectrum of its motion in operation.

What drives the link was not measured, so the spectrum is fitted with that of a mode that noise of
an unknown colour drives:

    S(f) = A (f/f0)^-s / ((f0^2 - f^2)^2 + (2 zeta f0 f)^2) + B

by the likelihood of its periodogram (Whittle, Arkiv for Matematik 2, 423, 1953), which gives the
uncertainties too. A spectrum that does not look like this gives no mode.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

from psd_deflection.records import FloatArray
from psd_deflection.studies.identify.axis_modes import LEAST_DAMPING, Mode

SLOPE_SD = 1.0
"""What drives a link has a spectrum that falls as frequency^-s; s before anything is known."""
ODDS = 1e-3
"""A spectrum that a driven mode has less often than that is not one of a driven mode."""


def mode_in_operation(samples: FloatArray, rate: float, frequency: float) -> Mode | None:
    """Return the mode from the spectrum of a link that is driven all the time."""
    from scipy.signal import detrend, periodogram

    f, p = periodogram(detrend(samples), rate, detrend=False, window='hann')
    # Neighbours of a Hann window know of each other: every second one.
    band = (f > 0.6 * frequency) & (f < 1.5 * frequency)
    f, p = np.asarray(f[band][::2], dtype=np.float64), np.asarray(p[band][::2], dtype=np.float64)
    if len(f) < 30:
        return None
    top = float(np.max(p))

    def density(x: FloatArray) -> FloatArray:
        a, f0, zeta, b = np.exp(x[:4])
        out: FloatArray = a * (f / f0) ** -x[4] / ((f0**2 - f**2) ** 2 + (2.0 * zeta * f0 * f) ** 2) + b
        return out

    def loss(x: FloatArray) -> float:
        s = density(x)
        return float(np.sum(np.log(s) + p / s)) + 0.5 * float(x[4] / SLOPE_SD) ** 2

    best = None
    for zeta in (0.005, 0.02, 0.08):
        sizes = [top * 4.0 * zeta**2 * frequency**4 * 0.3, frequency, zeta, float(np.median(p)) * 0.1 + 1e-30]
        start = np.array([*np.log(sizes), 0.0])
        tried = minimize(
            loss,
            start,
            method='Nelder-Mead',
            options={'maxfev': 6000, 'xatol': 1e-6, 'fatol': 1e-6},
        )
        if best is None or tried.fun < best.fun:
            best = tried
    if best is None or not scatters_as_exponential(p / density(best.x)):
        return None
    a, f0, zeta, _ = (float(v) for v in np.exp(best.x[:4]))
    if not 0.7 * frequency < f0 < 1.4 * frequency or not 10.0 * LEAST_DAMPING < zeta < 0.5:
        return None
    information = information_of(density, best.x)
    information[4, 4] += SLOPE_SD**-2
    covariance = np.linalg.pinv(information)
    # The area under the mode's density.
    rms = math.sqrt(a * math.pi / (4.0 * zeta * f0**3))
    return Mode(f0, f0 * math.sqrt(covariance[1, 1]), zeta, zeta * math.sqrt(covariance[2, 2]), rms)


def scatters_as_exponential(ratios: FloatArray) -> bool:
    """Whether ``ratios`` (n,) of a periodogram to a density are as the right one leaves them: exponential, mean 1."""
    from scipy.stats import gamma

    chances = [
        2.0 * len(parts) * min(below, 1.0 - below)
        for length in (4, max(len(ratios) // 8, 5))
        for parts in [np.array_split(ratios, len(ratios) // length)]
        for part in parts
        for below in [float(gamma.cdf(part.sum(), len(part)))]
    ]
    return min(chances) > 0.5 * ODDS


def information_of(density: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    """Fisher's information of Whittle's likelihood: the products of the derivatives of log S, summed."""
    step = 1e-5
    columns = []
    for i in range(len(x)):
        ahead, behind = x.copy(), x.copy()
        ahead[i] += step
        behind[i] -= step
        columns.append((np.log(density(ahead)) - np.log(density(behind))) / (2.0 * step))
    jacobian = np.column_stack(columns)
    out: FloatArray = jacobian.T @ jacobian
    return out
