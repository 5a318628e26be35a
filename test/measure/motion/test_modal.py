# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The tables of a block, against a Kalman filter written sample by sample, and the motion of one mode."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from psd_deflection.measure.motion.modal import BlockTables, Oscillator
from psd_deflection.records import FloatArray

MODE = Oscillator(14.0, 0.02)
PERIOD = 1e-3


def system(mode: Oscillator) -> FloatArray:
    """dx/dt of (q, q'/w, u, r/w)."""
    w = 2.0 * math.pi * mode.frequency
    return np.array([[0.0, w, 0.0, 0.0], [-w, -2.0 * mode.damping_ratio * w, w, 0.0], [0.0, 0.0, 0.0, w], [0.0] * 4])


@pytest.mark.parametrize('mode', [MODE, Oscillator(21.0, 0.0), Oscillator(3.0, 0.7)])
@pytest.mark.parametrize('seconds', [0.0, 1e-3, 0.02, 0.5])
def test_a_step_is_the_matrix_exponential(mode: Oscillator, seconds: float) -> None:
    expected = expm(system(mode) * seconds)
    np.testing.assert_allclose(mode.step(seconds), expected, atol=1e-12)
    np.testing.assert_allclose(
        mode.pushed(np.array([seconds, -1.0])), [expected[:, 2:].T, np.zeros((2, 4))], atol=1e-12
    )


@pytest.mark.parametrize('kind', [0, 1])
def test_what_a_load_adds_is_the_integral_of_the_covariance(kind: int) -> None:
    a = system(MODE)
    rate = np.zeros((4, 4))
    rate[2 + kind, 2 + kind] = 1.0

    def grows(_: float, p: FloatArray) -> FloatArray:
        p = p.reshape(4, 4)
        return np.asarray(a @ p + p @ a.T + rate).ravel()

    times = np.array([0.001, 0.02, 0.3])
    expected = solve_ivp(grows, (0.0, 0.3), np.zeros(16), t_eval=times, rtol=1e-10, atol=1e-15).y.T.reshape(-1, 4, 4)
    np.testing.assert_allclose(MODE.added_covariance(times)[:, kind], expected, rtol=1e-7, atol=1e-12)


def by_samples(
    y: FloatArray, here: list[int], x: FloatArray, p: FloatArray, rate: FloatArray, r: float
) -> tuple[FloatArray, FloatArray, float, float]:
    """A Kalman filter, one sample after the other: state, covariance, NIS and log det of the innovations."""
    phi = expm(system(MODE) * PERIOD)
    added = np.einsum('c,cij->ij', rate, MODE.added_covariance(np.array([PERIOD]))[0])
    squares = size = 0.0
    for n in range(20):
        x, p = phi @ x, phi @ p @ phi.T + added
        if n in here:
            s = float(p[0, 0]) + r
            e = float(y[n] - x[0])
            k = p[:, 0] / s
            x, p = x + k * e, p - np.outer(k, p[0])
            squares += e * e / s
            size += math.log(s)
    return x, p, squares, size


@pytest.mark.parametrize('lost', [(), (0, 7, 8), tuple(range(1, 20))])
def test_a_block_says_what_a_filter_of_samples_says(lost: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    rates, r = np.array([[[1e-9, 0.0], [1e-5, 0.0], [0.0, 1e-5]]]), 1e-12
    tables = BlockTables((MODE,), 20, PERIOD)
    tables.fill(r * np.eye(20)[None], rates)
    here = [n for n in range(20) if n not in lost]
    gains = tables.gains(np.array(here))
    x = np.array([1e-3, -2e-3, 5e-4, 1e-4])
    root = rng.normal(0.0, 1e-5, (4, 4))
    p = root @ root.T
    y = 1e-3 * rng.normal(1.0, 1e-2, 20)
    for k, rate in enumerate(rates[0]):
        expected = by_samples(y, here, x, p, rate, r)
        miss = y[here] - gains.observed[0] @ x
        posterior = np.linalg.inv(np.linalg.inv(p) + gains.information[0, k])
        score = gains.pulled[0, k] @ miss
        found = gains.kept[0, k] @ (x + posterior @ score) + gains.smoothed[0, k] @ (miss + gains.observed[0] @ x)
        covariance = gains.kept[0, k] @ posterior @ gains.kept[0, k].T + gains.residual[0, k]
        squares = miss @ gains.precision[0, k] @ miss - score @ posterior @ score
        size = gains.log_size[0, k] + np.linalg.slogdet(p)[1] - np.linalg.slogdet(posterior)[1]
        np.testing.assert_allclose(found, expected[0], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(covariance, expected[1], rtol=1e-5, atol=1e-18)
        assert squares == pytest.approx(expected[2], rel=1e-6)
        assert size == pytest.approx(expected[3], abs=1e-6)
