# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The offset between the clocks: right, as sure as it says, and not told if the motion does not tell it."""

from __future__ import annotations

import numpy as np
import pytest

from blind.clock import ClockRecording, dots, scored, simulated
from blind.clock import motion_of as motion_of_samples
from blind.generator import Array
from psd_deflection.studies.validate.clock import clock_offset
from psd_deflection.studies.validate.motion import Motion


def motion_of(run: ClockRecording, kept: Array | None = None) -> Motion:
    index = np.arange(len(run.t)) if kept is None else np.flatnonzero(kept)
    return motion_of_samples(run.t[index], run.dots[index])


@pytest.mark.slow
def test_intervals_hold_the_truth() -> None:
    """`python -m blind.clock` has the figures of 200 runs. At 95 %, fewer than 35 of 40 are one case in 2000."""
    score = scored(range(40))
    assert score.reported == 40
    assert score.inside >= 35
    assert max(map(abs, score.errors)) < 0.5e-3


def test_scale_turn_and_bias_of_the_reference_do_not_matter() -> None:
    run = simulated(3)
    rotated = run.poses @ np.array([[1.02, 0.03, 0.0], [-0.03, 0.97, 0.0], [0.0, 0.0, 1.1]]) + [1e-3, -2e-3, 0.05]
    found = clock_offset(motion_of(run), run.stamps, rotated, exposure=0.008)
    assert abs(found.value - run.offset) < 4.0 * found.sd < 0.4e-3


def test_outliers_do_not_move_it() -> None:
    run = simulated(4)
    rng = np.random.default_rng(0)
    bad = rng.random(len(run.poses)) < 0.1
    run.poses[bad] += rng.normal(0.0, [2e-3, 2e-3, 0.02], (int(bad.sum()), 3))
    found = clock_offset(motion_of(run), run.stamps, run.poses, exposure=0.008)
    assert abs(found.value - run.offset) < 4.0 * found.sd < 0.6e-3


def test_a_drift_is_found() -> None:
    run = simulated(6, seconds=20.0, steps=(1.0, 6.0, 11.0, 17.0))
    middle = float(run.stamps.mean())
    drifting = run.stamps - 200e-6 * (run.stamps - middle)
    found = clock_offset(motion_of(run), drifting, run.poses, exposure=0.008)
    assert found.drift == pytest.approx(200e-6, abs=4.0 * found.drift_sd)
    assert 'drifts by' in found.sentence


def test_clocks_that_count_from_different_days() -> None:
    run = simulated(7)
    found = clock_offset(motion_of(run), run.stamps + 1.7e9, run.poses, exposure=0.008)
    assert found.value == pytest.approx(run.offset - 1.7e9, abs=0.3e-3)
    assert found.determined


def test_a_link_at_rest_gives_nothing() -> None:
    run = simulated(8, steps=())
    found = clock_offset(motion_of(run), run.stamps, run.poses)
    assert not found.determined
    assert 'moves too little' in found.sentence


def test_a_motion_that_repeats_has_rivals() -> None:
    run = simulated(9)
    t = run.t
    steady = np.column_stack([1e-3 * np.sin(2 * np.pi * 5.0 * t), np.zeros((len(t), 2))])
    motion = motion_of_samples(t, dots(steady))
    noise = np.random.default_rng(0).normal(0.0, [10e-6, 10e-6, 3e-4], run.poses.shape)
    at = run.stamps + run.offset
    poses = np.column_stack([1e-3 * np.sin(2 * np.pi * 5.0 * at), np.zeros((len(at), 2))]) + noise
    found = clock_offset(motion, at, poses)
    assert not found.determined
    assert any(abs(abs(r - found.value) - 0.2) < 2e-3 for r in found.alternatives)
    assert 'repeats itself' in found.sentence
