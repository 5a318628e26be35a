# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Slow noise, the noise of a zero, and parameters that nothing determines are no effect."""

import dataclasses
import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from psd_deflection.measure.pipeline import ZERO_BLOCKS, zero_variances
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import catalogue, effects_of_rig
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.simulator import ForwardModel, RigSimulator
from psd_deflection.recordings.observation import Observation
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import zero_variances_at_end
from psd_deflection.records import DOT_CHANNELS, FloatArray, ParameterChange
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.noise import NoiseModel, SlowNoise, block_factor, corners_of
from psd_deflection.studies.discover.recorded import Recorded, with_free
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.workspace import Workspace

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
@pytest.mark.parametrize('corner', [0.3, 5.0])
def test_nothing_is_missing_from_slow_noise(corner: float) -> None:
    found = discover([observed(corner, 1)])
    assert found.verdict == 'nothing_missing'
    assert not found.setup


BAG = Path(__file__).parents[3] / 'bags' / 'clean'
ZERO_LOADS = np.repeat(
    np.array([(0, 0, 0), (0, -20, 0), (0, -50, -29), (30, 0, 0), (20, -40, 12), (0, 0, 0)], float), 6000, axis=0
)
ZERO = zero_variances(RIG)
OFF = np.sqrt(ZERO) * [0.3, -1.1, 1.6, -0.8]
"""An error that such a zero has."""


def recorded(*, taken: bool, rotated: float = 0.0) -> Observation:
    """A recording with a zero that is off, ``taken`` in it or not, of a rig with a detector ``rotated``, rad."""
    true = {'effects.e.name': 'sensor_rotation', 'effects.e.psd': 1, 'effects.e.angle': rotated} if rotated else {}
    volts = RigSimulator(replace_values(RIG, true), 3).step(ZERO_LOADS).counts * RIG.converter.volts_per_count
    zeros = {f'psd_{i + 1}.zero': OFF[2 * i : 2 * i + 2].tolist() for i in range(2)}
    o = Observation('x', replace_values(RIG, zeros), np.asarray(volts, dtype=np.float64), ZERO_LOADS)
    return replace(o, zero_variances=ZERO) if taken else o


@pytest.fixture(scope='module')
def faultless() -> Discovery:
    return discover([recorded(taken=True)])


@pytest.mark.slow
def test_residual_of_noisy_zero_is_nothing_unknown(faultless: Discovery) -> None:
    assert faultless.verdict == 'nothing_missing'
    assert not faultless.effects
    assert not faultless.unknown


@pytest.mark.slow
def test_the_same_constants_are_reported_if_no_zero_was_taken() -> None:
    found = discover([recorded(taken=False)])
    assert found.effects or found.unknown


def test_a_constant_is_whitened_by_what_the_zero_allows() -> None:
    """One standard deviation of a well seen constant leaves a residual of about one standard deviation of noise."""
    o = recorded(taken=True)
    ws = Workspace([o])
    own = with_free(Recorded((o,), RIG, ()), ws)
    constant = [np.zeros_like(t) for t in ws.measured]
    axis = 3
    constant[0][DOT_CHANNELS[axis]] = np.sqrt(ZERO[axis]) / RIG.sensitivities.ravel()[axis]
    observed = float(np.linalg.norm(ws.whiten(constant)))
    assert observed > 5.0
    assert np.linalg.norm(own.whiten(constant)) == pytest.approx(observed / np.hypot(1.0, observed), rel=1e-9)
    assert not own.free_loads
    assert own.refitted(ws.measured) is own


@pytest.mark.parametrize(
    ('changes', 'variances'),
    [
        ((), ()),
        (({'environment.temperature': 22.0},), ()),
        (({'psd_1.zero': (1e-6, 0.0)},), ZERO),
        (({'psd_2.zero': (1e-6, 0.0), 'state.zero_variances': (1.0, 2.0, 3.0, 4.0)},), (1.0, 2.0, 3.0, 4.0)),
        (({'state.zero_variances': (1.0, 2.0, 3.0, 4.0)}, {'psd_2.zero': (1e-6, 0.0)}), ZERO),
        (({'psd_2.zero': (1e-6, 0.0), 'state.zero_variances': (1.0, 2.0)},), ZERO),
        (({'psd_2.zero': (1e-6, 0.0), 'state.zero_variances': 'x'},), ZERO),
    ],
)
def test_a_recording_says_how_well_its_zero_is_known(
    changes: tuple[dict[str, float | str | tuple[float, ...]], ...],
    variances: tuple[float, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = open_recording(BAG)
    reported = [ParameterChange(0, i, tuple(c.items())) for i, c in enumerate(changes)]
    monkeypatch.setattr(recording, 'changes', reported)
    assert zero_variances_at_end(recording, RIG) == variances


def test_a_zero_that_gives_nothing_is_the_mean_of_half_a_second() -> None:
    per_sample = [s**2 * (n**2 + RIG.converter.volts_per_count**2 / 12) for s, n in _channels()]
    samples = ZERO_BLOCKS * RIG.estimator.block_size
    assert samples == 500
    np.testing.assert_allclose(ZERO, np.array(per_sample) / samples, rtol=1e-12)


def _channels() -> list[tuple[float, float]]:
    return list(zip(RIG.sensitivities.ravel().tolist(), RIG.noises[:, :2].ravel().tolist(), strict=True))


@pytest.mark.parametrize('sideways', [0.0, 3e-15, 1e-5])
def test_a_size_that_hardly_any_load_shows_stays_off(sideways: float) -> None:
    levels = [(0.0, 0.0, 0.0), *((sideways, -w, 0.0) for w in (20.0, 40.0, 10.0, 50.0, 30.0))]
    history = loads.steps(levels, 0.5).loads
    true = replace_values(RIG, {'effects.e.name': 'load_offset', 'effects.e.x': 0.005})
    volts = RigSimulator(true, 3).step(history).counts * RIG.converter.volts_per_count
    workspace = Workspace([Observation('x', RIG, np.asarray(volts, dtype=np.float64), history)], ())
    effect = catalogue()['load_offset']
    found = refit(workspace, [ActiveEffect(effect, {'x': 0.001, 'y': -1.0})])
    (offset,) = found.effects
    assert offset.values['x'] == pytest.approx(0.005, abs=1e-4)
    assert offset.values['y'] == 0.0
    assert not found.at_bound
