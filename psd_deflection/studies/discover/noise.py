# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimates the noise, not from the discrepancy itself: its level from the upper half of the residual's spectrum,
without lines; its colour from rest, autoregressive only if clearly correlated; 1/f from the light of each PSD."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dct, idct
from scipy.linalg import solve_toeplitz
from scipy.ndimage import median_filter
from scipy.signal import detrend, lfilter

from psd_deflection.recordings.observation import Observation
from psd_deflection.records import BoolArray, FloatArray, dot_channels
from psd_deflection.rig.config import Rig
from psd_deflection.studies.discover.thresholds import BANDS, CERTAIN_SD, CORNERS, LEAST_REST, ORDER, SIGNIFICANT
from psd_deflection.studies.loads.thresholds import AS_GOOD, DISTINCT_SD, MANYFOLD, PART, SAME


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
    # What moves some of the dots (three of four), or one light, alone is more than this noise. One more parameter gains
    # 1 in chi-square by chance; the corner goes with the square of an amplitude.
    if 2.0 * light.sum(axis=0).max() < 1.0 or light.max(axis=1).min() <= 0.0 or dots[1] == 0.0:
        return np.zeros(channels)
    low, high = corners[2::3].min(), corners[2::3].max()
    return np.asarray(np.minimum(corners, SIGNIFICANT * min(high, AS_GOOD**2 * low, dots[1])))


def _gains(rows: Sequence[FloatArray], periods: Sequence[float]) -> FloatArray:
    """Return the log-likelihood that each of ``CORNERS`` gains over white noise, of one channel (P. Whittle, 1953)."""
    gains = np.zeros(len(CORNERS))
    for row, period in zip(rows, periods, strict=True):
        values = np.clip(row, -CERTAIN_SD, CERTAIN_SD)
        count = int(np.count_nonzero(values))
        if count < LEAST_REST:
            continue
        f = np.fft.rfftfreq(len(row), period)
        low = (f > 0.0) & (f <= BANDS[4])
        power = np.abs(np.fft.rfft(values)[low]) ** 2 / count
        density = 1.0 + CORNERS[:, None] / f[low]
        gains += (power * (1.0 - 1.0 / density) - np.log(density)).sum(axis=1)
    return gains


@dataclass(frozen=True, slots=True, eq=False)
class SlowNoise:
    """``corners`` (3P,) Hz, of a recording of n values; ``pass_`` (3P, n): what makes their cosine spectra white.
    Cosines do not take a drift from the first to the last value for a jump.

    It follows nothing and moves nothing, but over seconds it is more than white noise, so a search that expects white
    noise finds structure in it. The light of each PSD is read by amplifiers like those of its positions, and nothing
    that the link does moves it: its readings tell the corner, and the positions must show it, too. The density is ``1 +
    corner / f`` times that of the white noise (Horowitz & Hill, The Art of Electronics, 3rd ed., 8.1.3).
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


@dataclass(frozen=True, slots=True, eq=False)
class NoiseModel:
    """``sigma`` (3P,) V rms a sample; ``ar`` (3P, p): on fine blocks; ``innovation`` (3P,): V rms of a
    fine block after prediction; ``block_sigma`` (3P,): V rms of the mean of one estimate block. ``slow``: what all
    channels have besides; ``block_sigma`` has it, the others do not. ``sample_ar`` (3P, p): on samples; None if white.
    """

    sigma: FloatArray
    ar: FloatArray
    innovation: FloatArray
    block_sigma: FloatArray
    rest_seconds: float
    coloured: tuple[bool, ...]
    slow: SlowNoise | None = None
    sample_ar: FloatArray | None = None

    def draw(self, n: int, period: float, rng: np.random.Generator) -> FloatArray:
        """Return such noise (n, 3P) V, ``period`` s between samples; 1000 values before these settle the memory."""
        rows = rng.standard_normal((len(self.sigma), n + 1000))
        for row, phi in zip(rows, () if self.sample_ar is None else self.sample_ar, strict=False):
            density = _ar_density(phi, np.linspace(0.0, 1.0, 4096, endpoint=False))
            row[:] = lfilter([1.0 / np.sqrt(density.mean())], [1.0, *-phi], row)
        rows = self.sigma[:, None] * rows[:, 1000:]
        return (rows if self.slow is None else SlowNoise.of(self.corners, n, period).unwhiten(rows)).T

    def with_slow_noise(self, corners: FloatArray, n: int, period: float, block: float) -> NoiseModel:
        """With slow noise of the ``corners`` (3P,), Hz, in ``n`` fine blocks ``period`` s apart.

        ``block``: s of the blocks of an estimate.
        """
        if not corners.any():
            return self
        more = np.sqrt(block_factor(n * period, block, corners))
        return replace(self, slow=SlowNoise.of(corners, n, period), block_sigma=self.block_sigma * more)

    def whiten(self, fine: FloatArray, count: FloatArray) -> FloatArray:
        """White, unit-variance innovations (3P, nf) of fine-block rows (3P, nf); 0 where unknown.

        ``count`` (3P, nf): the share of each block's samples that is there. Fewer samples make a noisier mean.
        """
        out = fine.copy()
        good = count > 0.0
        for j in range(1, self.ar.shape[1] + 1):
            column = self.ar[:, j - 1 : j]
            if np.any(column):
                out[:, j:] -= column * fine[:, :-j]
                good[:, j:] &= (count[:, :-j] > 0.0) | (column == 0.0)
        out *= np.sqrt(count) / self.innovation[:, None]
        out[~good] = 0.0
        if self.slow is not None:
            out = np.where(good, self.slow.whiten(out), 0.0)
        return out

    @property
    def corners(self) -> FloatArray:
        """(3P,) Hz: of the slow noise, 0 without."""
        return np.zeros(len(self.sigma)) if self.slow is None else self.slow.corners

    def like(self, other: NoiseModel) -> bool:
        """Return whether a search need not tell it from ``other``."""
        return (
            self.coloured == other.coloured
            and np.allclose(self.innovation, other.innovation, rtol=SAME)
            and np.allclose(self.corners, other.corners, rtol=PART, atol=0.0)
        )

    def of_slow_change(self, white: FloatArray) -> FloatArray:
        """V (3P, nf): the fine blocks of a change that is slow against one, of which ``white`` (3P, nf) is left."""
        if self.slow is not None:
            white = self.slow.unwhiten(white)
        return np.asarray(white * (self.innovation / np.maximum(1.0 - self.ar.sum(axis=1), 0.05))[:, None])


def settling(rig: Rig) -> float:
    """s until the link of ``rig`` rings with a thousandth of what it began with."""
    d = rig.dynamics
    slow = min(d.bending_damping_ratio * d.bending_frequency, d.torsion_damping_ratio * d.torsion_frequency)
    return float(7.0 / (2.0 * np.pi * max(slow, 1e-3)))


def rest_windows(observation: Observation) -> list[slice]:
    """Samples at which the link is at rest according to its known loads."""
    settle = settling(observation.rig)
    n, period = len(observation.loads), observation.period
    changed = np.flatnonzero(np.any(np.diff(observation.loads, axis=0) != 0.0, axis=1)) + 1
    edges = np.concatenate(([0], changed, [n]))
    windows = []
    for i, (a, b) in enumerate(itertools.pairwise(edges)):
        first = int(a)
        if i > 0 or np.any(observation.loads[0] != 0.0):
            first += int(settle / period)
        if (b - first) * period >= 0.3:
            windows.append(slice(first, int(b)))
    return windows


def strip_lines(residual: FloatArray, limit: int = 4) -> FloatArray:
    """``residual`` (n,) without its strongest spectral lines (mains), at most ``limit``."""
    out = residual - residual.mean()
    n = len(out)
    for _ in range(limit):
        power = np.abs(np.fft.rfft(out * np.hanning(n))) ** 2
        # Compare with neighbouring frequencies: coloured noise has broad maxima that are not lines.
        ratio = power / np.maximum(median_filter(power, size=min(101, len(power))), 1e-300)
        ratio[: max(3, n // 500)] = 0.0
        peak = int(np.argmax(ratio))
        if ratio[peak] < 60.0:
            break
        spectrum = np.fft.rfft(out)
        spectrum[peak - 3 : peak + 4] = 0.0
        out = np.fft.irfft(spectrum, n)
    return np.asarray(out, dtype=np.float64)


def _level(power: FloatArray) -> float:
    """Mean of exponentially distributed ``power`` from its lower nine tenths, unaffected by lines.

    The mean of an exponential below its 0.9 quantile is (1 - 0.1 (1 + ln 10))/0.9 of the whole.
    """
    below = power[power <= np.quantile(power, 0.9)]
    return float(below.mean() * 0.9 / (1.0 - 0.1 * (1.0 + np.log(10.0))))


def _ar_density(phi: FloatArray, frequency: FloatArray) -> FloatArray:
    """Spectral density of an autoregressive process driven by unit variance; ``frequency`` per sample."""
    lags = np.arange(1, len(phi) + 1)
    response = np.asarray(1.0 - np.exp(-2j * np.pi * np.outer(frequency, lags)) @ phi, dtype=np.complex128)
    return 1.0 / (response.real**2 + response.imag**2)


def _block_autocovariance(acov: FloatArray, size: int, lags: int) -> FloatArray:
    """Autocovariance of means of ``size`` samples, from that of the samples."""
    triangle = size - np.abs(np.arange(-size + 1, size))
    out = np.empty(lags)
    for lag in range(lags):
        index = np.abs(np.arange(-size + 1, size) + lag * size)
        out[lag] = np.sum(triangle * acov[index]) / size**2
    return out


def _product(rows: list[FloatArray], lag: int) -> float:
    """Sum of the products of values ``lag`` apart."""
    return sum(float(np.dot(r[lag:], r[: len(r) - lag])) for r in rows)


def _filled(values: FloatArray, there: BoolArray) -> FloatArray:
    """``values`` (n,) with straight lines across what is missing: zeros would spread slow motion over the spectrum."""
    if there.all():
        return values
    if not there.any():
        return np.zeros_like(values)
    at = np.arange(len(values))
    return np.interp(at, at[there], values[there])


def _power_share(there: BoolArray, upper: BoolArray) -> float:
    """Share of the power of white noise that straight lines across the missing samples leave at ``upper`` frequencies.

    Measured on white noise of a fixed seed.
    """
    if there.all() or not there.any():
        return 1.0
    n = len(there)
    white = _filled(np.random.default_rng(0).standard_normal(n), there)
    power = np.abs(np.fft.rfft(white * np.hanning(n))) ** 2 / (0.375 * n)
    return max(_level(power[upper]), 1e-3)


def _between_neighbours(values: FloatArray) -> float:
    """Standard deviation of white noise that second differences of ``values`` (n,) show; motion hardly adds to them."""
    bent = values[2:] - 2.0 * values[1:-1] + values[:-2]
    bent = bent[np.isfinite(bent)]
    return float(1.4826 * np.median(np.abs(bent)) / np.sqrt(6.0)) if len(bent) else 0.0


def _memories(residual: FloatArray, rest: list[slice], floors: FloatArray) -> list[FloatArray | None]:
    """Of each channel the autocovariance (ORDER + 1,) V² of what rests; None if its noise has no memory."""
    pooled, significant = np.zeros((residual.shape[1], ORDER + 1)), np.zeros(residual.shape[1])
    for c, floor in enumerate(floors.tolist()):
        there = np.isfinite(residual[:, c])
        filled = _filled(residual[:, c], there)
        # A residual is 0 where a sample is missing, so that each product counts two that were measured.
        rows = [strip_lines(detrend(filled[w])) * there[w] for w in rest]
        valid = [there[w].astype(np.float64) for w in rest]
        count = int(sum(s.sum() for s in valid))
        if count > LEAST_REST:
            pooled[c] = [_product(rows, k) / max(_product(valid, k), 1.0) for k in range(ORDER + 1)]
            if pooled[c, 0] > floor**2:
                significant[c] = abs(pooled[c, 1]) / pooled[c, 0] * np.sqrt(count)
    most = 2 * int(np.sum(significant > CERTAIN_SD)) > len(significant)
    return [
        row if s > (DISTINCT_SD if most else CERTAIN_SD) else None for row, s in zip(pooled, significant, strict=True)
    ]


def estimate_noise(observation: Observation, residual: FloatArray, fine: int, floors: FloatArray) -> NoiseModel:
    """Noise of ``residual`` (n, 3P) V, measured minus simulated; NaN where samples are lost.

    ``fine``: samples a fine block. ``floors`` (3P,): V, smallest noise that is assumed of each channel.
    """
    block = observation.rig.estimator.block_size
    windows = rest_windows(observation)
    long = [w for w in windows if w.stop - w.start > 100]
    n, channels = residual.shape
    sigma, innovation, block_sigma = np.empty(channels), np.empty(channels), np.empty(channels)
    ar, sample_ar = np.zeros((channels, ORDER)), np.zeros((channels, ORDER))
    coloured = []
    memories = _memories(residual, long, floors)
    frequency = np.asarray(np.fft.rfftfreq(n, 1.0), dtype=np.float64)
    upper = frequency > 0.2
    for c in range(channels):
        there = np.isfinite(residual[:, c])
        filled = _filled(residual[:, c], there)
        power = np.abs(np.fft.rfft(filled * np.hanning(n))) ** 2 / (0.375 * n) / _power_share(there, upper)
        level = _level(power[upper])
        floor = float(floors[c])
        white = max(np.sqrt(level), floor)
        acov = np.zeros(max(block, (ORDER + 1) * fine))
        acov[0] = white**2
        pooled = memories[c]
        memory = pooled is not None
        if pooled is not None:
            phi = solve_toeplitz(pooled[:-1], pooled[1:])
            scale = _level(power[upper] / _ar_density(phi, frequency[upper]))
            density = scale * _ar_density(phi, np.linspace(0.0, 1.0, 4096, endpoint=False))
            with_memory = np.real(np.fft.ifft(density))[: len(acov)]
            memory = not with_memory[0] > (MANYFOLD * max(_between_neighbours(residual[:, c]), floor)) ** 2
            acov, sample_ar[c] = (with_memory, phi) if memory else (acov, 0.0)
        coloured.append(bool(memory))
        sigma[c] = np.sqrt(acov[0])
        of_fine = _block_autocovariance(acov, fine, ORDER + 1)
        if memory:
            ar[c] = solve_toeplitz(of_fine[:-1], of_fine[1:])
            innovation[c] = np.sqrt(max(of_fine[0] - float(ar[c] @ of_fine[1:]), 1e-30))
        else:
            innovation[c] = np.sqrt(of_fine[0])
        block_sigma[c] = np.sqrt(_block_autocovariance(acov, block, 1)[0])
    rest_seconds = sum(w.stop - w.start for w in windows) * observation.period
    return NoiseModel(sigma, ar, innovation, block_sigma, rest_seconds, tuple(coloured), None, sample_ar)
