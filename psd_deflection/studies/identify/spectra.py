# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Modes of one axis, and the spectrum from which they stand out: peaks, white and coloured noise, operation."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.optimize import minimize

from psd_deflection.records import FloatArray

LEAST_DAMPING, MOST_DAMPING = 1e-6, 0.7
"""Bounds of the fit. A damping ratio at one of them is no answer."""


@dataclass(frozen=True)
class Mode:
    """One mode on one axis.

    ``frequency``, Hz, undamped; ``damping``: ratio; ``*_sd``: standard deviations. ``amplitude``:
    largest of the stretches at their start, m or rad; of a spectrum, rms.
    """

    frequency: float
    frequency_sd: float
    damping: float
    damping_sd: float
    amplitude: float


@dataclass(frozen=True)
class AxisModes:
    """The modes of one axis, the loudest first.

    ``how``: fitted to the link ringing alone, or to the spectrum of its motion in operation;
    ``none`` if it does not move. ``stretches``: first and last sample of each. ``fitted`` (n,): the
    fit, NaN between the stretches. ``noise``: standard deviation of a sample, m or rad. ``why``: why there is none,
    if not for want of motion.
    """

    modes: tuple[Mode, ...]
    how: Literal['ring-down', 'operation', 'none']
    stretches: tuple[tuple[int, int], ...]
    fitted: FloatArray = field(repr=False)
    noise: float
    why: str = ''


LOWEST, HIGHEST = 0.5, 200.0
"""Hz. Of the modes that are looked for; at most a quarter of the sample rate."""
PEAK = 25.0
"""Factor by which a peak of the spectrum must exceed the noise..."""
STANDS_OUT = 30.0
"""...and a further peak the spectrum around it, because steps alone make the spectrum ripple."""


def filled_up(samples: FloatArray) -> FloatArray:
    """Lost samples on straight lines between their neighbours."""
    there = np.flatnonzero(np.isfinite(samples))
    return np.interp(np.arange(len(samples)), there, samples[there])


def white_noise(samples: FloatArray) -> float:
    """Standard deviation of the noise of one sample: fourth differences, which no slow motion reaches."""
    difference = np.diff(samples, 4)
    difference = difference[np.isfinite(difference)]
    # The sum of squares of 1 4 6 4 1 is 70. The quietest quarter: in the rest the link may be
    # struck.
    pieces = np.array_split(difference, max(1, len(difference) // 500))
    scatter = sorted(float(np.mean(p * p)) for p in pieces if len(p))
    return math.sqrt(float(np.mean(scatter[: max(1, len(scatter) // 4)])) / 70.0)


def _spectrum(samples: FloatArray, rate: float) -> tuple[FloatArray, FloatArray]:
    from scipy.signal import welch

    length = min(len(samples) - 1, int(8 * rate))
    # The difference of neighbours: steps and creep are slow and would hide a mode.
    f, p = welch(np.diff(samples) * rate, rate, nperseg=length, detrend='constant')
    return np.asarray(f, dtype=np.float64), np.asarray(p, dtype=np.float64)


def loudest_peak(samples: FloatArray, rate: float, noise: float, beside: Sequence[float] = ()) -> float | None:
    """Frequency of the loudest peak, Hz, not at those of ``beside``; None if none stands out."""
    f, p = _spectrum(samples, rate)
    inside = (f >= LOWEST) & (f <= min(HIGHEST, rate / 4.0))
    # Of white noise of this size, differences taken.
    floor = 2.0 * noise**2 * rate * 2.0 * (1.0 - np.cos(2.0 * np.pi * f / rate))
    free = inside
    for taken in beside:
        free = free & (np.abs(f - taken) >= max(0.15 * taken, 2.0 * f[1]))
    at = int(np.argmax(p * free))
    if not free[at] or not p[at] >= PEAK * floor[at] or p[at] < max(p[at - 1], p[at + 1]):
        return None
    about = inside & (np.abs(f - f[at]) < 0.5 * f[at]) & (np.abs(f - f[at]) > 0.2 * f[at])
    if about.any() and p[at] < (STANDS_OUT if beside else 4.0) * np.median(p[about]):
        return None
    return float(f[at])


@dataclass(frozen=True)
class ColouredNoise:
    """Noise of density ``white`` + ``random_walk`` / (2 - 2 cos w), one-sided: at least that of an autoregression."""

    white: float
    random_walk: float

    def density(self, f: FloatArray, rate: float) -> FloatArray:
        """At the frequencies ``f``, Hz."""
        return self.white + self.random_walk / np.maximum(2.0 - 2.0 * np.cos(2.0 * np.pi * f / rate), 1e-9)

    def deviation(self, lowest: float, rate: float) -> float:
        """Standard deviation of a sample, of what lies above ``lowest`` Hz."""
        f = np.linspace(lowest, 0.5 * rate, 2000)
        return math.sqrt(float(self.density(f, rate).mean()) * (0.5 * rate - lowest))


def coloured_noise(filled: FloatArray, rate: float, peaks: Sequence[float]) -> ColouredNoise:
    """Return the noise, from the spectrum of the quieter times above the modes that have their ``peaks`` there, Hz.

    A mode falls off faster above its frequency than noise that remembers.
    """
    from scipy.optimize import nnls
    from scipy.signal import stft

    # A window whose side lobes are below the noise of a ringing a thousand times as loud.
    length = min(len(filled), max(64, round(4.0 * rate / min(peaks))))
    f, _, z = stft(filled, rate, 'blackmanharris', length, scaling='psd', boundary=None, padded=False)
    # Of noise a quarter of the squares lie below this share of their mean.
    p = 2.0 * np.quantile(np.abs(z) ** 2, 0.25, axis=1) / -math.log(0.75)
    edges = np.geomspace(2.5 * peaks[0], 0.48 * rate, 25)
    bands = [
        (at, p[at].mean())
        for low, high in itertools.pairwise(edges)
        if (at := (f >= low) & (f < high) & np.all([np.abs(f - k) > 0.4 * k for k in peaks], axis=0)).any()
    ]
    if len(bands) < 4 or min(power for _, power in bands) <= 0.0:
        return ColouredNoise(float(np.median(p)), 0.0)
    shapes = [ColouredNoise(1.0, 0.0).density(f, rate), ColouredNoise(0.0, 1.0).density(f, rate)]
    shapes += [1.0 / ((k * k - f * f) ** 2 + 1e-2 * k**4) for k in peaks]
    matrix = np.array([[shape[at].mean() / power for shape in shapes] for at, power in bands])
    sizes = np.linalg.norm(matrix, axis=0)
    weights, _ = nnls(matrix / sizes, np.ones(len(bands)))
    white, random_walk = (weights / sizes)[:2]
    return ColouredNoise(float(white), float(random_walk))


def exceeds_noise(filled: FloatArray, rate: float, frequency: float, noise: ColouredNoise) -> bool:
    """Return whether the motion at ``frequency``, Hz, exceeds the ``noise`` there."""
    f, p = _spectrum(filled, rate)
    floor = noise.density(f[1:], rate) * rate**2 * (2.0 - 2.0 * np.cos(2.0 * np.pi * f[1:] / rate))
    return bool(np.interp(frequency, f, p) > PEAK * np.interp(frequency, f[1:], floor))


SLOPE_SD = 1.0
"""What drives a link has a spectrum that falls as frequency^-s; s before anything is known."""
ODDS = 1e-3
"""A spectrum that a driven mode has less often than that is not one of a driven mode."""


def mode_in_operation(samples: FloatArray, rate: float, frequency: float) -> Mode | None:
    """Return the mode from the spectrum of a link that is driven all the time.

    What drives the link was not measured, so the spectrum is fitted with that of a mode that noise of
    an unknown colour drives:

        S(f) = A (f/f0)^-s / ((f0^2 - f^2)^2 + (2 zeta f0 f)^2) + B

    by the likelihood of its periodogram (Whittle, Arkiv for Matematik 2, 423, 1953), which gives the
    uncertainties too. A spectrum that does not look like this gives no mode.
    """
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
        tried = minimize(loss, start, method='Nelder-Mead', options={'maxfev': 6000, 'xatol': 1e-6, 'fatol': 1e-6})
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
        upper, lower = x.copy(), x.copy()
        upper[i] += step
        lower[i] -= step
        columns.append((np.log(density(upper)) - np.log(density(lower))) / (2.0 * step))
    jacobian = np.column_stack(columns)
    out: FloatArray = jacobian.T @ jacobian
    return out
