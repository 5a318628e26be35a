# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Slow noise of the electronics, 1/f: every amplifier has it, as much as white noise at its corner frequency.

It follows nothing and moves nothing, but over seconds it is more than white noise, so a search that expects white noise
finds structure in it. The light of each PSD is read by amplifiers like those of its positions, and nothing that the
link does moves it: its readings tell the corner, and the positions must show it, too. The density is ``1 + corner / f``
times that of the white noise (Horowitz & Hill, The Art of Electronics, 3rd ed., 8.1.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import dct, idct

from psd_deflection.records import FloatArray, dot_channels

CLIP = 6.0
"""Whitened values are limited to this: an outlier is no slow noise."""
HIGHEST_HZ = 20.0
"""Up to which the density is looked at."""
CORNERS = np.geomspace(0.02, 200.0, 120)
"""Hz: those that are tried."""
CLEAR = 0.5
"""Log-likelihood that a corner must gain on all sums together. A small corner that is none costs little; one that is
not seen makes a drift of noise.
"""
WIDER = 1.3
"""How much larger than those of the lights, and than the second smallest of the dots, a channel's corner may be."""
APART = 4.0
"""How much larger than the smallest of the other lights the corner of one may be."""
LEAST_VALUES = 64
"""Of a recording and channel."""


def corners_of(parts: Sequence[FloatArray], periods: Sequence[float]) -> FloatArray:
    """(3P,) Hz: the corner of the noise of each channel, 0 if not all have such noise.

    ``parts``: whitened residuals (3P, n) of each recording, 0 where nothing was measured; ``periods``: s from one to
    the next.
    """
    channels = len(parts[0])
    gains = np.array([_gains([p[c] for p in parts], periods) for c in range(channels)])
    light = gains[2::3]
    corners = np.where(gains.max(axis=1) > 0.0, CORNERS[np.argmax(gains, axis=1)], 0.0)
    dots = np.sort(corners[list(dot_channels(channels // 3))])
    # What moves some of the dots (three of four), or one light, alone is more than this noise.
    if light.sum(axis=0).max() < CLEAR or light.max(axis=1).min() <= 0.0 or dots[1] == 0.0:
        return np.zeros(channels)
    low, high = corners[2::3].min(), corners[2::3].max()
    return np.asarray(np.minimum(corners, WIDER * min(high, APART * low, dots[1])))


def _gains(rows: Sequence[FloatArray], periods: Sequence[float]) -> FloatArray:
    """Return the log-likelihood that each of ``CORNERS`` gains over white noise, of one channel (P. Whittle, 1953)."""
    gains = np.zeros(len(CORNERS))
    for row, period in zip(rows, periods, strict=True):
        values = np.clip(row, -CLIP, CLIP)
        count = int(np.count_nonzero(values))
        if count < LEAST_VALUES:
            continue
        f = np.fft.rfftfreq(len(row), period)
        low = (f > 0.0) & (f <= HIGHEST_HZ)
        power = np.abs(np.fft.rfft(values)[low]) ** 2 / count
        density = 1.0 + CORNERS[:, None] / f[low]
        gains += (power * (1.0 - 1.0 / density) - np.log(density)).sum(axis=1)
    return gains


@dataclass(frozen=True, slots=True, eq=False)
class SlowNoise:
    """``corners`` (3P,) Hz, of a recording of n values; ``pass_`` (3P, n): what makes their cosine spectra white.
    Cosines do not take a drift from the first to the last value for a jump.
    """

    corners: FloatArray
    pass_: FloatArray

    @classmethod
    def of(cls, corners: FloatArray, n: int, period: float) -> SlowNoise:
        """Of a recording of ``n`` values ``period`` s apart."""
        f = 0.5 * np.arange(n) / (n * period)
        # Of the mean nobody knows more.
        f[0] = 0.5 * f[1]
        return cls(corners, 1.0 / np.sqrt(1.0 + corners[:, None] / f))

    def whiten(self, rows: FloatArray) -> FloatArray:
        """Rows (3P, n), white but for this, made white; it is its own adjoint."""
        return np.asarray(idct(dct(rows, norm='ortho') * self.pass_, norm='ortho'))

    def unwhiten(self, rows: FloatArray) -> FloatArray:
        """Rows (3P, n) as they were."""
        return np.asarray(idct(dct(rows, norm='ortho') / self.pass_, norm='ortho'))


def block_factor(seconds: float, block: float, corners: FloatArray) -> FloatArray:
    """(3P,): by how much slow noise increases the variance of means over ``block`` s, in a recording of ``seconds``.

    That of white noise is its density over twice the length; between the recording's length and the block's there are
    as many octaves as their ratio has, each with the same slow noise.
    """
    return np.asarray(1.0 + 2.0 * block * corners * np.log(max(seconds / block, 1.0)))
