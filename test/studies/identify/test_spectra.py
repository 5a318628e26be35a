# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Spectra known by hand or computed again with scipy; the likelihood of a driven link's mode, written again."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.signal import lfilter, welch
from scipy.signal.windows import hann
from scipy.stats import gamma

from psd_deflection.records import FloatArray
from psd_deflection.studies.identify import spectra

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
    assert spectra.white_noise(samples) == pytest.approx(math.sqrt(sum(each[:quiet]) / quiet / 70.0), rel=1e-9)


@pytest.mark.parametrize('frequency', [0.25, 0.375, 0.5, 1.0, 20.125, 133.625, 200.0, 200.125, 240.0])
def test_a_peak_of_half_a_hertz_to_200_is_found(frequency: float) -> None:
    peak = frequency if 0.5 <= frequency <= 200.0 else None
    assert spectra.loudest_peak(sine(frequency), RATE, 1e-9) == peak


@pytest.mark.parametrize(('frequency', 'rate'), [(20.0, RATE), (150.0, RATE), (60.0, 300.0)])
def test_a_peak_is_25_times_the_noise(frequency: float, rate: float) -> None:
    samples = sine(frequency, rate=rate)
    f, p = of_differences(samples, rate)
    top = float(p[np.argmin(np.abs(f - frequency))])
    for factor, expected in ((24.9, None), (25.1, frequency)):
        noise = math.sqrt(top / factor / speed_of_white(1.0, frequency, rate))
        assert spectra.loudest_peak(samples, rate, noise) == expected


def test_a_further_peak_is_not_at_one_that_is_taken() -> None:
    """Not within 15 % of its frequency, nor within two lines of the spectrum, an eighth of a hertz each."""
    assert spectra.loudest_peak(sine(22.875), RATE, 1e-9, [20.0]) is None
    assert spectra.loudest_peak(sine(17.125), RATE, 1e-9, [20.0]) is None
    assert spectra.loudest_peak(sine(23.125), RATE, 1e-9, [20.0]) == 23.125
    assert spectra.loudest_peak(sine(16.875), RATE, 1e-9, [40.0, 20.0]) == 16.875
    assert spectra.loudest_peak(sine(1.0), RATE, 1e-9, [0.75]) == 1.0
    assert spectra.loudest_peak(sine(0.875), RATE, 1e-9, [0.75]) is None


def test_the_deviation_is_the_area_under_the_density() -> None:
    assert spectra.ColouredNoise(4.0, 0.0).deviation(100.0, RATE) == pytest.approx(40.0)
    area, _ = quad(lambda f: 4.0 + 5.0 / abs(1.0 - np.exp(-2j * np.pi * f / RATE)) ** 2, 50.0, 500.0)
    assert spectra.ColouredNoise(4.0, 5.0).deviation(50.0, RATE) == pytest.approx(math.sqrt(area), rel=2e-3)


@pytest.mark.parametrize('peaks', [[14.0], [14.0, 46.0]])
def test_white_noise_below_a_link_that_is_driven_keeps_its_size(peaks: list[float]) -> None:
    """The flanks of the modes are no noise that remembers."""
    rng = np.random.default_rng(7)
    samples = rng.normal(0.0, 2e-6, 20_000)
    for peak in peaks:
        w = 2.0 * np.pi * peak / RATE
        pole = np.exp(-0.02 * w + 1j * w)
        samples += lfilter([2e-6], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.normal(size=20_000))
    noise = spectra.coloured_noise(samples, RATE, peaks)
    density = noise.density(np.array([120.0, 300.0, 450.0]), RATE)
    np.testing.assert_allclose(density, 2.0 * 2e-6**2 / RATE, rtol=0.12)


def test_coloured_noise_has_autoregressive_density() -> None:
    rng = np.random.default_rng(8)
    samples = sine(14.0) + lfilter([1e-6], [1.0, -0.9], rng.normal(size=20_000))
    f = np.array([60.0, 120.0, 300.0])
    expected = 2e-12 / RATE / np.abs(1.0 - 0.9 * np.exp(-2j * np.pi * f / RATE)) ** 2
    np.testing.assert_allclose(spectra.coloured_noise(samples, RATE, [14.0]).density(f, RATE), expected, rtol=0.15)


def test_band_above_fast_mode_has_no_random_walk() -> None:
    """The whole spectrum then stands for the noise."""
    samples = np.random.default_rng(9).normal(0.0, 2e-6, 20_000)
    noise = spectra.coloured_noise(samples, RATE, [185.0])
    assert noise.random_walk == 0.0
    assert noise.white == pytest.approx(2.0 * 2e-6**2 / RATE, rel=0.05)


@pytest.mark.parametrize('frequency', [14.0, 14.05, 0.125])
def test_a_mode_exceeds_the_noise_at_its_frequency_25_times(frequency: float) -> None:
    samples = sine(frequency)
    f, p = of_differences(samples)
    top = float(np.interp(frequency, f, p))
    for factor, expected in ((24.9, False), (25.1, True)):
        # Half of it is white, half remembers.
        half = 0.5 * top / factor / (RATE**2 * abs(1.0 - np.exp(-2j * np.pi * frequency / RATE)) ** 2)
        noise = spectra.ColouredNoise(half, half * float(abs(1.0 - np.exp(-2j * np.pi * frequency / RATE)) ** 2))
        assert spectra.exceeds_noise(samples, RATE, frequency, noise) is expected


DRIVEN_RATE = 200.0


def driven(
    frequency: float = 14.0, zeta: float = 0.02, seconds: float = 30.0, seed: int = 1, noise: float = 0.0
) -> FloatArray:
    """About 1 mm of a resonator of one pole pair that noise drives."""
    rng = np.random.default_rng(seed)
    w = 2.0 * np.pi * frequency / DRIVEN_RATE
    pole = np.exp(-zeta * w + 1j * w * math.sqrt(1.0 - zeta**2))
    n = round(seconds * DRIVEN_RATE)
    moved = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.normal(size=n + 2000))[2000:]
    return np.asarray(1e-3 * moved / moved.std() + noise * rng.normal(size=n))


def lines(samples: FloatArray, frequency: float) -> tuple[FloatArray, FloatArray]:
    """Every second line of the density of the samples about ``frequency``, a Hann window before the transform."""
    n = len(samples)
    k = np.arange(n)
    straight = samples - np.polyval(np.polyfit(k, samples, 1), k)
    window = hann(n, sym=False)
    p = 2.0 * np.abs(np.fft.rfft(straight * window)) ** 2 / (DRIVEN_RATE * np.sum(window**2))
    f = np.asarray(np.fft.rfftfreq(n, 1.0 / DRIVEN_RATE), dtype=np.float64)
    about = np.flatnonzero((f > 0.6 * frequency) & (f < 1.5 * frequency))[::2]
    return f[about], p[about]


@pytest.mark.parametrize(('prior', 'guess'), [pytest.param(None, 14.0, marks=pytest.mark.slow), (0.2, 14.5)])
def test_mode_is_likeliest_with_scatter_of_likelihood(
    prior: float | None, guess: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The likelihood of exponential lines, in other parameters and by another search."""
    if prior is None:
        # What is said of it.
        prior = 1.0
    else:
        monkeypatch.setattr(spectra, 'SLOPE_SD', prior)
    samples = driven(noise=3e-5) + 1e-3 * np.arange(6000) / 6000.0 + 5e-3
    f, p = lines(samples, guess)

    def density(x: FloatArray) -> FloatArray:
        peak, f0, zeta, slope, floor = x
        r = f / f0
        shape = 4.0 * zeta**2 / ((1.0 - r**2) ** 2 + 4.0 * zeta**2 * r**2)
        return np.asarray(1e-6 * peak * r**-slope * shape + 1e-10 * floor)

    def loss(x: FloatArray) -> float:
        s = density(x)
        return float(np.sum(np.log(1e8 * s) + p / s) + 0.5 * (x[3] / prior) ** 2)

    best = minimize(
        loss,
        [1.0, 14.0, 0.02, 0.0, 0.1],
        method='L-BFGS-B',
        bounds=[(1e-3, 1e3), (13, 15), (5e-3, 0.1), (-5, 5), (1e-6, 1e3)],
    )
    best = minimize(loss, best.x, method='Nelder-Mead', options={'xatol': 1e-9, 'fatol': 1e-12, 'maxfev': 4000})
    mode = spectra.mode_in_operation(samples, DRIVEN_RATE, guess)
    assert mode is not None
    assert mode.frequency == pytest.approx(best.x[1], rel=3e-6)
    assert mode.damping == pytest.approx(best.x[2], rel=3e-4)
    slopes = []
    for i, step in enumerate(1e-5 * np.maximum(np.abs(best.x), 1e-2)):
        more = np.array(best.x)
        more[i] += step
        slopes.append((np.log(density(more)) - np.log(density(best.x))) / step)
    information = np.array(slopes) @ np.array(slopes).T
    information[3, 3] += 1.0 / prior**2
    deviations = np.sqrt(np.linalg.inv(information).diagonal())
    assert mode.frequency_sd == pytest.approx(deviations[1], rel=2e-3)
    assert mode.damping_sd == pytest.approx(deviations[2], rel=2e-3)
    # The area under what the mode adds, without the slope of what drives it.
    peak, f0, z = best.x[:3]
    at = [0.9, 1.0, 1.1]
    area, _ = quad(lambda r: 4.0 * z**2 / ((1.0 - r**2) ** 2 + 4.0 * z**2 * r**2), 0.0, 50.0, points=at, limit=500)
    assert mode.amplitude == pytest.approx(math.sqrt(1e-6 * peak * f0 * area), rel=1e-3)


@pytest.mark.parametrize(
    ('guess', 'observed'), [(14.0 / 0.72, True), (14.0 / 0.68, False), (10.15, True), (9.7, False)]
)
def test_mode_far_from_peak_is_not_returned(guess: float, observed: bool) -> None:
    """Below 0.7 of it or above 1.4."""
    assert (spectra.mode_in_operation(driven(noise=3e-5), DRIVEN_RATE, guess) is not None) is observed


@pytest.mark.parametrize(('seconds', 'observed'), [(4.6, False), (4.8, True)])
def test_a_spectrum_of_thirty_lines_is_enough(seconds: float, observed: bool) -> None:
    samples = driven(seconds=seconds, zeta=0.05, noise=3e-5)
    assert (len(lines(samples, 14.0)[0]) == 30) is observed
    assert len(lines(samples, 14.0)[0]) in (29, 30)
    assert (spectra.mode_in_operation(samples, DRIVEN_RATE, 14.0) is not None) is observed


def test_a_steady_swing_is_no_driven_mode() -> None:
    """Nor are two modes one."""
    t = np.arange(6000) / DRIVEN_RATE
    noise = 3e-5 * np.random.default_rng(2).normal(size=6000)
    assert spectra.mode_in_operation(1e-3 * np.sin(2.0 * np.pi * 14.0 * t) + noise, DRIVEN_RATE, 14.0) is None
    assert spectra.mode_in_operation(driven() + driven(17.0, 0.01, seed=2) + noise, DRIVEN_RATE, 14.0) is None


def test_ratios_as_they_should_be_pass() -> None:
    rng = np.random.default_rng(6)
    assert sum(spectra.scatters_as_exponential(rng.exponential(size=200)) for _ in range(40)) >= 39
    # One of 50 pieces of four may be as unlikely as 1e-5.
    for tail, passes in ((1e-5, True), (2e-6, False)):
        assert spectra.scatters_as_exponential(np.r_[[gamma.isf(tail, 4) / 4.0] * 4, np.ones(196)]) == passes
    assert not spectra.scatters_as_exponential(1.5 * rng.exponential(size=1000))
    assert not spectra.scatters_as_exponential(np.ones(1000) + 1e-3 * rng.normal(size=1000) + 0.8)
