# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Starting values that a search by derivatives cannot find: frequencies, limits, coarse steps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray, dot_channels
from psd_deflection.studies.discover.thresholds import LINE
from psd_deflection.studies.loads.thresholds import MINOR, SEVERAL


def spectral_peaks(
    residuals: Sequence[FloatArray], sigmas: Sequence[FloatArray], periods: Sequence[float], limit: int = 3
) -> list[float]:
    """Frequencies, Hz, of the strongest lines of raw residuals (n, 3P) V, strongest first.

    The recording with the strongest line is used. Each frequency is refined to the line's greatest
    amplitude, because a search by derivatives needs the right phase over the whole recording.
    """
    best: list[tuple[float, float]] = []
    for residual, sigma, period in zip(residuals, sigmas, periods, strict=True):
        n = len(residual)
        if n < 256:
            continue
        scaled = residual / sigma
        window = np.hanning(n)
        each = np.abs(np.fft.rfft(scaled * window[:, None], axis=0)) ** 2
        power = each.sum(axis=1)
        power[: max(4, int(2.0 * n * period))] = 0.0
        median = float(np.median(power[power > 0.0]))
        t = np.arange(n, dtype=np.float64) * period
        for _ in range(limit):
            k = int(np.argmax(power))
            if not power[k] > LINE * median:
                break
            strongest = np.ascontiguousarray(scaled[:, int(np.argmax(each[k]))] * window)

            def loss(f: float, t: FloatArray = t, x: FloatArray = strongest) -> float:
                angle = 2.0 * np.pi * f * t
                return -float((np.cos(angle) @ x) ** 2 + (np.sin(angle) @ x) ** 2)

            step = 1.0 / (n * period)
            peak = minimize_scalar(
                loss, bounds=((k - 1) * step, (k + 1) * step), method='bounded', options={'xatol': 1e-3 * step}
            )
            best.append((float(power[k] / median), float(peak.x)))
            power[max(0, k - 12) : k + 13] = 0.0
    best.sort(reverse=True)
    out: list[float] = []
    for _, f in best:
        if all(abs(f - g) > 0.2 for g in out):
            out.append(f)
    return out[:limit]


def persistent(
    peaks: Sequence[float], residuals: Sequence[FloatArray], sigmas: Sequence[FloatArray], periods: Sequence[float]
) -> list[float]:
    """Those of ``peaks`` that are always present with a constant phase, as mains hum is and ringing is not.

    The line's complex amplitude is computed for each quarter of a recording that has samples, of those that are there
    (the others are 0 in ``residuals``). The magnitude of their sum must equal the sum of their magnitudes, and no
    quarter may be without the line.
    """
    out = []
    for f in peaks:
        steady = True
        for residual, sigma, period in zip(residuals, sigmas, periods, strict=True):
            n = len(residual) // 4
            t = np.arange(4 * n) * period
            scaled = residual[: 4 * n] / sigma
            there = np.any(scaled != 0.0, axis=1)
            shares = there.reshape(4, n).mean(axis=1)
            persistent_terms = shares >= MINOR
            if persistent_terms.sum() < SEVERAL:
                steady = False
                break
            centred = np.where(there[:, None], scaled - scaled[there].mean(axis=0), 0.0)
            rotated = np.exp(-2j * np.pi * f * t)[:, None] * centred
            quarters = rotated.reshape(4, n, -1).mean(axis=1)[persistent_terms] / shares[persistent_terms, None]
            strongest = int(np.argmax(np.abs(quarters).sum(axis=0)))
            q = quarters[:, strongest]
            size = np.abs(q)
            steady &= bool(abs(q.sum()) > 0.7 * size.sum() and size.min() > 0.4 * size.mean())
        if steady:
            out.append(f)
    return out


def highest_voltages(observations: Sequence[Observation], with_sums: bool, noise: float) -> list[float]:
    """Limits, V, at which the outputs may have clipped: the largest reading and a little less."""
    psds = observations[0].psds
    rows = list(range(3 * psds) if with_sums else dot_channels(psds))
    top = max(float(np.nanmax(np.abs(o.volts[:, rows]))) for o in observations)
    return [v for v in (top - 2.0 * noise, top - 4.0 * noise, top - 12.0 * noise, 0.98 * top) if v > 0.1]


class CoarseStep(NamedTuple):
    """``step``, V, with its standard deviation ``sd``; ``sums``: whether the sum signals step as well."""

    step: float
    sd: float
    sums: bool = True


def coarse_step(observation: Observation) -> CoarseStep | None:
    """Return the step on whose multiples all readings lie, or all positions, if it is coarser than the converter's.

    The gaps between neighbouring values are whole multiples of the step. The smallest common step
    is refined until all readings are multiples of it within the converter's own rounding.
    """
    lsb = observation.rig.converter.volts_per_count
    volts = observation.volts[np.all(np.isfinite(observation.volts), axis=1)]
    volts = volts[:: max(1, len(volts) // 20_000)]
    step = _common_step(volts, lsb)
    if step is not None:
        return CoarseStep(*step)
    # A sum signal may have another converter, or another range.
    step = _common_step(volts[:, dot_channels(observation.psds)], lsb)
    return None if step is None else CoarseStep(*step, sums=False)


def _common_step(volts: FloatArray, lsb: float) -> tuple[float, float] | None:
    counts = np.rint(volts / lsb)
    values = np.unique(counts)
    gaps = np.diff(values)
    if len(gaps) < 3 or np.quantile(gaps, 0.5) < 2:
        return None
    gap = float(np.median(gaps[gaps <= 1.5 * np.quantile(gaps, 0.25)]))
    # Refine with larger and larger multiples, so that rounding of the step averages out.
    reach = 4.0
    span = float(np.abs(values).max())
    while True:
        close = values[np.abs(values) <= reach * gap + 1.0]
        k = np.rint(close / gap)
        if np.any(k != 0):
            gap = float(np.dot(k, close) / np.dot(k, k))
        if reach * gap >= span:
            break
        reach *= 2.0
    off = np.abs(values - np.rint(values / gap) * gap)
    if np.mean(off <= 0.75) < 0.995:
        return None
    # Chance: a value lies within 0.75 counts of a multiple with probability 1.5/gap.
    expected = min(1.0, 2.0 / gap)
    if expected > 0.9 or len(values) * np.log(1.0 / expected) < 20.0:
        return None
    # Least squares through the origin, each value rounded to whole counts (sd of a uniform law).
    k = np.rint(values / gap)
    return gap * lsb, float(lsb / np.sqrt(12.0 * np.dot(k, k)))
