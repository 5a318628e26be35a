# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bias, scale and noise of made-up differences, against figures written down beside them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import linregress

from psd_deflection.studies.validate.agreement import agreement


def test_bias_scale_and_noise_are_separated() -> None:
    rng = np.random.default_rng(0)
    true = 2e-3 * np.sin(np.linspace(0.0, 40.0, 3000))
    reference = true + rng.normal(0.0, 10e-6, 3000)
    found = agreement(1.004 * true + 5e-6, reference)
    assert found.bias == pytest.approx(5e-6 + 0.004 * true.mean(), abs=4 * found.bias_sd)
    assert found.scale == pytest.approx(0.004, abs=4 * found.scale_sd)
    assert found.scale_sd < 3e-4
    assert found.noise == pytest.approx(10e-6, rel=0.05)
    assert found.share == pytest.approx(found.rms / np.abs(reference).max())


def test_a_noisy_reference_does_not_shrink_the_scale() -> None:
    rng = np.random.default_rng(1)
    true = 1e-4 * np.sin(np.linspace(0.0, 300.0, 20000))
    found = agreement(true, true + rng.normal(0.0, 50e-6, 20000))
    # The slope of the estimate on this reference would be 1/3 too small.
    assert abs(found.scale) < 4 * found.scale_sd < 0.1


def test_limits_are_those_of_bland_and_altman() -> None:
    estimate = np.array([1.0, 2.0, 3.0, 4.0, 6.0])
    reference = np.array([1.1, 1.8, 3.3, 3.9, 5.7])
    found = agreement(estimate, reference)
    d = estimate - reference
    assert found.bias == pytest.approx(d.mean())
    assert found.limits == pytest.approx((d.mean() - 1.96 * d.std(ddof=1), d.mean() + 1.96 * d.std(ddof=1)))
    assert found.rms == pytest.approx(np.sqrt((d**2).mean()))
    assert found.largest == pytest.approx(0.3)


def test_a_reference_that_moves_the_other_way_is_mirrored() -> None:
    rng = np.random.default_rng(3)
    true = 2e-3 * np.sin(np.linspace(0.0, 40.0, 3000))
    noise = rng.normal(0.0, 10e-6, 3000)
    assert agreement(true, noise - true).mirrored
    assert not agreement(true, noise + true).mirrored
    assert not agreement(rng.normal(0.0, 1e-6, 3000), noise).mirrored


def test_deviations_match_many_runs_of_coloured_noise() -> None:
    rng = np.random.default_rng(4)
    true = 2e-3 * np.sin(np.linspace(0.0, 40.0, 400))
    plain, half = [], []
    for _ in range(200):
        noise = rng.normal(0.0, 10e-6, 400)
        for i in range(1, 400):
            noise[i] += 0.9 * noise[i - 1]
        plain.append(agreement(true, true + noise))
        half.append(agreement(true, 2.0 * true + noise))
    assert np.std([f.bias for f in plain]) == pytest.approx(np.median([f.bias_sd for f in plain]), rel=0.35)
    assert np.mean([f.scale for f in half]) == pytest.approx(-0.5, abs=1e-3)
    assert np.std([f.scale for f in half]) == pytest.approx(np.median([f.scale_sd for f in half]), rel=0.35)


def test_slope_and_deviations_are_those_of_a_regression() -> None:
    """Errors that change sign each time have no memory: the deviations are those of least squares."""
    estimate = np.array([0.0, 1.0, 2.0, 4.0, 5.0, 7.0, 8.0, 9.0, 11.0, 12.0]) + 100.0
    error = 0.1 * np.resize([1.0, -1.0], 10) * [1.0, 2.0, 1.0, 3.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0]
    reference = 0.8 * estimate - 3.0 + error
    found = agreement(estimate, reference)
    fit = linregress(estimate, reference)
    left = reference - fit.slope * estimate - fit.intercept
    assert found.scale == pytest.approx(1.0 / fit.slope - 1.0)
    assert found.noise == pytest.approx(np.sqrt(left @ left / 8.0))
    # Of one over the slope.
    assert found.scale_sd == pytest.approx(fit.stderr / fit.slope**2)
    assert found.share == pytest.approx(found.rms / reference[-1])
    even = agreement(5.0 + error, np.full(10, 5.0))
    assert even.bias_sd == pytest.approx(error.std(ddof=1) / math.sqrt(10.0))


def test_an_estimate_that_stands_still_has_no_scale() -> None:
    found = agreement(np.full(20, 0.5), np.resize([0.0, 1.0, 0.2], 20))
    assert math.isnan(found.scale)
    assert math.isnan(found.scale_sd)
    assert math.isnan(found.share)
    assert not found.mirrored
    assert found.noise == pytest.approx(np.resize([0.0, 1.0, 0.2], 20).std(ddof=1))
    assert found.largest == 0.5
