# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Noise, hum and light of each channel, against what the rig file says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psd_deflection.measure.uncertainty.converter import ConverterSteps
from psd_deflection.records import CHANNELS, FloatArray
from psd_deflection.rig.config import Rig

MAINS = (50.0, 60.0)
"""Hz."""

SUM_FACTOR = 1.15
"""Report a sum that differs from the nominal one by more than this factor."""

LONGEST = 1_000_000
"""Only the first samples of a long recording are used, this many."""

HUM_S = 60.0
"""Longest stretch in which hum is looked for, s."""

HUM_SHARE = 0.25
"""Hum below this share of the noise is not reported."""

_THIRD = np.sqrt(20.0)
"""Root of the variance of the third difference of white noise of variance 1."""

_TO_SD = 1.4826
"""Median absolute value of a normal law to its standard deviation."""

_AT_ONCE = 1000
"""Samples in which the steps are looked for at once: a fine converter tells in the first."""

_FAR = 4.0
_NEIGHBOURS_HZ = 8.0
_STANDS_OUT = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Of the device's channels x1 y1 sum1 x2 y2 sum2. ``noise`` (6,): V rms a sample, without motion, drift and hum.

    ``stated``: of the rig file, with the converter's steps, V rms. ``hum`` (6,): amplitude of the mains, V, 0 if none
    stands out. ``hum_hz``: its frequency. ``sums`` (2,): means, V. ``stuck``: channels on which no bit moves. ``steps``
    (6,): of the converter, V, 0 where they are not coarser than the rig file's.
    """

    noise: FloatArray
    stated: float
    hum: FloatArray
    hum_hz: float
    sums: FloatArray
    stuck: tuple[str, ...]
    steps: FloatArray


def levels(rig: Rig, volts: FloatArray) -> Levels:
    """``volts`` (n, 6) of the device's channels, NaN if a sample is lost; some are there. Of a long run, its begin."""
    volts = volts[:LONGEST]
    step = rig.converter.volts_per_count
    stated = float(np.hypot(np.sqrt(np.mean(rig.noises[:, :2] ** 2)), step / np.sqrt(12.0)))
    rough = np.diff(volts, n=3, axis=0)
    rough = rough[np.isfinite(rough).all(axis=1)]
    if not len(rough):
        rough = np.zeros((1, volts.shape[1]))
    complete = volts[np.isfinite(volts).all(axis=1)]
    steps = _steps(rig, complete)
    # Steps of a load and glitches are cut off. The median alone would be as coarse as the converter.
    cut = _FAR * np.maximum(_TO_SD * np.median(np.abs(rough), axis=0), np.maximum(steps, step))
    noise = np.sqrt((np.clip(rough, -cut, cut) ** 2).mean(axis=0)) / _THIRD
    # Steps that are coarser than the noise can hide it: no channel that stands still is dead then.
    moves = rig.amplifier.noise > max(step, float(steps.max()))
    still = (complete == complete[0]).all(axis=0)
    stuck = tuple(name for name, same in zip(CHANNELS, still.tolist(), strict=True) if same and moves)
    rate = rig.converter.sample_rate_hz
    hum_hz, hum = mains_hum(longest_run(volts)[: round(HUM_S * rate)], rate, noise)
    return Levels(noise, stated, hum, hum_hz, complete[:, 2::3].mean(axis=0), stuck, steps)


def _steps(rig: Rig, volts: FloatArray) -> FloatArray:
    converter = ConverterSteps.of_rig(rig)
    for first in range(0, len(volts), _AT_ONCE):
        converter.add(volts[first : first + _AT_ONCE])
    return converter.steps


def longest_run(volts: FloatArray) -> FloatArray:
    """Return the longest stretch without a lost sample."""
    there = np.concatenate(([False], np.isfinite(volts).all(axis=1), [False]))
    edges: npt.NDArray[np.int64] = np.flatnonzero(np.diff(there.astype(np.int8)))
    starts, ends = edges[0::2], edges[1::2]
    best = int(np.argmax(ends - starts))
    return volts[starts[best] : ends[best]]


def mains_hum(volts: FloatArray, rate: float, noise: FloatArray) -> tuple[float, FloatArray]:
    """(Hz, amplitude (6,) V) of the mains frequency that stands out more; its neighbours say what does not.

    A Hann window keeps the link's ringing, tens of hertz away, out of it.
    """
    n = len(volts)
    best = (MAINS[0], np.zeros(6))
    if n < rate or rate < 2.5 * MAINS[1]:
        return best
    window = np.hanning(n)
    values = (volts - volts.mean(axis=0)) * window[:, None]
    t = np.arange(n) / rate
    width = 4.0 * rate / n
    for frequency in MAINS:
        offsets = [o for o in np.arange(-_NEIGHBOURS_HZ, _NEIGHBOURS_HZ + 1.0) if abs(o) > width]
        waves = np.exp(-2j * np.pi * np.outer([frequency, *(frequency + o for o in offsets)], t))
        sizes = 2.0 * np.abs(waves @ values) / window.sum()
        there = sizes[0] > np.maximum(_STANDS_OUT * np.median(sizes[1:], axis=0), HUM_SHARE * noise)
        found = np.where(there, sizes[0], 0.0)
        if found.max() > best[1].max():
            best = (frequency, found)
    return best
