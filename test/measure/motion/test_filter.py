# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The filter by itself: its covariances against sums over its own gains, and from when on what is told acts."""

from __future__ import annotations

import numpy as np
import pytest

from blind import motion
from psd_deflection.measure.motion.inertia import Inertia
from psd_deflection.measure.motion.modal import Oscillator
from psd_deflection.measure.motion.motion import ModalFilter, TipState
from psd_deflection.records import BaseAcceleration, FloatArray

N, MS = 20, 1_000_000
SLOTS = np.arange(N)
COMPLIANCE = (4e-5, 4e-5, 5e-4)
NONE = (0.0, 0.0, 0.0)
GAIN = np.random.default_rng(0).normal(size=(3, 4))
OWN = np.diag([1e-12, 2e-12, 3e-12, 1e-12])
PASSED_ON = np.random.default_rng(1).normal(size=(4, 4)) * 0.4
"""The noise of the readings is e(t) + PASSED_ON e(t - 1): the next sample of one shows what another had."""
GAMMA = np.zeros((4, 4, N))
GAMMA[:, :, 0] = OWN + PASSED_ON @ OWN @ PASSED_ON.T
GAMMA[:, :, 1] = OWN @ PASSED_ON.T


def of(**changes: object) -> ModalFilter:
    return ModalFilter(motion.rig_of(changes), COMPLIANCE, GAIN, GAMMA)


def linear() -> ModalFilter:
    """With one rate, so that what it finds is linear in the samples."""
    return of(filter_load_walk=[10.0, 10.0, 1.0])


def after(blocks: list[FloatArray]) -> TipState:
    """The motion at the end of ``blocks`` (N, 3) of poses."""
    one = linear()
    for k, poses in enumerate(blocks):
        state = one.block(k, 20 * MS * k, SLOTS, poses)
    assert state is not None
    return state


def noise_of_poses(a: int, b: int) -> FloatArray:
    """(N, N): covariance of the noise of axis ``a`` at one sample with that of axis ``b`` at another, lag by lag."""
    out = np.zeros((N, N))
    for n in range(N):
        for m in range(N):
            of_readings = GAMMA[:, :, m - n] if m >= n else GAMMA[:, :, n - m].T
            out[n, m] = GAIN[a] @ of_readings @ GAIN[b]
    return out


@pytest.mark.slow
@pytest.mark.parametrize('count', [1, 2])
def test_axis_covariance_is_noise_through_gains(count: int) -> None:
    pose, velocity = np.zeros((2, count, 3, N))
    for block in range(count):
        for axis in range(3):
            for sample in range(N):
                blocks = [np.zeros((N, 3)) for _ in range(count)]
                blocks[block][sample, axis] = 1.0
                state = after(blocks)
                pose[block, axis, sample], velocity[block, axis, sample] = state.pose[axis], state.velocity[axis]
    state = after([np.zeros((N, 3))] * count)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        noise = noise_of_poses(a, b)
        both = [sum(float(g[a] @ noise @ g[b]) for g in gains) for gains in (pose, velocity)]
        found = [state.covariance[a, b], state.velocity_covariance[a, b]]
        np.testing.assert_allclose(found, both, rtol=1e-9)
        assert state.covariance[b, a] == state.covariance[a, b]
        assert state.velocity_covariance[b, a] == state.velocity_covariance[a, b]


def test_acceleration_after_block_moves_nothing_before() -> None:
    one = linear()
    one.block(0, 0, SLOTS, np.zeros((N, 3)))
    still = one.predicted(np.array([0.005]))
    # The last sample is 9.5 ms after the middle.
    one.inertia.notify(BaseAcceleration(14 * MS + MS // 2, (5.0, 0.0, 0.0), NONE), 10 * MS)
    reported = one.predicted(np.array([0.005, 0.006]))
    assert np.array_equal(reported.pose[0], still.pose[0])
    # From rest: half of the acceleration times the square of the time.
    assert reported.pose[1, 0] == pytest.approx(-0.5 * 5.0 * 0.001**2, rel=0.01)


def test_a_base_that_is_reported_is_no_load_that_nobody_foresaw() -> None:
    one = of()
    mode = Oscillator(14.0, 0.02)
    base = Inertia((mode, mode, Oscillator(21.0, 0.02)), 0.585)
    for k in range(40):
        reported = BaseAcceleration(10 * MS * k + 200 * MS, (2.0 * np.sin(0.7 * k), 0.0, 0.0), NONE)
        base.notify(reported, 10 * MS * k + 200 * MS)
        one.inertia.notify(reported, 10 * MS * k + 200 * MS)
    moved = base.forced(-10 * MS - MS // 2, 1e-3 * np.arange(1.0, 601.0)).at[:, :, 0].T
    for k in range(30):
        one.block(k, 20 * MS * k, SLOTS, moved[N * k : N * (k + 1)])
    assert np.abs(moved).max() > 2e-4
    # Private: what a load did unseen is added to variances 1e4 times as large.
    assert one._unseen is not None
    assert np.sqrt(one._unseen.variances[0].max()) < 1e-6
