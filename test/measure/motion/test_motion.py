# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The filter in the pipeline: against the truth of a generator of its own, without samples, and in a replay."""

from pathlib import Path

import numpy as np
import pytest

from blind import motion
from psd_deflection.base.errors import ConfigError
from psd_deflection.cli.main import main
from psd_deflection.measure.motion.motion import STATE
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import KNOWN_LOAD, AppliedLoad, FloatArray, ParameterChange, RawChunk, TipMotion
from psd_deflection.rig.config import load_rig
from test import streams

RIG = motion.rig_of()


def through(pipeline: Pipeline, run: motion.Run, blocks: range) -> list[TipMotion]:
    return [r for b in blocks for r in pipeline.process(motion.chunk(run, b)) if isinstance(r, TipMotion)]


def truth(run: motion.Run, moved: TipMotion) -> FloatArray:
    return np.asarray(run.pose[round(moved.t_ns / 1e6)])


def pose(moved: TipMotion) -> FloatArray:
    return np.array([moved.dx, moved.dy, moved.theta])


def velocity(moved: TipMotion) -> FloatArray:
    return np.array([moved.vx, moved.vy, moved.vtheta])


@pytest.fixture(scope='module')
def operation() -> motion.Run:
    return motion.make('operation', 8.0, 5)


@pytest.fixture(scope='module')
def evaluated() -> dict[str, motion.Result]:
    # A joint rests most of the time.
    seconds = dict.fromkeys(motion.KINDS, 7.0) | {'joint': 11.0}
    return {kind: motion.evaluate(motion.make(kind, seconds[kind], 2), RIG) for kind in motion.KINDS}


@pytest.mark.slow
@pytest.mark.parametrize('kind', motion.KINDS)
def test_velocity_prediction_and_innovations(kind: str, evaluated: dict[str, motion.Result]) -> None:
    for axis in motion.figures([evaluated[kind]]):
        assert axis.velocity < 0.2 * axis.smoothed
        assert axis.velocity < 1.1 * axis.velocity_sd
        # What is told of a base is a mean over some samples.
        assert (0.90 if kind == 'joint' else 0.92) < axis.inside < 0.98
        assert axis.predicted < 0.5 * axis.held


@pytest.mark.slow
def test_a_lost_laser_is_coasted_through_and_reported(operation: motion.Run) -> None:
    dark = motion.Run(operation.loads, operation.pose, operation.velocity, operation.volts.copy())
    dark.volts[4000:4100, 2] = 0.0
    pipeline = Pipeline(RIG)
    moved = {m.block: m for m in through(pipeline, dark, range(210))}
    assert [moved[b].coasted for b in (199, 200, 204, 205)] == pytest.approx([0.0, 0.02, 0.10, 0.0])
    errors = np.abs([pose(moved[b]) - truth(dark, moved[b]) for b in range(200, 205)])
    deviations = np.sqrt([moved[b].covariance[::4] for b in range(200, 205)])
    assert np.all(errors < 3.0 * deviations)
    assert np.all(np.diff(deviations, axis=0) > 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(('values', 'last'), [({}, 223), ({'filter_coast': 0.2}, 209)])
def test_coasting_ends(operation: motion.Run, values: dict[str, object], last: int) -> None:
    dark = motion.Run(operation.loads, operation.pose, operation.velocity, operation.volts.copy())
    dark.volts[4000:, 2] = 0.0
    pipeline = Pipeline(motion.rig_of(values))
    moved = through(pipeline, dark, range(300))
    assert moved[-1].block == last
    memory = pipeline.snapshot(pipeline.rig)
    assert memory is not None
    assert STATE not in dict(memory.values)


@pytest.mark.slow
def test_ahead_is_the_prediction(operation: motion.Run) -> None:
    now, later = Pipeline(RIG), Pipeline(motion.rig_of({'filter_ahead': 0.005}))
    there = through(later, operation, range(250))[-1]
    here = through(now, operation, range(250))[-1]
    assert there.t_ns == here.t_ns + 5_000_000
    assert now.motion_filter is not None
    predicted = now.motion_filter.predicted(np.array([0.005]))
    np.testing.assert_allclose(pose(there), predicted.pose[0], rtol=1e-9)
    np.testing.assert_allclose(velocity(there), predicted.velocity[0], rtol=1e-9)
    np.testing.assert_allclose(there.covariance[::4], predicted.variance[0], rtol=1e-9)
    assert np.all(np.abs(pose(there) - truth(operation, there)) < 4.0 * np.sqrt(there.covariance[::4]))


@pytest.mark.parametrize('start', [151, 203, 260])
def test_a_recording_begun_at_any_block_replays_to_the_bit(operation: motion.Run, start: int) -> None:
    dark = motion.Run(operation.loads, operation.pose, operation.velocity, operation.volts.copy())
    dark.volts[4000:4100, 2] = 0.0
    live = Pipeline(RIG)
    live.load(AppliedLoad(0, 0.0, 0.0, 0.0))
    live.load(AppliedLoad(5_303_000_000, 3.0, 0.0, 0.0))
    through(live, dark, range(start))
    memory = live.snapshot(RIG)
    assert memory is not None
    expected = through(live, dark, range(start, 300))
    replay = Pipeline(RIG)
    replay.apply(memory)
    assert through(replay, dark, range(start, 300)) == expected
    without = Pipeline(RIG)
    without.apply(streams.without(memory, STATE))
    assert through(without, dark, range(start, 300)) != expected


@pytest.mark.slow
def test_a_restart_begins_anew(operation: motion.Run) -> None:
    pipeline = Pipeline(RIG)
    through(pipeline, operation, range(200))
    late = motion.chunk(operation, 200)
    later = RawChunk(late.seq + 20, late.t_ns + 300_000_000, late.readings, late.flags)
    tip = [r for r in pipeline.process(later) if isinstance(r, TipMotion)][-1]
    assert pipeline.motion_filter is not None
    assert pipeline.motion_filter.predictions_only == 0
    assert np.all(np.abs(pose(tip) - operation.pose[4019]) < 5.0 * np.sqrt(tip.covariance[::4]))


def test_no_filter_no_motion_and_a_long_block_is_rejected(operation: motion.Run) -> None:
    pipeline = Pipeline(load_rig())
    assert pipeline.motion_filter is None
    assert pipeline.load(AppliedLoad(0, 1.0, 0.0, 0.0)) is None
    assert not through(pipeline, operation, range(5))
    with pytest.raises(ConfigError, match='block_size of 64 at most, not 100'):
        Pipeline(motion.rig_of({'block_size': 100}))


def test_a_load_is_noted_once() -> None:
    pipeline = Pipeline(RIG)
    first = pipeline.load(AppliedLoad(1_700_000_000_123_456_789, 1.0, 0.0, 0.0))
    assert isinstance(first, ParameterChange)
    assert dict(first.values)[KNOWN_LOAD] == (1_700_000_000.0, 123_456_789.0, 1.0, 0.0, 0.0)
    assert pipeline.load(AppliedLoad(1_700_000_001_000_000_000, 1.0, 0.0, 0.0)) is None


@pytest.mark.slow
def test_a_simulated_recording_replays_to_the_bit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text('/**:\n  ros__parameters:\n    filter: modal\n')
    arguments = ['--params-file', str(rig), '--loads', 'steps:0,0,0;0,-10,0.5:1', '--out', str(tmp_path / 'run')]
    assert main(['simulate', *arguments]) == 0
    assert main(['replay', str(tmp_path / 'run'), '--compare', '--strict']) == 0
    assert 'no bit differs' in capsys.readouterr().out
