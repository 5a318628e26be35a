# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Amplitude spectral density of the dots from the last seconds of raw samples (Welch, IEEE Trans. Audio Electroacoust.
15, 1967: Hann windows, half overlapping). A lost sample, or one without light, ends a segment."""

from collections import deque

import numpy as np

from psd_deflection.model.detector import VoltsToDots
from psd_deflection.records import DiagnosticEntry, FloatArray, SampleBlock, dot_names
from psd_deflection.rig.config import Rig

SEGMENT = 1024
SECONDS = 4.0

NAME = 'psd_deflection: spectrum'
STANDS_OUT = 100.0
"""Times the power about it: a line. Noise alone reaches that once in 10^9 seconds (a mean of seven segments)."""
NARROW = 30.0
"""Times the power ``SIDE`` bins beside it: what a load step leaves is broad."""
SIDE = 5
"""Bins from a line to what is no longer of it: a Hann window spreads a line over two on each side."""
ABOUT = 32
"""Bins to each side that are about a line."""
NEAR = 0.15
"""Share of the frequency of a mode within which a line is that mode."""
LEAST = 1e-18
"""m^2/Hz: (1 nm)^2/Hz. A reading that does not vary has no lines."""
LOWEST_HZ = 3.0
"""What is slower is drift and how the link is loaded."""


class Spectrum:
    """Keeps the samples of the last ``seconds`` (None: all); one thread at a time."""

    def __init__(self, rig: Rig, seconds: float | None = SECONDS) -> None:
        self.rate_hz = rig.converter.sample_rate_hz
        self._calibration = VoltsToDots.from_rig(rig)
        # At low rates it takes longer until there are two segments.
        self.seconds = None if seconds is None else max(seconds, 2.0 * SEGMENT / self.rate_hz)
        samples = None if self.seconds is None else self.seconds * self.rate_hz
        self._blocks: deque[SampleBlock] = deque(
            maxlen=None if samples is None else max(2, round(samples / rig.estimator.block_size))
        )
        # Same threshold as the optics' health: with a beam splitter, half the light does not mean no light.
        self._sum_min = rig.estimator.sum_min * (0.5 if rig.estimator.splitter else 1.0)
        self._window = np.hanning(SEGMENT + 1)[:-1]

    def add(self, block: SampleBlock) -> None:
        """Take one more block, in the order of time."""
        if self._blocks and block.seq[0] <= self._blocks[-1].seq[-1]:
            self._blocks.clear()
        self._blocks.append(block)

    @property
    def frequencies(self) -> FloatArray:
        """(k,), Hz, without the mean's 0 Hz."""
        return np.arange(1, SEGMENT // 2 + 1, dtype=np.float64) * (self.rate_hz / SEGMENT)

    def density(self) -> FloatArray | None:
        """(2P, k) of x1 y1 x2 y2 ..., m/sqrt(Hz), one-sided; NaN for a PSD, None for all, if no stretch is long enough.

        Such a stretch has no loss and, on that PSD, light throughout.
        """
        if not self._blocks:
            return None
        seq = np.concatenate([b.seq for b in self._blocks])
        volts = self._calibration.observed(np.concatenate([b.volts for b in self._blocks]))
        dots = self._calibration.dots(volts).astype(np.float64)
        psds = volts.shape[1] // 3
        for psd in range(psds):
            dots[~(volts[:, 3 * psd + 2] >= self._sum_min), 2 * psd : 2 * psd + 2] = np.nan
        total = np.zeros((SEGMENT // 2 + 1, 2 * psds))
        count = np.zeros(2 * psds)
        for run in np.split(dots, np.flatnonzero(np.diff(seq) != 1) + 1):
            for start in range(0, len(run) - SEGMENT + 1, SEGMENT // 2):
                part = run[start : start + SEGMENT]
                observed = np.repeat(np.isfinite(part).all(axis=0).reshape(-1, 2).all(axis=1), 2)
                if not observed.any():
                    continue
                part = part[:, observed]
                transform = np.fft.rfft((part - part.mean(axis=0)) * self._window[:, None], axis=0)
                total[:, observed] += np.abs(transform) ** 2
                count += observed
        if not count.any():
            return None
        count[count == 0] = np.nan
        power = 2.0 * total / (count * self.rate_hz * float((self._window**2).sum()))
        return np.asarray(np.sqrt(power[1:]).T, np.float64)


def line_entry(rig: Rig, frequencies: FloatArray, density: FloatArray | None) -> DiagnosticEntry:
    """Whether the spectrum has a line where the rig file has no mode: ``density`` (2P, k) at ``frequencies`` (k,), Hz.

    One recording cannot tell a vibration from one that sampling folds to its frequency; the message says what can.
    """
    line = None if density is None else _line(rig, frequencies, np.nan_to_num(density) ** 2)
    if line is None:
        return DiagnosticEntry(NAME, 0, 'no line but those of the modes', ())
    hz, sizes = line
    there = [n for n, size in zip(dot_names(len(rig.psds)), sizes.tolist(), strict=True) if size > 0.3 * sizes.max()]
    rate = rig.converter.sample_rate_hz
    size = 1e6 * sizes.max()
    message = (
        f'a line of {size:.3g} µm rms at {hz:.0f} Hz on {" ".join(there)}, where the rig file has no mode: '
        f'it vibrates there, has a mode there, or something at {rate - hz:.0f} or {rate + hz:.0f} Hz is folded by the '
        f'sampling; record at another rate: a line that moves was folded'
    )
    return DiagnosticEntry(NAME, 1, message, (('line (Hz)', f'{hz:.1f}'),))


def _line(rig: Rig, frequencies: FloatArray, power: FloatArray) -> tuple[float, FloatArray] | None:
    """Frequency, Hz, and rms (2P,), m, of the line that stands out most; None if none does."""
    step = float(frequencies[0])
    inner = slice(SIDE, len(frequencies) - SIDE)
    hz = frequencies[inner]
    free = hz >= LOWEST_HZ
    for mode in (rig.dynamics.bending_frequency, rig.dynamics.torsion_frequency):
        free &= np.abs(hz - mode) > NEAR * mode + SIDE * step
    best: tuple[float, int] | None = None
    for row in power:
        here = row[inner]
        beside = np.maximum(row[: len(here)], row[2 * SIDE :])
        highest = (here >= row[SIDE - 1 : SIDE - 1 + len(here)]) & (here >= row[SIDE + 1 : SIDE + 1 + len(here)])
        for at in np.flatnonzero(free & highest & (here > NARROW * beside)).tolist():
            k = at + SIDE
            about = max(float(np.median(row[max(k - ABOUT, 0) : k + ABOUT + 1])), LEAST)
            stands = float(row[k]) / about
            if stands >= STANDS_OUT and (best is None or stands > best[0]):
                best = (stands, k)
    if best is None:
        return None
    band = slice(best[1] - SIDE + 1, best[1] + SIDE)
    return float(frequencies[best[1]]), np.sqrt(power[:, band].sum(axis=1) * step)


def density_json(density: FloatArray | None) -> str:
    """:meth:`Spectrum.density` as the page reads it, NaN as null."""
    if density is None:
        return 'null'
    rows = (','.join(f'{v:.3g}' if v == v else 'null' for v in channel) for channel in density.tolist())
    return '[' + ','.join(f'[{row}]' for row in rows) + ']'
