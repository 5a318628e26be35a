# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The filter: its tables beside a Kalman filter, covariances beside sums over its gains, loads acting unseen."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from blind import motion
from psd_deflection.measure.motion.inertia import Inertia
from psd_deflection.measure.motion.modal import BlockTables, KnownLoads, Oscillator, joined_ns, split_ns
from psd_deflection.measure.motion.motion import ModalFilter, TipState
from psd_deflection.measure.motion.unseen import LARGER, Innovations, UnseenLoads
from psd_deflection.records import AppliedLoad, BaseAcceleration, FloatArray

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


def after(modal: ModalFilter, blocks: list[FloatArray]) -> TipState:
    """The motion at the end of ``blocks`` (N, 3) of poses, of which nothing was known before."""
    modal.forget()
    for k, poses in enumerate(blocks):
        state = modal.block(k, 20 * MS * k, SLOTS, poses)
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


@pytest.mark.parametrize('count', [1, 2])
def test_axis_covariance_is_noise_through_gains(count: int) -> None:
    modal, (pose, velocity) = linear(), np.zeros((2, count, 3, N))
    for block in range(count):
        for axis in range(3):
            for sample in range(N):
                blocks = [np.zeros((N, 3)) for _ in range(count)]
                blocks[block][sample, axis] = 1.0
                state = after(modal, blocks)
                pose[block, axis, sample], velocity[block, axis, sample] = state.pose[axis], state.velocity[axis]
    state = after(modal, [np.zeros((N, 3))] * count)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        noise = noise_of_poses(a, b)
        both = [sum(float(g[a] @ noise @ g[b]) for g in gains) for gains in (pose, velocity)]
        blocks_of = [state.covariance[a, b], state.velocity_covariance[a, b]]
        np.testing.assert_allclose(blocks_of, both, rtol=1e-9)
        assert state.covariance[b, a] == state.covariance[a, b]
        assert state.velocity_covariance[b, a] == state.velocity_covariance[a, b]


def test_what_is_said_ahead_has_the_time_of_then() -> None:
    state = of(filter_ahead=1.0).block(0, 5, SLOTS, np.zeros((N, 3)))
    assert state is not None
    assert state.t_ns == 5 + 1_009_500_000


def test_acceleration_after_block_moves_nothing_before() -> None:
    modal = linear()
    modal.block(0, 0, SLOTS, np.zeros((N, 3)))
    still = modal.predicted(np.array([0.005]))
    # The last sample is 9.5 ms after the middle.
    modal.inertia.notify(BaseAcceleration(14 * MS + MS // 2, (5.0, 0.0, 0.0), NONE), 10 * MS)
    reported = modal.predicted(np.array([0.005, 0.006]))
    assert np.array_equal(reported.pose[0], still.pose[0])
    # From rest: half of the acceleration times the square of the time.
    assert reported.pose[1, 0] == pytest.approx(-0.5 * 5.0 * 0.001**2, rel=0.01)


def test_a_base_that_is_reported_is_no_load_that_nobody_foresaw() -> None:
    modal = of()
    mode = Oscillator(14.0, 0.02)
    base = Inertia((mode, mode, Oscillator(21.0, 0.02)), 0.585)
    for k in range(40):
        reported = BaseAcceleration(10 * MS * k + 200 * MS, (2.0 * np.sin(0.7 * k), 0.0, 0.0), NONE)
        base.notify(reported, 10 * MS * k + 200 * MS)
        modal.inertia.notify(reported, 10 * MS * k + 200 * MS)
    moved = base.forced(-10 * MS - MS // 2, 1e-3 * np.arange(1.0, 601.0)).at[:, :, 0].T
    for k in range(30):
        modal.block(k, 20 * MS * k, SLOTS, moved[N * k : N * (k + 1)])
    assert np.abs(moved).max() > 2e-4
    # Private: what a load did unseen is added to variances 1e4 times as large.
    assert modal._unseen is not None
    assert np.sqrt(modal._unseen.variances[0].max()) < 1e-6


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
        state = gains.transition[0, k] @ (x + posterior @ score) + gains.smoothed[0, k] @ (miss + gains.observed[0] @ x)
        covariance = gains.transition[0, k] @ posterior @ gains.transition[0, k].T + gains.residual[0, k]
        squares = miss @ gains.precision[0, k] @ miss - score @ posterior @ score
        size = gains.log_size[0, k] + np.linalg.slogdet(p)[1] - np.linalg.slogdet(posterior)[1]
        np.testing.assert_allclose(state, expected[0], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(covariance, expected[1], rtol=1e-5, atol=1e-18)
        assert squares == pytest.approx(expected[2], rel=1e-6)
        assert size == pytest.approx(expected[3], abs=1e-6)


def test_filter_weighs_rates_by_how_well_they_predict() -> None:
    """Bayes' rule over 23 Kalman filters, 13 of a load that steps and 10 of one whose rate wanders; their mixture."""
    r = 1e-4
    modal = ModalFilter(motion.rig_of({}), COMPLIANCE, np.eye(3, 4), r * np.eye(4)[:, :, None] * (SLOTS == 0))
    sizes = r / 0.02 * 1e-4 * 10.0 ** np.arange(13)
    rates = [np.array([q, 0.0]) for q in sizes] + [np.array([0.0, q / (MODE.w * 0.02) ** 2]) for q in sizes[:10]]
    change = np.full((23, 23), 0.01 / 23)
    for k in range(23):
        first, last = (0, 12) if k < 13 else (13, 22)
        change[k, k] += 0.95
        change[k, max(k - 1, first)] += 0.03
        change[k, min(k + 1, last)] += 0.01
    x, p, weights = np.zeros(4), np.eye(4), np.full(23, 1.0 / 23)
    for block, y in enumerate(np.random.default_rng(4).normal([[0.0], [0.0], [0.03], [0.02]], 0.01, (4, N))):
        states = [by_samples(y, list(SLOTS), x, p, rate, r) for rate in rates]
        weights = weights @ change * np.exp([-0.5 * (squares + size - states[0][3]) for *_, squares, size in states])
        weights /= weights.sum()
        x = sum(w * f[0] for w, f in zip(weights, states, strict=True))
        p = sum(w * (f[1] + np.outer(f[0] - x, f[0] - x)) for w, f in zip(weights, states, strict=True))
        state = modal.block(block, 20 * MS * block, SLOTS, np.column_stack([y, y, y]))
        assert state is not None
        got = [state.pose[0], state.velocity[0], state.covariance[0, 0], state.velocity_covariance[0, 0]]
        np.testing.assert_allclose(got, [x[0], MODE.w * x[1], p[0, 0], MODE.w**2 * p[1, 1]], rtol=1e-6)
    random_walk = math.sqrt(sum(w * rate[0] for w, rate in zip(weights, rates, strict=True)))
    assert modal.load_walk()[0] == pytest.approx(random_walk / COMPLIANCE[0], rel=1e-6)


def test_known_load_acts_from_its_stamp_on() -> None:
    """A step response by the matrix exponential; 5 % of what it adds is doubted; the next block's load waits."""
    known = KnownLoads((MODE, MODE, MODE), np.array(COMPLIANCE), N, PERIOD)
    loads = [
        AppliedLoad(t_ns, *force) for t_ns, force in ((0, NONE), (5 * MS, (2.0, 0.0, -3.0)), (50 * MS, (1.0, 0.0, 0.0)))
    ]
    for load in loads:
        known.add(load)
    assert [known.is_new(load) for load in loads] == [True, True, False]
    # Samples from 0.5 to 19.5 ms; the first load began before.
    push = known.pushed(10 * MS, first=False)
    assert push is not None
    size = np.array(COMPLIANCE) * [2.0, 0.0, -3.0]
    effective = [expm(system(MODE) * (t - 5e-3))[:, 2] if t > 5e-3 else np.zeros(4) for t in PERIOD * (SLOTS + 0.5)]
    np.testing.assert_allclose(push.samples, size[:, None] * [state[0] for state in effective], atol=1e-15)
    np.testing.assert_allclose(push.end, size[:, None] * effective[-1], atol=1e-15)
    np.testing.assert_allclose(push.variance, (0.05 * size) ** 2)
    assert known.is_new(loads[1])
    assert not known.is_new(loads[2])


def test_known_loads_are_four_numbers_and_five_each() -> None:
    known = KnownLoads((MODE, MODE, MODE), np.array(COMPLIANCE), N, PERIOD)
    values = (1.0, 2.0, 3.0, 4.0, 1.0, 5.0, 6.0, 7.0, 8.0)
    known.load_state('loads', values)
    assert known.state() == (values[:4], [*values[4:]])
    for wrong in (3, 5, 8):
        with pytest.raises(ValueError, match='loads'):
            known.load_state('loads', values[:wrong])


@pytest.mark.parametrize('t_ns', [0, 999_999_999, 1_700_000_000_999_999_999])
def test_a_time_in_two_numbers_is_exact(t_ns: int) -> None:
    assert split_ns(t_ns) == (t_ns // 10**9, t_ns % 10**9)
    assert joined_ns(*split_ns(t_ns)) == t_ns


def test_innovations_have_the_band_of_their_chi_square() -> None:
    later = Innovations((10.0, 220.0, 200.0), 200)
    assert later.since(Innovations()) == later
    assert later.since(Innovations((5.0, 20.0, 0.0), 100)).means() == (0.05, 2.0, 2.0)
    # A sample's has the variance 2.
    assert later.band(2.0) == pytest.approx((0.8, 1.2))
    assert Innovations().band(2.0)[0] == 0.0


MODES = (Oscillator(14.0, 0.02), Oscillator(21.0, 0.05))
SECONDS = 0.02
NO_NOISE = np.zeros((2, 2))
SURE = np.zeros((2, 4, 4))


def at_rest(at: float) -> np.ndarray:
    """The state of two axes that rest under a load."""
    return np.array([[at, 0.0, at, 0.0], [0.0] * 4])


def unseen() -> UnseenLoads:
    return UnseenLoads(MODES, SECONDS, 0.5)


def test_a_switched_load_is_held_for_each_span_that_missed_it() -> None:
    held = unseen()
    for _ in range(3):
        held.add(at_rest(0.0), SURE, NO_NOISE)
    assert not held.variances.any()
    held.add(at_rest(1e-3), SURE, NO_NOISE)
    # Spans of 1, 2 and 3 blocks end there and predicted rest; longer ones have not begun.
    expected = LARGER**2 * 1e-6 / 9.0
    np.testing.assert_allclose(held.variances[0, :3], expected * np.array([1.0, 0.0, 1.0, 0.0]) * np.ones((3, 1)))
    assert not held.variances[:, 3:].any()
    assert not held.variances[1].any()


def test_what_the_process_noise_foresaw_is_not_added() -> None:
    held = unseen()
    wide = np.tile(np.diag([4e-8, 0.0, 1e-8, 0.0]), (2, 1, 1))
    rate = np.full((2, 2), 1e-9)
    held.add(at_rest(0.0), wide, rate)
    held.add(at_rest(1e-3), wide, rate)
    mode = MODES[0]
    phi = mode.step(SECONDS)
    foreseen = phi @ wide[0] @ phi.T + 1e-9 * mode.added_covariance(np.array([SECONDS]))[0].sum(axis=0)
    expected = LARGER**2 * np.maximum(np.array([1e-6, 0.0, 1e-6, 0.0]) / 9.0 - foreseen.diagonal(), 0.0)
    assert 0.0 < expected[0] < 0.9 * LARGER**2 * 1e-6 / 9.0
    np.testing.assert_allclose(held.variances[0, 0], expected, rtol=1e-12)


def test_it_grows_evenly_from_span_to_span() -> None:
    held = unseen()
    count = held.variances.shape[1]
    # Spans of 1, 2, 3, 4, 6, 9, 13, 19 and 28 blocks.
    assert count == 9
    held.variances[:] = np.arange(1.0, count + 1.0)[:, None]
    assert held.after(0.005)[0, 0] == pytest.approx(0.25)
    assert held.after(SECONDS)[0, 0] == pytest.approx(1.0)
    assert held.after(5 * SECONDS)[1, 2] == pytest.approx(4.5)
    assert held.after(28 * SECONDS)[0, 0] == pytest.approx(9.0)
    assert held.after(10.0)[0, 3] == pytest.approx(9.0)
