# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Slow noise of the electronics, 1/f: nothing is missing from it, and the ± of what is found beside it covers."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from scipy.signal import lfilter

from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup.noise import NoiseModel
from psd_deflection.studies.discover.setup.slow_noise import SlowNoise, block_factor, corners_of

RIG = load_rig()
PERIOD = 0.004
LOADS = np.repeat(
    np.array([(0, 0, 0), (0, -30, -17), (0, -50, 0), (30, 0, 0), (-20, -20, 15), (0, 0, 0)], float), 3000, axis=0
)


def flicker(n: int, period: float, corner: float, seed: int, channels: int = 6) -> FloatArray:
    """(n, channels): sums of twenty first-order processes, five to a decade, are 1/f; white noise beside them."""
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(n, channels))
    ratio = 10.0 ** (1.0 / 5.0)
    for k in range(-10, 12):
        pole = 2.0 * np.pi * ratio**k
        a = np.exp(-pole * period)
        # A process of variance v has the density 4 v / pole / (1 + (f / f0)^2); their sum is v times 4.5 / f.
        v = corner * np.log(ratio) * 2.0 * period
        new = rng.normal(size=(n, channels)) * np.sqrt(v * (1.0 - a * a))
        before = a * np.sqrt(v) * rng.normal(size=(1, channels))
        out += lfilter([1.0], [1.0, -a], new, axis=0, zi=before)[0]
    return out


@functools.cache
def clean(angle: float) -> FloatArray:
    true = {'effects.e.name': 'sensor_rotation', 'effects.e.psd': 1, 'effects.e.angle': angle} if angle else {}
    rig = replace_values(RIG, true)
    return np.asarray(ForwardModel(rig, effects_of_rig(rig)).expect(LOADS).volts.T)


def observed(corner: float, seed: int, angle: float = 0.0) -> Observation:
    step = RIG.converter.volts_per_count
    noise = RIG.noises.ravel() * flicker(len(LOADS), 1.0 / RIG.converter.sample_rate_hz, corner, seed)
    return Observation('x', RIG, np.rint((clean(angle) + noise) / step) * step, LOADS)


@pytest.mark.parametrize('corner', [0.5, 2.0, 10.0, 50.0])
def test_the_corner_is_that_of_the_noise(corner: float) -> None:
    parts = [flicker(6000, PERIOD, corner, seed).T for seed in (1, 2)]
    found = corners_of(parts, [PERIOD, PERIOD])
    assert found == pytest.approx(np.full(6, corner), rel=0.45)
    assert np.median(found) == pytest.approx(corner, rel=0.25)


def test_white_noise_has_no_corner_that_matters() -> None:
    white = [np.random.default_rng(seed).normal(size=(6, 6000)) for seed in range(20)]
    found = [corners_of([rows], [PERIOD]).max() for rows in white]
    assert np.mean(np.array(found) == 0.0) > 0.5
    assert max(found) < 0.2


def test_slow_noise_without_light_is_not_electronic() -> None:
    rows = flicker(6000, PERIOD, 5.0, 1).T
    rows[[2, 5]] = np.random.default_rng(2).normal(size=(2, 6000))
    assert corners_of([rows], [PERIOD]).max() < 0.2
    # One light alone moves, or the positions do not.
    rows[2] = flicker(6000, PERIOD, 5.0, 3, 1)[:, 0]
    assert corners_of([rows], [PERIOD]).max() < 0.2
    quiet = np.random.default_rng(4).normal(size=(6, 6000))
    quiet[[2, 5]] = flicker(6000, PERIOD, 5.0, 5, 2).T
    assert corners_of([quiet], [PERIOD]).max() < 0.3


def test_slow_noise_of_a_channel_is_at_most_that_of_the_light() -> None:
    rows = flicker(6000, PERIOD, 2.0, 1).T
    usual = corners_of([rows], [PERIOD])
    rows[0] += 3.0 * np.sin(np.arange(6000) / 400.0)
    found = corners_of([rows], [PERIOD])
    assert found[0] <= 1.3 * usual[[2, 5]].min()
    assert found[1:].tolist() == usual[1:].tolist()


def test_outliers_and_lost_samples_make_no_corner() -> None:
    rows = np.random.default_rng(1).normal(size=(6, 6000))
    rows[:, ::97] += 300.0
    rows[:, 2000:2600] = 0.0
    assert corners_of([rows], [PERIOD]).max() < 0.2
    # Of fewer than 64 values nothing is told.
    few = np.zeros((6, 6000))
    few[:, :63] = 9.0
    assert not corners_of([few], [PERIOD]).any()


def test_whitening_is_its_own_adjoint_and_is_undone() -> None:
    slow = SlowNoise.of(np.array([0.0, 0.5, 1.0, 2.0, 10.0, 50.0]), 500, PERIOD)
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 6, 500))
    np.testing.assert_allclose((slow.whiten(a) * b).sum(axis=1), (a * slow.whiten(b)).sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(slow.unwhiten(slow.whiten(a)), a, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(slow.whiten(a)[0], a[0], rtol=1e-12)


def test_cosine_is_weakened_by_root_of_density() -> None:
    n, k = 500, 30
    f = 0.5 * k / (n * PERIOD)
    wave = np.cos(np.pi * k * (np.arange(n) + 0.5) / n) * np.ones((6, 1))
    white = SlowNoise.of(np.full(6, 3.0), n, PERIOD).whiten(wave)
    np.testing.assert_allclose(white, wave / np.sqrt(1.0 + 3.0 / f), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize('corner', [1.0, 10.0])
def test_the_mean_of_a_block_is_as_uncertain_as_the_formula_says(corner: float) -> None:
    rows = np.concatenate([flicker(6000, PERIOD, corner, seed).T for seed in range(8)])
    rows -= rows.mean(axis=1, keepdims=True)
    blocks = rows.reshape(len(rows), 1200, 5).mean(axis=2)
    factor = block_factor(24.0, 0.02, np.array([corner]))[0]
    assert 5.0 * (blocks**2).mean() == pytest.approx(factor, rel=0.15)


def model(corners: FloatArray) -> NoiseModel:
    one = np.ones(6)
    plain = NoiseModel(one, np.zeros((6, 2)), 2.0 * one, 0.5 * one, 3.0, (False,) * 6)
    return plain.with_slow_noise(corners, 1000, PERIOD, 0.02)


def test_noise_model_whitens_by_both_and_keeps_gaps() -> None:
    slow = model(np.full(6, 3.0))
    assert slow.slow is not None
    assert slow.block_sigma == pytest.approx(0.5 * np.sqrt(block_factor(4.0, 0.02, np.full(6, 3.0))))
    rows, count = np.random.default_rng(1).normal(size=(6, 1000)), np.ones((6, 1000))
    np.testing.assert_allclose(slow.whiten(rows, count), slow.slow.whiten(rows / 2.0), rtol=1e-9)
    count[3, 100:200] = 0.0
    gone = slow.whiten(np.where(count > 0.0, rows, 0.0), count)
    assert not gone[3, 100:200].any()
    assert gone[3, 200:].all()
    change = np.cos(np.arange(1000) / 80.0) * np.ones((6, 1))
    np.testing.assert_allclose(
        slow.of_slow_change(slow.whiten(change, np.ones((6, 1000)))), change, rtol=1e-6, atol=1e-9
    )


def test_corners_within_a_fifth_are_alike() -> None:
    some = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert model(some).like(model(1.15 * some))
    assert not model(some).like(model(1.3 * some))
    assert not model(some).like(model(np.zeros(6)))
    assert not model(some).like(dataclasses.replace(model(some), coloured=(True,) * 6))
    assert not model(some).like(dataclasses.replace(model(some), innovation=2.1 * np.ones(6)))
    assert model(np.zeros(6)).slow is None


def test_workspace_reports_slow_noise_of_recording() -> None:
    ws = Workspace([observed(5.0, 1)])
    (reported,) = ws.provenance()
    assert reported['corners_hz'] == ws.noise[0].corners.tolist()
    assert ws.noise[0].corners == pytest.approx(np.full(6, 5.0), rel=0.4)
    plain = Workspace([observed(0.0, 1)])
    assert ws.floor() > 1.2 * plain.floor()
    residual, _ = ws.residual(())
    assert float(residual @ residual) / ws.size == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize('corner', [0.3, 1.0, 5.0, 30.0])
def test_nothing_is_missing_from_slow_noise(corner: float) -> None:
    found = discover([observed(corner, 1)])
    assert found.verdict == 'nothing_missing'
    assert not found.setup


@pytest.mark.slow
def test_an_effect_beside_slow_noise_is_named_and_its_sd_covers() -> None:
    off = []
    for seed in range(6):
        found = discover([observed(5.0, seed, angle=0.002)])
        assert [e.active.effect.name for e in found.effects] == ['sensor_rotation']
        assert found.verdict == 'effects_found'
        off.append((found.effects[0].active.values['angle'] - 0.002) / found.effects[0].sd['angle'])
    assert np.sqrt(np.mean(np.square(off))) < 1.8
    assert np.sqrt(np.mean(np.square(off))) > 0.3
