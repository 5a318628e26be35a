# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The mode of a driven link: its likelihood written again, and spectra that no driven mode has."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.signal.windows import hann

from psd_deflection.records import FloatArray
from psd_deflection.studies.identify import operation
from psd_deflection.studies.identify.operation import mode_in_operation, scatters_as_exponential

RATE = 200.0


def driven(
    frequency: float = 14.0, zeta: float = 0.02, seconds: float = 30.0, seed: int = 1, noise: float = 0.0
) -> FloatArray:
    """About 1 mm of a resonator of one pole pair that noise drives."""
    rng = np.random.default_rng(seed)
    w = 2.0 * np.pi * frequency / RATE
    pole = np.exp(-zeta * w + 1j * w * math.sqrt(1.0 - zeta**2))
    n = round(seconds * RATE)
    moved = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.normal(size=n + 2000))[2000:]
    return np.asarray(1e-3 * moved / moved.std() + noise * rng.normal(size=n))


def lines(samples: FloatArray, frequency: float) -> tuple[FloatArray, FloatArray]:
    """Every second line of the density of the samples about ``frequency``, a Hann window before the transform."""
    n = len(samples)
    k = np.arange(n)
    straight = samples - np.polyval(np.polyfit(k, samples, 1), k)
    window = hann(n, sym=False)
    p = 2.0 * np.abs(np.fft.rfft(straight * window)) ** 2 / (RATE * np.sum(window**2))
    f = np.asarray(np.fft.rfftfreq(n, 1.0 / RATE), dtype=np.float64)
    about = np.flatnonzero((f > 0.6 * frequency) & (f < 1.5 * frequency))[::2]
    return f[about], p[about]


@pytest.mark.slow
@pytest.mark.parametrize(('prior', 'guess'), [(None, 14.0), (0.2, 14.5)])
def test_mode_is_likeliest_with_scatter_of_likelihood(
    prior: float | None, guess: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The likelihood of exponential lines, in other parameters and by another search."""
    if prior is None:
        # What is said of it.
        prior = 1.0
    else:
        monkeypatch.setattr(operation, 'SLOPE_SD', prior)
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
    found = mode_in_operation(samples, RATE, guess)
    assert found is not None
    assert found.frequency == pytest.approx(best.x[1], rel=3e-6)
    assert found.damping == pytest.approx(best.x[2], rel=3e-4)
    slopes = []
    for i, step in enumerate(1e-5 * np.maximum(np.abs(best.x), 1e-2)):
        more = np.array(best.x)
        more[i] += step
        slopes.append((np.log(density(more)) - np.log(density(best.x))) / step)
    information = np.array(slopes) @ np.array(slopes).T
    information[3, 3] += 1.0 / prior**2
    deviations = np.sqrt(np.linalg.inv(information).diagonal())
    assert found.frequency_sd == pytest.approx(deviations[1], rel=2e-3)
    assert found.damping_sd == pytest.approx(deviations[2], rel=2e-3)
    # The area under what the mode adds, without the slope of what drives it.
    peak, f0, zeta = best.x[:3]
    area, _ = quad(
        lambda r: 4.0 * zeta**2 / ((1.0 - r**2) ** 2 + 4.0 * zeta**2 * r**2),
        0.0,
        50.0,
        points=[0.9, 1.0, 1.1],
        limit=500,
    )
    assert found.amplitude == pytest.approx(math.sqrt(1e-6 * peak * f0 * area), rel=1e-3)


@pytest.mark.parametrize(
    ('guess', 'observed'), [(14.0 / 0.72, True), (14.0 / 0.68, False), (10.15, True), (9.7, False)]
)
def test_mode_far_from_peak_is_not_returned(guess: float, observed: bool) -> None:
    """Below 0.7 of it or above 1.4."""
    assert (mode_in_operation(driven(noise=3e-5), RATE, guess) is not None) is observed


@pytest.mark.parametrize(('seconds', 'observed'), [(4.6, False), (4.8, True)])
def test_a_spectrum_of_thirty_lines_is_enough(seconds: float, observed: bool) -> None:
    samples = driven(seconds=seconds, zeta=0.05, noise=3e-5)
    assert (len(lines(samples, 14.0)[0]) == 30) is observed
    assert len(lines(samples, 14.0)[0]) in (29, 30)
    assert (mode_in_operation(samples, RATE, 14.0) is not None) is observed


def test_a_steady_swing_is_no_driven_mode() -> None:
    """Nor are two modes one."""
    t = np.arange(6000) / RATE
    noise = 3e-5 * np.random.default_rng(2).normal(size=6000)
    assert mode_in_operation(1e-3 * np.sin(2.0 * np.pi * 14.0 * t) + noise, RATE, 14.0) is None
    assert mode_in_operation(driven() + driven(17.0, 0.01, seed=2) + noise, RATE, 14.0) is None


def test_ratios_as_they_should_be_pass() -> None:
    rng = np.random.default_rng(6)
    assert sum(scatters_as_exponential(rng.exponential(size=200)) for _ in range(40)) >= 39
    assert not scatters_as_exponential(1.5 * rng.exponential(size=1000))
    assert not scatters_as_exponential(np.ones(1000) + 1e-3 * rng.normal(size=1000) + 0.8)
