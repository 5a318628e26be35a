# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The fitted motion, against polynomials that numpy fits to each instant alone, and counts by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from psd_deflection.records import FloatArray
from psd_deflection.studies.validate.motion import Motion

PERIOD = 2.0**-10
"""s: sums of it are exact."""


def first_three(dots: FloatArray) -> FloatArray:
    poses: FloatArray = dots[:, :3].copy()
    return poses


def of(kept: FloatArray, seed: int = 0, period: float = PERIOD) -> Motion:
    """Samples at the places ``kept``, a cubic with noise on each channel."""
    rng = np.random.default_rng(seed)
    t = kept * period
    dots = np.stack([a + 40.0 * a * t - 900.0 * t**2 + 9e4 * a * t**3 for a in (1.0, -2.0, 0.5, 3.0)], axis=1)
    return Motion(t, dots + rng.normal(0.0, 0.1, dots.shape), period, first_three)


@pytest.mark.parametrize(('exposure', 'half'), [(0.0, 8), (7.8, 12), (10.0, 13), (0.5, 9)])
def test_instant_has_polynomial_through_nearby_samples(exposure: float, half: int) -> None:
    """``exposure`` in samples: eight samples on either side of it."""
    places = np.delete(np.arange(120.0), [40, 41, 44, 77])
    motion = of(places)
    at = np.array([5.3, 20.0, 30.2, 30.45, 30.7, 43.4, 45.9, 76.6, 90.0, 115.8])
    values, rates, variances = motion.dots_at(at * PERIOD, exposure * PERIOD)
    inside, weights = np.polynomial.legendre.leggauss(8)
    for i, instant in enumerate(at):
        near = np.abs(places - instant) <= half + 0.5
        for channel in range(4):
            # From the instant, in samples.
            u = places[near] - instant
            fit = Polynomial.fit(u, motion.dots[near, channel], 4).convert()
            deviation = fit.integ()
            mean = (deviation(0.5 * exposure) - deviation(-0.5 * exposure)) / exposure if exposure else fit(0.0)
            ends = (fit(0.5 * exposure) - fit(-0.5 * exposure)) / exposure if exposure else fit.deriv()(0.0)
            assert values[i, channel] == pytest.approx(mean, rel=1e-9)
            assert rates[i, channel] == pytest.approx(ends / PERIOD, rel=1e-8)
            left = motion.dots[near, channel] - fit(u)
            design = np.vander(u / half, 5)
            share = 0.5 * weights @ np.vander(0.5 * exposure * inside / half, 5)
            factor = share @ np.linalg.solve(design.T @ design, share)
            assert variances[i, channel] == pytest.approx(left @ left / (len(u) - 5) * factor, rel=1e-7)


def test_nothing_is_known_of_instants_outside_the_samples() -> None:
    motion = of(np.arange(40.0))
    values, _, _ = motion.dots_at(np.array([-5.0, 2.0, 2.5, 3.0, 36.0, 36.5, 37.5, 60.0]) * PERIOD)
    assert np.isfinite(values[:, 0]).tolist() == [False, False, True, True, True, True, False, False]


def test_single_samples_lie_on_an_even_grid() -> None:
    # Samples 2 and 5 are lost, that of place 6 has no pose; the stamps tremble.
    t = 7.0 + np.array([0.0, 1.2, 2.9, 4.1, 6.0, 7.2, 8.0]) * 1e-3
    dots = np.array([[0.0, 5.0, 1.0], [2.0, 5.0, 1.0], [6.0, 5.0, 3.0], [4.0, 5.0, 4.0], [9.0, 9.0, 9.0]])
    dots = np.concatenate([dots, [[10.0, 8.0, 7.0], [3.0, 5.0, 0.0]]])
    asked = []

    def solve(d: FloatArray) -> FloatArray:
        asked.append(len(d))
        poses = first_three(d)
        poses[4, 1] = np.nan
        return poses

    motion = Motion(t, np.column_stack([dots, np.zeros(7)]), 1e-3, solve)
    poses, there = motion.grid()
    assert there.tolist() == [True, True, False, True, True, False, False, True, True]
    np.testing.assert_allclose(poses[:, 0], [0.0, 2.0, 4.0, 6.0, 4.0, 6.0, 8.0, 10.0, 3.0])
    np.testing.assert_allclose(poses[:, 1], [5.0, 5.0, 5.0, 5.0, 5.0, 6.0, 7.0, 8.0, 5.0])
    np.testing.assert_allclose(poses[:, 2], [1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 0.0])
    assert motion.grid()[0] is poses
    assert asked == [7]
    assert '_grid=' not in repr(motion)
