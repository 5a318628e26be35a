# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Peaks and noise of spectra that are known by hand or computed again with scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import lfilter, welch

from psd_deflection.records import FloatArray
from psd_deflection.studies.identify.spectra import (
    ColouredNoise,
    coloured_noise,
    exceeds_noise,
    loudest_peak,
    white_noise,
)

RATE = 1000.0


def sine(frequency: float, seconds: float = 20.0, rate: float = RATE) -> FloatArray:
    return np.asarray(1e-3 * np.sin(2.0 * np.pi * frequency * np.arange(round(seconds * rate)) / rate + 0.4))


def of_differences(samples: FloatArray, rate: float = RATE) -> tuple[FloatArray, FloatArray]:
    """The spectrum of the speed, in pieces of eight seconds."""
    f, p = welch(rate * (samples[1:] - samples[:-1]), rate, nperseg=min(len(samples) - 1, round(8.0 * rate)))
    return np.asarray(f), np.asarray(p)


def speed_of_white(deviation: float, f: float, rate: float = RATE) -> float:
    """Density of the speed that white noise seems to have, one-sided."""
    return float(2.0 * deviation**2 / rate * abs(rate * (1.0 - np.exp(-2j * np.pi * f / rate))) ** 2)


@pytest.mark.parametrize(('count', 'pieces', 'quiet'), [(6000, 12, 3), (5989, 11, 2), (1000, 2, 1), (300, 1, 1)])
def test_the_noise_is_that_of_the_quietest_quarter(count: int, pieces: int, quiet: int) -> None:
    """Of fourth differences, in pieces of five hundred."""
    rng = np.random.default_rng(count)
    loudness = np.repeat(rng.permutation(np.arange(1.0, 21.0)), math.ceil((count + 4) / 20))[: count + 4]
    samples = 1e-6 * loudness * rng.normal(size=count + 4)
    difference = np.convolve(samples, [1.0, -4.0, 6.0, -4.0, 1.0], 'valid')
    each = sorted(float(np.mean(piece**2)) for piece in np.array_split(difference, pieces))
    assert white_noise(samples) == pytest.approx(math.sqrt(sum(each[:quiet]) / quiet / 70.0), rel=1e-9)


@pytest.mark.parametrize('frequency', [0.5, 1.0, 20.125, 133.625, 200.0])
def test_a_peak_is_found_where_it_is(frequency: float) -> None:
    assert loudest_peak(sine(frequency), RATE, 1e-9) == frequency


@pytest.mark.parametrize('frequency', [0.25, 0.375, 200.125, 240.0])
def test_what_is_slower_or_faster_than_a_link_is_no_peak(frequency: float) -> None:
    assert loudest_peak(sine(frequency), RATE, 1e-9) is None


@pytest.mark.parametrize(('frequency', 'rate'), [(20.0, RATE), (150.0, RATE), (60.0, 300.0)])
def test_a_peak_is_25_times_the_noise(frequency: float, rate: float) -> None:
    samples = sine(frequency, rate=rate)
    f, p = of_differences(samples, rate)
    top = float(p[np.argmin(np.abs(f - frequency))])
    for factor, expected in ((24.9, None), (25.1, frequency)):
        noise = math.sqrt(top / factor / speed_of_white(1.0, frequency, rate))
        assert loudest_peak(samples, rate, noise) == expected


def test_a_further_peak_is_not_at_one_that_is_taken() -> None:
    """Not within 15 % of its frequency, nor within two lines of the spectrum, an eighth of a hertz each."""
    assert loudest_peak(sine(22.875), RATE, 1e-9, [20.0]) is None
    assert loudest_peak(sine(17.125), RATE, 1e-9, [20.0]) is None
    assert loudest_peak(sine(23.125), RATE, 1e-9, [20.0]) == 23.125
    assert loudest_peak(sine(16.875), RATE, 1e-9, [40.0, 20.0]) == 16.875
    assert loudest_peak(sine(1.0), RATE, 1e-9, [0.75]) == 1.0
    assert loudest_peak(sine(0.875), RATE, 1e-9, [0.75]) is None


def test_the_deviation_is_the_area_under_the_density() -> None:
    assert ColouredNoise(4.0, 0.0).deviation(100.0, RATE) == pytest.approx(40.0)
    area, _ = quad(lambda f: 4.0 + 5.0 / abs(1.0 - np.exp(-2j * np.pi * f / RATE)) ** 2, 50.0, 500.0)
    assert ColouredNoise(4.0, 5.0).deviation(50.0, RATE) == pytest.approx(math.sqrt(area), rel=2e-3)


@pytest.mark.parametrize('peaks', [[14.0], [14.0, 46.0]])
def test_white_noise_below_a_link_that_is_driven_keeps_its_size(peaks: list[float]) -> None:
    """The flanks of the modes are no noise that remembers."""
    rng = np.random.default_rng(7)
    samples = rng.normal(0.0, 2e-6, 20_000)
    for peak in peaks:
        w = 2.0 * np.pi * peak / RATE
        pole = np.exp(-0.02 * w + 1j * w)
        samples += lfilter([2e-6], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.normal(size=20_000))
    found = coloured_noise(samples, RATE, peaks)
    density = found.density(np.array([120.0, 300.0, 450.0]), RATE)
    np.testing.assert_allclose(density, 2.0 * 2e-6**2 / RATE, rtol=0.12)


def test_coloured_noise_has_autoregressive_density() -> None:
    rng = np.random.default_rng(8)
    samples = sine(14.0) + lfilter([1e-6], [1.0, -0.9], rng.normal(size=20_000))
    f = np.array([60.0, 120.0, 300.0])
    expected = 2e-12 / RATE / np.abs(1.0 - 0.9 * np.exp(-2j * np.pi * f / RATE)) ** 2
    np.testing.assert_allclose(coloured_noise(samples, RATE, [14.0]).density(f, RATE), expected, rtol=0.15)


def test_band_above_fast_mode_has_no_random_walk() -> None:
    """The whole spectrum then stands for the noise."""
    samples = np.random.default_rng(9).normal(0.0, 2e-6, 20_000)
    found = coloured_noise(samples, RATE, [185.0])
    assert found.walk == 0.0
    assert found.white == pytest.approx(2.0 * 2e-6**2 / RATE, rel=0.05)


@pytest.mark.parametrize('frequency', [14.0, 14.05, 0.125])
def test_a_mode_exceeds_the_noise_at_its_frequency_25_times(frequency: float) -> None:
    samples = sine(frequency)
    f, p = of_differences(samples)
    top = float(np.interp(frequency, f, p))
    for factor, expected in ((24.9, False), (25.1, True)):
        # Half of it is white, half remembers.
        half = 0.5 * top / factor / (RATE**2 * abs(1.0 - np.exp(-2j * np.pi * frequency / RATE)) ** 2)
        noise = ColouredNoise(half, half * float(abs(1.0 - np.exp(-2j * np.pi * frequency / RATE)) ** 2))
        assert exceeds_noise(samples, RATE, frequency, noise) is expected
