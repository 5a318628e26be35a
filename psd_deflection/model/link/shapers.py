# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Input shapers: a command split into a few impulses, so that the ringing of one ends that of the others.

ZV and ZVD: Singer and Seering, J. Dyn. Syst. Meas. Control 112, 76 (1990). EI: Singhose, Seering and Singer, Proc. ASME
Japan/USA Symposium on Flexible Automation (1996). MZV: the ZV of three impulses a quarter turn apart, shorter than ZVD.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.records import FloatArray

KINDS = ('zv', 'mzv', 'zvd', 'ei')
TOLERATED = 0.05
"""Share of the vibration that EI leaves at the frequency itself, and that a recommended shaper leaves at most."""
LEAST_BAND = 0.05
"""A link with another payload has another frequency: a shaper is to work within so much of it."""


@dataclass(frozen=True)
class Shaper:
    """``times`` (k,), s, from 0; ``sizes`` (k,), with the sum 1."""

    name: str
    times: tuple[float, ...]
    sizes: tuple[float, ...]

    @property
    def duration(self) -> float:
        """By how much it prolongs a motion, s."""
        return self.times[-1]

    def residual(self, frequency: FloatArray | float, damping: float) -> FloatArray:
        """Share of a mode's vibration that is left, for each ``frequency``, Hz (Singer and Seering 1990)."""
        w = 2.0 * np.pi * np.atleast_1d(np.asarray(frequency, dtype=np.float64))
        w_damped = w * math.sqrt(1.0 - damping**2)
        t, a = np.array(self.times), np.array(self.sizes)
        grown = a * np.exp(damping * np.outer(w, t))
        cos, sin = (
            (grown * np.cos(np.outer(w_damped, t))).sum(axis=1),
            (grown * np.sin(np.outer(w_damped, t))).sum(axis=1),
        )
        out: FloatArray = np.exp(-damping * w * t[-1]) * np.hypot(cos, sin)
        return out

    def shaped(self, command: FloatArray, rate: float) -> FloatArray:
        """``command`` (n,) or (n, k), sampled ``rate`` times a second, after the shaper; as long as before.

        An impulse between two samples is shared between them. Before the first sample the command stood still.
        """
        values = np.asarray(command, dtype=np.float64)
        out = np.zeros_like(values)
        at = np.arange(len(values))
        columns = values.reshape(len(values), -1)
        shaped = out.reshape(len(values), -1)
        for time, size in zip(self.times, self.sizes, strict=True):
            for i in range(columns.shape[1]):
                shaped[:, i] += size * np.interp(at - time * rate, at, columns[:, i])
        return out


def shaper(kind: str, frequency: float, damping: float) -> Shaper:
    """The shaper of one of ``KINDS`` for a mode, Hz and ratio."""
    half = 0.5 / (frequency * math.sqrt(1.0 - damping**2))
    k = math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2))
    if kind == 'zv':
        times, sizes = [0.0, half], [1.0, k]
    elif kind == 'zvd':
        times, sizes = [0.0, half, 2.0 * half], [1.0, 2.0 * k, k * k]
    elif kind == 'ei':
        v = TOLERATED
        times, sizes = [0.0, half, 2.0 * half], [0.25 * (1.0 + v), 0.5 * (1.0 - v) * k, 0.25 * (1.0 + v) * k * k]
    elif kind == 'mzv':
        # Three eighths of a turn apart: the vectors cancel if the middle one is sqrt(2) times the others.
        c = k**0.75
        times, sizes = [0.0, 0.75 * half, 1.5 * half], [1.0, math.sqrt(2.0) * c, c * c]
    else:
        raise ValueError(f'{kind!r} is no shaper; there are {", ".join(KINDS)}')
    total = math.fsum(sizes)
    return Shaper(kind, tuple(times), tuple(s / total for s in sizes))


def in_series(shapers: Sequence[Shaper]) -> Shaper:
    """One shaper that does what ``shapers`` do one after the other, for a link that rings with several modes."""
    times, sizes = np.zeros(1), np.ones(1)
    for each in shapers:
        times = np.add.outer(times, each.times).ravel()
        sizes = np.multiply.outer(sizes, each.sizes).ravel()
    order = np.argsort(times, kind='stable')
    name = '+'.join(each.name for each in shapers)
    return Shaper(name, tuple(times[order].tolist()), tuple(sizes[order].tolist()))


def recommended(frequency: float, frequency_sd: float, damping: float) -> Shaper:
    """The shortest shaper that leaves at most 5 % within three standard deviations, or 5 %, of the frequency.

    If none does, the one that leaves least.
    """
    half_band = max(3.0 * frequency_sd, LEAST_BAND * frequency)
    band = np.linspace(max(frequency - half_band, 0.1 * frequency), frequency + half_band, 41)
    candidates = sorted((shaper(kind, frequency, damping) for kind in KINDS), key=lambda s: s.duration)
    worst = [float(s.residual(band, damping).max()) for s in candidates]
    for candidate, residual in zip(candidates, worst, strict=True):
        if residual <= TOLERATED:
            return candidate
    return candidates[int(np.argmin(worst))]
