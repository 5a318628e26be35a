# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where the motion of an axis stands out of its noise: peaks of the spectrum, white noise and noise
that remembers."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.records import FloatArray

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
    """Noise of the density ``white`` + ``walk`` / (2 - 2 cos w), one-sided: at least that of an autoregression."""

    white: float
    walk: float

    def density(self, f: FloatArray, rate: float) -> FloatArray:
        """At the frequencies ``f``, Hz."""
        return self.white + self.walk / np.maximum(2.0 - 2.0 * np.cos(2.0 * np.pi * f / rate), 1e-9)

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
    white, walk = (weights / sizes)[:2]
    return ColouredNoise(float(white), float(walk))


def exceeds_noise(filled: FloatArray, rate: float, frequency: float, noise: ColouredNoise) -> bool:
    """Return whether the motion at ``frequency``, Hz, exceeds the ``noise`` there."""
    f, p = _spectrum(filled, rate)
    floor = noise.density(f[1:], rate) * rate**2 * (2.0 - 2.0 * np.cos(2.0 * np.pi * f[1:] / rate))
    return bool(np.interp(frequency, f, p) > PEAK * np.interp(frequency, f[1:], floor))
