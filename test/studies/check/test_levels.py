# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Noise, hum and light of volts that are made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.check import levels as module
from psd_deflection.studies.check.levels import levels

RIG = load_rig()
STEP = 20.0 / 2**16


def noisy(n: int, sd: float = 2e-3, seed: int = 1) -> FloatArray:
    return np.array([1.0, 2.0, 5.0, -1.0, 0.5, 4.0]) + np.random.default_rng(seed).normal(0.0, sd, (n, 6))


def test_stated_noise_has_four_channels_and_the_converter() -> None:
    assert levels(RIG, noisy(100)).stated == pytest.approx(math.hypot(2e-3, STEP / math.sqrt(12.0)))
    each = load_rig(overrides={'psd_1.noise': [1e-3, 2e-3], 'psd_2.noise': [4e-3, 3e-3]})
    mean = math.sqrt((1.0 + 4.0 + 16.0 + 9.0) / 4.0) * 1e-3
    assert levels(each, noisy(100)).stated == pytest.approx(math.hypot(mean, STEP / math.sqrt(12.0)))


def test_noise_is_that_of_third_differences() -> None:
    volts = noisy(800)
    volts[400:] += 0.3
    volts[::90] -= 0.5
    volts += 1e-6 * np.arange(800.0)[:, None] ** 2
    volts[[100, 333]] = np.nan
    found = levels(RIG, volts)
    for channel in range(6):
        v = volts[:, channel]
        rough = [v[i + 3] - 3.0 * v[i + 2] + 3.0 * v[i + 1] - v[i] for i in range(797)]
        rough = [r for r in rough if math.isfinite(r)]
        # A deviation is 1.4826 medians; four of them, and of the converter's step at least.
        most = 4.0 * max(1.4826 * float(np.median(np.abs(rough))), STEP)
        clipped = [min(max(r, -most), most) for r in rough]
        # The variance of 1, 3, 3, 1 times white noise is 20.
        wanted = math.sqrt(sum(c * c for c in clipped) / len(clipped) / 20.0)
        assert found.noise[channel] == pytest.approx(wanted)
    assert found.sums == pytest.approx(np.nanmean(volts[:, [2, 5]], axis=0))
    assert found.stuck == ()
    # Of samples between lost ones nothing is told, and the least is the converter's step.
    alone = np.where(np.arange(30)[:, None] % 3 == 0, noisy(30), np.nan)
    assert levels(RIG, alone).noise.tolist() == [0.0] * 6
    still = np.zeros((900, 6))
    still[450:] = 1.0
    assert levels(RIG, still).noise == pytest.approx(math.sqrt((1 + 4 + 1) * 16 / 897 / 20) * STEP, rel=0.5)


def test_constant_channel_is_stuck_if_noise_moves_bits() -> None:
    volts = noisy(200)
    volts[:, [1, 5]] = 0.25
    assert levels(RIG, volts).stuck == ('y1', 'sum2')
    # Noise of one step of the converter moves none for sure.
    for noise, stuck in ((STEP, ()), (1.01 * STEP, ('y1', 'sum2'))):
        quiet = load_rig(overrides={'amplifier.noise': noise})
        assert levels(quiet, volts).stuck == stuck


def test_one_sample_has_no_noise() -> None:
    found = levels(RIG, noisy(1))
    assert found.noise.tolist() == [0.0] * 6
    assert found.sums == pytest.approx(noisy(1)[0, [2, 5]])


def waves(n: int, rate: float, amplitudes: dict[float, float]) -> FloatArray:
    """Volts (n, 6); the mains only on y1."""
    t = np.arange(n) / rate
    out = np.random.default_rng(3).normal(0.0, 1e-3, (n, 6)) + 2.0
    for hz, size in amplitudes.items():
        out[:, 1] += size * np.sin(2.0 * math.pi * hz * t + 0.7)
    return out


def test_hum_is_the_amplitude_of_the_mains_that_stands_out_more() -> None:
    noise = np.full(6, 1e-3)
    hz, hum = module.mains_hum(waves(4000, 1000.0, {50.0: 2e-3, 60.0: 5e-3}), 1000.0, noise)
    assert hz == 60.0
    assert hum[1] == pytest.approx(5e-3, rel=0.03)
    assert hum[[0, 2, 3, 4, 5]].tolist() == [0.0] * 5
    hz, hum = module.mains_hum(waves(4000, 1000.0, {50.0: 5e-3, 60.0: 2e-3}), 1000.0, noise)
    assert (hz, hum[1]) == (50.0, pytest.approx(5e-3, rel=0.03))
    # Without any it is that of the first.
    hz, hum = module.mains_hum(waves(4000, 1000.0, {}), 1000.0, noise)
    assert (hz, hum.tolist()) == (50.0, [0.0] * 6)


def transform(volts: FloatArray, rate: float, hz: float) -> FloatArray:
    """Amplitude (6,) under a Hann window, term by term."""
    n = len(volts)
    window = [0.5 - 0.5 * math.cos(2.0 * math.pi * i / (n - 1)) for i in range(n)]
    about = volts - volts.mean(axis=0)
    turns = [2.0 * math.pi * hz * i / rate for i in range(n)]
    real = sum(w * math.cos(a) * row for w, a, row in zip(window, turns, about, strict=True))
    imaginary = sum(w * math.sin(a) * row for w, a, row in zip(window, turns, about, strict=True))
    return np.asarray(2.0 * np.hypot(real, imaginary) / sum(window))


@pytest.mark.parametrize(('noise', 'observed'), [(0.0195, True), (0.0205, False)])
def test_hum_below_a_quarter_of_the_noise_is_none(noise: float, observed: bool) -> None:
    volts = waves(4000, 1000.0, {50.0: 5e-3})
    assert bool(module.mains_hum(volts, 1000.0, np.full(6, noise))[1].any()) is observed


@pytest.mark.parametrize(
    ('n', 'rate', 'observed'), [(1000, 1000.0, True), (999, 1000.0, False), (600, 150.0, True), (600, 149.0, False)]
)
def test_hum_needs_a_second_and_2_5_samples_a_period(n: int, rate: float, observed: bool) -> None:
    hz, hum = module.mains_hum(waves(n, rate, {50.0: 0.1}), rate, np.full(6, 1e-3))
    assert hz == 50.0
    assert bool(hum[1] > 0.0) is observed
    assert len(hum) == 6
