# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Modes of links whose motion is computed elsewhere; links that do not move or are struck all the time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from blind.modes import CASES, RATE, Link, driven, noise, rung, scored
from psd_deflection.studies.identify.modes import modes_of


@pytest.mark.slow
@pytest.mark.parametrize(
    ('name', 'frequency_off', 'damping_off'),
    [('ring-down', 0.0005, 0.03), ('equal releases', 0.0005, 0.03), ('noise of memory 0.9', 0.003, 0.15)],
)
def test_intervals_hold_the_truth(name: str, frequency_off: float, damping_off: float) -> None:
    """`python -m blind.modes` has the figures of 200 rigs. At 95 %, fewer than 9 of 12 are one case in 5000."""
    score = scored(range(12), CASES[name])
    assert score.missed == 0
    assert max(map(abs, score.frequency)) < frequency_off
    assert max(map(abs, score.damping)) < damping_off
    frequency, damping = np.sum(score.inside, axis=0)
    assert frequency >= 9
    assert damping >= 9


@pytest.mark.slow
def test_one_weight_hung_on_and_off_rings_as_well() -> None:
    """The windows that hold a blow swing most; there are more of them than would be tried."""
    samples = rung(Link(((14.0, 0.02, 1.0),)), np.random.default_rng(4), 14.0, 6, equal=True)
    found = modes_of(samples, RATE)
    assert found.how == 'ring-down'
    (mode,) = found.modes
    assert abs(mode.frequency - 14.0) < 4.0 * mode.frequency_sd < 0.0005 * 14.0
    assert abs(mode.damping - 0.02) < 4.0 * mode.damping_sd < 0.03 * 0.02


@pytest.mark.slow
def test_two_modes_that_beat_are_two() -> None:
    """Bending planes turned against the axes: both show on each."""
    second, damping = 14.3, 0.01
    link = Link(((14.0, damping, 0.5), (second, damping, 0.5)))
    found = modes_of(rung(link, np.random.default_rng(6), 14.0, 3), RATE)
    assert found.how == 'ring-down'
    low, high = sorted(found.modes, key=lambda m: m.frequency)
    for mode, frequency in ((low, 14.0), (high, second)):
        assert abs(mode.frequency - frequency) < 4.0 * mode.frequency_sd < 0.0005 * frequency
        assert abs(mode.damping - damping) < 4.0 * mode.damping_sd < 0.03 * damping


@pytest.mark.slow
def test_coloured_noise_widens_interval_without_bias() -> None:
    link = Link(((14.0, 0.02, 1.0),), noise=20e-6, memory=0.9)
    modes = [modes_of(rung(link, np.random.default_rng(seed)), RATE) for seed in range(2)]
    assert {m.how for m in modes} == {'ring-down'}
    for found in modes:
        (mode,) = found.modes
        assert abs(mode.damping - 0.02) < 4.0 * mode.damping_sd
        assert abs(mode.frequency - 14.0) < 4.0 * mode.frequency_sd
        assert found.noise == pytest.approx(20e-6, rel=0.15)


def test_noise_that_remembers_has_no_mode() -> None:
    for seed in range(2):
        samples = 2e-6 * noise(10_000, 0.9, np.random.default_rng(seed))
        assert modes_of(samples, RATE).modes == ()


def test_a_step_response_of_scipy() -> None:
    """A link at 14 Hz, ratio 0.02, whose load is 1 from 0.5 s to 3 s; simulated by scipy."""
    w, zeta = 2.0 * np.pi * 14.0, 0.02
    t = np.arange(5000) / RATE
    load = ((t > 0.5) & (t < 3.0)).astype(float)
    _, moved, _ = lsim(([w * w], [1.0, 2.0 * zeta * w, w * w]), load, t, interp=False)
    samples = 2e-3 * moved + np.random.default_rng(0).normal(0.0, 2e-6, len(t))
    found = modes_of(samples, RATE)
    assert found.how == 'ring-down'
    (mode,) = found.modes
    assert mode.frequency == pytest.approx(14.0, rel=1e-4)
    assert mode.damping == pytest.approx(zeta, rel=0.01)
    assert mode.amplitude == pytest.approx(2e-3, rel=0.05)
    assert found.noise == pytest.approx(2e-6, rel=0.1)
    starts = [first / RATE for first, _ in found.stretches]
    assert any(0.5 <= s < 0.6 for s in starts)
    assert any(3.0 <= s < 3.1 for s in starts)


@pytest.mark.slow
def test_a_second_mode_is_found_and_separated() -> None:
    link = Link(((14.0, 0.02, 0.9), (46.0, 0.01, 0.1)))
    found = modes_of(rung(link, np.random.default_rng(1)), RATE)
    first, second = found.modes
    assert first.frequency == pytest.approx(14.0, rel=1e-4)
    assert second.frequency == pytest.approx(46.0, rel=1e-3)
    assert second.damping == pytest.approx(0.01, rel=0.05)
    assert first.amplitude > 5.0 * second.amplitude


@pytest.mark.slow
def test_one_mode_is_not_made_two() -> None:
    for seed in range(2):
        assert len(modes_of(rung(Link(((14.0, 0.02, 1.0),)), np.random.default_rng(seed)), RATE).modes) == 1


def test_lost_samples_and_creep_do_not_move_it() -> None:
    rng = np.random.default_rng(2)
    samples = rung(Link(((9.0, 0.01, 1.0),)), rng)
    samples += 5e-6 * np.arange(len(samples)) / RATE
    samples[rng.random(len(samples)) < 0.1] = np.nan
    samples[4000:4100] = np.nan
    (mode,) = modes_of(samples, RATE).modes
    assert mode.frequency == pytest.approx(9.0, rel=5e-4)
    assert mode.damping == pytest.approx(0.01, rel=0.03)


def test_in_operation_the_spectrum_reports_it() -> None:
    found = modes_of(driven(Link(((14.0, 0.02, 1.0),)), np.random.default_rng(3)), RATE)
    assert found.how == 'operation'
    (mode,) = found.modes
    assert abs(mode.frequency - 14.0) < 3.0 * mode.frequency_sd < 0.3
    assert abs(mode.damping - 0.02) < 3.0 * mode.damping_sd < 0.02
    assert mode.amplitude == pytest.approx(200e-6, rel=0.3)


def test_noise_has_no_mode() -> None:
    for seed in range(3):
        found = modes_of(np.random.default_rng(seed).normal(0.0, 2e-6, 5000), RATE)
        assert found.modes == ()
        assert found.how == 'none'
