# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The offset between the clocks: right, as sure as it says; its pieces against sums by hand, integrals and scipy."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import median_abs_deviation

from blind.clock import ClockRecording, scored, simulated
from blind.clock import motion_of as motion_of_samples
from blind.generator import Array, flat_dots
from psd_deflection.base.errors import RecordingError
from psd_deflection.records import FloatArray
from psd_deflection.studies.validate import clock
from psd_deflection.studies.validate.clock import (
    Motion,
    Offset,
    OffsetFit,
    UsedReferences,
    biweight_sum,
    clock_offset,
    coarse_offsets,
    refined_offset,
)


def motion_of(run: ClockRecording, present: Array | None = None) -> Motion:
    index = np.arange(len(run.t)) if present is None else np.flatnonzero(present)
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
    offset = clock_offset(motion_of(run), run.stamps, rotated, exposure=0.008)
    assert abs(offset.value - run.offset) < 4.0 * offset.sd < 0.4e-3


def test_outliers_do_not_move_it() -> None:
    run = simulated(4)
    rng = np.random.default_rng(0)
    bad = rng.random(len(run.poses)) < 0.1
    run.poses[bad] += rng.normal(0.0, [2e-3, 2e-3, 0.02], (int(bad.sum()), 3))
    offset = clock_offset(motion_of(run), run.stamps, run.poses, exposure=0.008)
    assert abs(offset.value - run.offset) < 4.0 * offset.sd < 0.6e-3


def test_a_drift_is_found() -> None:
    run = simulated(6, seconds=20.0, steps=(1.0, 6.0, 11.0, 17.0))
    middle = float(run.stamps.mean())
    drifting = run.stamps - 200e-6 * (run.stamps - middle)
    offset = clock_offset(motion_of(run), drifting, run.poses, exposure=0.008)
    assert offset.drift == pytest.approx(200e-6, abs=4.0 * offset.drift_sd)
    assert 'drifts by' in offset.sentence


def test_clocks_that_count_from_different_days() -> None:
    run = simulated(7)
    offset = clock_offset(motion_of(run), run.stamps + 1.7e9, run.poses, exposure=0.008)
    assert offset.value == pytest.approx(run.offset - 1.7e9, abs=0.3e-3)
    assert offset.determined


def test_a_link_at_rest_gives_nothing() -> None:
    run = simulated(8, steps=())
    offset = clock_offset(motion_of(run), run.stamps, run.poses)
    assert not offset.determined
    assert 'moves too little' in offset.sentence


def test_a_motion_that_repeats_has_rivals() -> None:
    run = simulated(9)
    t = run.t
    steady = np.column_stack([1e-3 * np.sin(2 * np.pi * 5.0 * t), np.zeros((len(t), 2))])
    motion = motion_of_samples(t, flat_dots(steady))
    noise = np.random.default_rng(0).normal(0.0, [10e-6, 10e-6, 3e-4], run.poses.shape)
    at = run.stamps + run.offset
    poses = np.column_stack([1e-3 * np.sin(2 * np.pi * 5.0 * at), np.zeros((len(at), 2))]) + noise
    offset = clock_offset(motion, at, poses)
    assert not offset.determined
    assert any(abs(abs(r - offset.value) - 0.2) < 2e-3 for r in offset.alternatives)
    assert 'repeats itself' in offset.sentence


AnyArray = npt.NDArray[Any]


def first_three(dots: FloatArray) -> FloatArray:
    poses: FloatArray = dots[:, :3].copy()
    return poses


def of(t: AnyArray, poses: AnyArray, period: float = 1e-3) -> Motion:
    return Motion(t, np.column_stack([poses, np.zeros(len(t))]), period, first_three)


def dense(columns: AnyArray, values: AnyArray, weights: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Weighted least squares: the terms, and their covariance for weights that are inverse variances."""
    normal = columns.T @ (weights[:, None] * columns)
    return np.linalg.solve(normal, columns.T @ (weights * values)), np.linalg.inv(normal)


def test_the_interval_holds_95_percent() -> None:
    assert Offset(0.5, 0.1, 0.0, 0.0, True, (), 100).interval == pytest.approx((0.304, 0.696))
    assert not Offset(0.5, 0.01, 0.0, 0.0, True, (), 100).determined


@pytest.mark.parametrize(
    ('offset', 'words'),
    [
        (
            Offset(0.0123, 1e-3, 0.0, 1e-6, True, (-0.1, 0.25), 100),
            'The offset between the clocks is not determined: the motion repeats itself, so that +12.3 and -100.0, '
            '+250.0 ms fit alike. Record an event that comes once, such as a push or a step of the load.',
        ),
        (
            Offset(0.0123, 1e-3, 0.0, 1e-6, False, (-0.1,), 100),
            'The offset between the clocks is not determined: the link moves too little or too slowly. '
            'Record a few seconds in which it rings.',
        ),
        (
            Offset(0.0019, 1e-3, 0.0, 1e-6, True, (), 100),
            'The clocks agree: the offset is +1.900 ms ± 1.960 ms (95 %).',
        ),
        (
            Offset(0.002, 1e-3, 3.1e-6, 1e-6, True, (), 100),
            "The reference's clock is 2.000 ms ± 1.960 ms (95 %) behind that of the samples: add 2.000 ms to the "
            "reference's stamps. It drifts by +3.1 ± 2.0 µs/s (95 %).",
        ),
        (
            Offset(-0.002, 1e-3, -2.9e-6, 1e-6, True, (), 100),
            "The reference's clock is 2.000 ms ± 1.960 ms (95 %) ahead of that of the samples: subtract 2.000 ms from "
            "the reference's stamps.",
        ),
    ],
)
def test_the_sentence_word_for_word(offset: Offset, words: str) -> None:
    assert offset.sentence == words


def biweight(u: float) -> float:
    """Beaton and Tukey: the influence of u is u (1 - (u / 4.685)^2)^2, beyond 4.685 none."""
    return 2.0 * float(quad(lambda s: s * (1.0 - (s / 4.685) ** 2) ** 2, 0.0, min(abs(u), 4.685))[0])


def test_the_biweight_is_the_integral_of_its_influence() -> None:
    u = [[0.1, -0.5, 3.0], [4.6, 4.7, -60.0]]
    of_each = [sum(biweight(v) for v in row) for row in u]
    assert biweight_sum(np.array(u)) == pytest.approx(0.5 * sum(of_each), rel=1e-9)
    assert biweight_sum(np.array(u[:1])) == pytest.approx(of_each[0], rel=1e-9)


def fit_with(value: float, residual: float, sizes: tuple[float, ...] = (1.0, 1.0, 1.0)) -> OffsetFit:
    """Leaves so much on every axis of 50 references."""
    return OffsetFit(value, 1e-3 + abs(value), 2e-6, 3e-6, np.full((50, 3), residual), np.array(sizes))


def found_of(
    monkeypatch: pytest.MonkeyPatch, fits: Sequence[OffsetFit | None], poses: AnyArray, largest: float = 0.5
) -> tuple[Offset, list[float | None]]:
    """The offset if the refinement gives ``fits``, and the best fit that each was told of. 256 samples a second."""
    reported: list[float | None] = []
    remaining = iter(fits)

    def refined(
        motion: Motion, t: FloatArray, poses: FloatArray, start: float, exposure: float, best: OffsetFit | None
    ) -> OffsetFit | None:
        reported.append(None if best is None else best.value)
        return next(remaining)

    monkeypatch.setattr(clock, 'coarse_offsets', lambda *_: [0.0] * len(fits))
    monkeypatch.setattr(clock, 'refined_offset', refined)
    motion = of(np.arange(512.0) / 256.0, np.zeros((512, 3)), 1.0 / 256.0)
    return clock.offset_near(motion, np.arange(50.0) / 50.0, poses, largest, 0.0), reported


def test_the_best_fit_is_taken_and_its_alternatives_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    """On 150 numbers what is left of 0.1 is a chi-square of 1.5, and sqrt(0.01 + x / 150) is one of x more."""
    fits = [
        fit_with(0.3, np.sqrt(0.01 + 19.0 / 150.0)),
        None,
        fit_with(0.1, 0.1),
        # Within five samples it is the same offset.
        fit_with(0.1 + 4.9 / 256.0, 0.1),
        fit_with(0.1 - 4.9 / 256.0, 0.1),
        fit_with(0.1 + 5.1 / 256.0, 0.2),
        fit_with(0.1 - 5.1 / 256.0, 0.2),
        fit_with(-0.2, np.sqrt(0.01 + 22.0 / 150.0)),
        # Beyond what is looked for, but for five samples; it would be better.
        fit_with(0.5 + 5.1 / 256.0, 0.0),
        fit_with(-0.5 - 5.1 / 256.0, 0.0),
        fit_with(0.5 + 4.9 / 256.0, 0.3),
        fit_with(-0.5 - 4.9 / 256.0, 0.3),
    ]
    offset, reported = found_of(monkeypatch, fits, np.zeros((50, 3)))
    assert (offset.value, offset.sd, offset.drift, offset.drift_sd) == (0.1, 0.101, 2e-6, 3e-6)
    assert offset.used == 50
    places = (0.3, 0.1 + 5.1 / 256.0, 0.1 - 5.1 / 256.0, 0.5 + 4.9 / 256.0, -0.5 - 4.9 / 256.0)
    assert offset.alternatives == pytest.approx(places)
    assert reported == [None, 0.3, 0.3, *[0.1] * 9]


@pytest.mark.parametrize(('level', 'explained'), [(101.0, True), (99.0, False)])
def test_a_motion_explains_what_lowers_chi_square_by_100(
    monkeypatch: pytest.MonkeyPatch, level: float, explained: bool
) -> None:
    """References that are as far below as above their middle on two axes, 100 numbers, and a fit that leaves 0.1."""
    size = brentq(lambda u: 100.0 * biweight(u) - 150.0 * biweight(0.1) - level, 0.0, 4.0)
    poses = 7.0 + np.outer(np.resize([-size, size], 50), [2.0, 2.0, 0.0])
    offset, _ = found_of(monkeypatch, [fit_with(0.1, 0.2, (2.0, 2.0, 2.0))], poses)
    assert offset.explained is explained


def test_without_a_fit_there_is_no_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RecordingError, match=r'fewer than 20 of the references .* at any offset up to 0\.5 s'):
        found_of(monkeypatch, [None, fit_with(0.6, 0.1)], np.zeros((50, 3)))


def coarse_by_hand(poses: AnyArray, there: AnyArray, place: AnyArray, reference: AnyArray, reach: int) -> list[int]:
    """Lag by lag, reference by reference: the five lowest minima, five samples apart at least."""
    lags = list(range(-reach, reach + 1))
    inside = [[p + lag for p in place if 0 <= p + lag < len(poses) and there[p + lag]] for lag in lags]
    most = max(map(len, inside))
    cost = np.full(len(lags), np.inf)
    for i, lag in enumerate(lags):
        if len(inside[i]) < 20 or 2 * len(inside[i]) < most:
            continue
        rows = [j for j, p in enumerate(place) if 0 <= p + lag < len(poses) and there[p + lag]]
        cost[i] = 0.0
        for axis in range(3):
            a, b = poses[inside[i], axis], reference[rows, axis]
            if np.ptp(a) > 0.0 and np.ptp(b) > 0.0:
                cost[i] += len(rows) * np.log(1.0 - np.corrcoef(a, b)[0, 1] ** 2)
    lowest = [i for i in range(len(lags)) if np.isfinite(cost[i]) and cost[i] == cost[max(i - 5, 0) : i + 6].min()]
    return [lags[i] for i in sorted(lowest, key=lambda i: cost[i])[:5]]


@pytest.mark.parametrize(
    ('samples', 'first', 'step', 'references', 'reach'),
    [
        (300, 20, 3, 80, 100),
        # A short reference anywhere in a long motion, and the other way about.
        (300, 0, 1, 30, 700),
        (60, -150, 2, 120, 500),
        (60, 400, 2, 120, 600),
        # Exactly as many as are needed.
        (200, 10, 5, 20, 60),
        # Two references fall on one sample.
        (150, 30, 1, 60, 90),
    ],
)
def test_the_first_look_is_a_regression_at_every_lag(
    samples: int, first: int, step: int, references: int, reach: int
) -> None:
    rng = np.random.default_rng(references)
    poses = rng.normal([1e8, 0.0, 50.0], 1.0, (samples, 3))
    poses[:, 1] = 3.0
    there = np.ones(samples, dtype=bool)
    if references > 20:
        there[1:-1] = rng.random(samples - 2) < 0.9
    place: AnyArray = first + step * np.arange(references)
    if samples == 150:
        place = np.sort(np.concatenate([place[::2], place[::2]]))
    reference = rng.normal([1e7, -5.0, 0.0], 1.0, (references, 3))
    at: AnyArray = np.arange(samples)[there]
    motion = of(5.0 + 1e-3 * at, poses[there])
    # Missing samples lie between their neighbours and do not count.
    wanted = coarse_by_hand(poses, there, place, reference, reach)
    assert len(wanted) >= 1
    offsets = coarse_offsets(motion, 5.0 + 1e-3 * (place + 0.3), reference, 1e-3 * (reach - 0.4))
    assert offsets == pytest.approx([1e-3 * lag for lag in wanted])


@pytest.mark.parametrize('sign', [1, -1])
def test_offsets_up_to_the_largest_are_tried_and_no_others(sign: int) -> None:
    poses = np.random.default_rng(0).normal(0.0, 1.0, (400, 3))
    motion = of(np.arange(400) * 1e-3, poses)
    place: AnyArray = 150 + 3 * np.arange(30)

    def first(lag: int) -> float:
        return coarse_offsets(motion, 1e-3 * place, poses[place + sign * lag], 0.04)[0]

    assert first(40) == pytest.approx(0.04 * sign)
    assert first(41) != pytest.approx(0.041 * sign)


@pytest.mark.parametrize(('outliers', 'still'), [(0, True), (6, False)])
def test_step_and_deviations_are_those_of_dense_least_squares(outliers: int, still: bool) -> None:
    rng = np.random.default_rng(3)
    k = 90
    t = np.sort(rng.uniform(-2.0, 3.0, k))
    observed = np.stack([np.sin(7.0 * t), np.cos(5.0 * t), t**2], axis=1)
    rates = np.stack([7.0 * np.cos(7.0 * t), -5.0 * np.sin(5.0 * t), 2.0 * t], axis=1)
    moving = [0, 1, 2]
    if still:
        # An axis at rest has rates of noise alone, which tell nothing.
        observed[:, 1] = 0.1
        rates[:, 1] = rng.normal(0.0, 50.0, k)
        moving = [0, 2]
    matrix = np.array([[1.1, 0.2, -0.3], [0.1, 0.9, 0.4], [-0.2, 0.3, 1.3]])
    poses = (observed + 0.004 * rates * (not still)) @ matrix + [0.1, -0.2, 5.0]
    poses += rng.normal(0.0, [0.01, 0.02, 0.03], (k, 3))
    poses[:outliers] += 4.0
    used, weights = UsedReferences(t, poses, observed, rates), np.ones((k, 3))
    for _ in range(120):
        _, _, weights = used.solved(weights)
    step, fit, again = used.solved(weights)
    np.testing.assert_allclose(again, weights, atol=1e-9)
    causes = np.column_stack([np.ones(k), observed[:, moving]])
    # One bias and one row of scales an axis; the offset moves all three at once.
    columns, residual, sizes = np.zeros((3 * k, 3 * causes.shape[1])), np.empty((k, 3)), np.empty(3)
    does = np.empty(3 * k)
    for axis in range(3):
        rows = slice(axis * k, (axis + 1) * k)
        terms, _ = dense(causes, poses[:, axis], weights[:, axis])
        residual[:, axis] = poses[:, axis] - causes @ terms
        sizes[axis] = median_abs_deviation(residual[:, axis], scale='normal')
        columns[rows, axis * causes.shape[1] : (axis + 1) * causes.shape[1]] = causes
        does[rows] = rates[:, moving] @ terms[1:]
    np.testing.assert_allclose(fit.residual, residual, atol=1e-9)
    np.testing.assert_allclose(fit.sizes, sizes, rtol=1e-3)
    tukey = np.where(np.abs(residual / sizes) < 4.685, (1.0 - (residual / sizes / 4.685) ** 2) ** 2, 0.0)
    np.testing.assert_allclose(weights, tukey, atol=1e-3)
    w = (weights / fit.sizes**2).T.ravel()
    values = poses.T.ravel()
    terms, covariance = dense(np.column_stack([columns, does]), values, w)
    assert step == pytest.approx(terms[-1], rel=1e-6)
    # What the offset and its growth do beside bias and scales.
    slope = does - columns @ dense(columns, does, w)[0]
    ramp = does * np.tile(t, 3)
    ramp -= columns @ dense(columns, ramp, w)[0]
    growth, deviation = dense(np.column_stack([slope, ramp]), residual.T.ravel(), w)
    assert fit.drift == pytest.approx(growth[1], rel=1e-6)
    # No less than that of least squares, and more if what is left has a memory.
    scores = (w * slope * residual.T.ravel()).reshape(3, k).sum(axis=0)
    expected = max(newey_west(scores) * covariance[-1, -1] ** 2, covariance[-1, -1])
    assert fit.sd == pytest.approx(np.sqrt(expected), rel=1e-6)
    rest = ramp - slope * dense(slope[:, None], ramp, w)[0]
    scores = (w * rest * residual.T.ravel()).reshape(3, k).sum(axis=0)
    expected = max(newey_west(scores) * deviation[1, 1] ** 2, deviation[1, 1])
    assert fit.drift_sd == pytest.approx(np.sqrt(expected), rel=1e-6)


def test_a_motion_at_rest_reports_no_step() -> None:
    rng = np.random.default_rng(0)
    poses = rng.normal(0.0, 1.0, (60, 3))
    step, fit, weights = UsedReferences(np.arange(60.0), poses, np.full((60, 3), 0.1), poses).solved(np.ones((60, 3)))
    assert (step, fit.drift) == (0.0, 0.0)
    assert (fit.sd, fit.drift_sd) == (math.inf, math.inf)
    assert weights.max() <= 1.0


def test_references_at_one_time_report_no_drift() -> None:
    rng = np.random.default_rng(0)
    # However slow the motion is, it has a step.
    observed, rates = rng.normal(0.0, 1.0, (60, 3)), rng.normal(0.0, 1e-3, (60, 3))
    _, fit, _ = UsedReferences(np.zeros(60), observed + rng.normal(0.0, 0.1, (60, 3)), observed, rates).solved(
        np.ones((60, 3))
    )
    assert fit.sd < math.inf
    assert (fit.drift, fit.drift_sd) == (0.0, math.inf)


@pytest.mark.parametrize('drift', [1e-5, -2e-5])
def test_an_exact_reference_has_an_exact_drift(drift: float) -> None:
    """Of a motion so slow that bias and scales could do most of what a drift does."""
    t = np.arange(2000.0) * 1e-3
    at = np.linspace(0.1, 1.8, 60)

    def pose(t: FloatArray) -> FloatArray:
        return np.stack([np.sin(9.0 * t), np.cos(14.0 * t), np.sin(4.0 * t + t**2)], axis=1)

    stamps = at - 0.0123 - drift * (at - 0.95)
    fit = refined_offset(of(t, pose(t)), stamps, pose(at), 0.009, 0.0, None)
    assert fit is not None
    assert fit.drift == pytest.approx(drift, rel=1e-3)


@pytest.mark.parametrize(('above', 'finished'), [(195.0, True), (205.0, False)])
def test_what_is_far_above_the_best_is_not_finished(
    monkeypatch: pytest.MonkeyPatch, above: float, finished: bool
) -> None:
    """The best has ``above`` less in chi-square than this has after its second pass."""
    rng = np.random.default_rng(1)
    t = np.arange(1000.0) * 1e-3
    motion = of(t, np.stack([np.sin(9.0 * t), np.cos(14.0 * t), t], axis=1))
    at = np.linspace(0.1, 0.9, 60)
    poses = np.stack([np.sin(9.0 * at), np.cos(14.0 * at), at], axis=1) + rng.normal(0.0, 0.1, (60, 3))
    with monkeypatch.context() as patched:
        patched.setattr(clock, 'PASSES', 2)
        second = refined_offset(motion, at, poses, 0.03, 0.0, None)
    assert second is not None
    sizes = 0.5 * second.sizes
    level = sum(biweight(u) for u in (second.residual / sizes).ravel()) - above
    even = brentq(lambda u: 180.0 * biweight(u) - level, 0.0, 4.6)
    best = OffsetFit(0.0, 1e-3, 0.0, 0.0, even * np.resize(sizes, (60, 3)), sizes)
    passes = []
    solved = UsedReferences.solved

    def counting(used: UsedReferences, weights: FloatArray) -> tuple[float, OffsetFit, FloatArray]:
        passes.append(used)
        return solved(used, weights)

    monkeypatch.setattr(UsedReferences, 'solved', counting)
    refined_offset(motion, at, poses, 0.03, 0.0, best)
    assert (len(passes) > 2) is finished
    assert finished or len(passes) == 2


def steps_of(monkeypatch: pytest.MonkeyPatch, start: float, noise: float) -> list[float]:
    """The steps of a refinement of an offset of 12.3 ms from ``start``."""
    rng = np.random.default_rng(1)
    t = np.arange(1000.0) * 1e-3
    motion = of(t, np.stack([np.sin(9.0 * t), np.cos(14.0 * t), t**2], axis=1))
    at = np.linspace(0.1, 0.9, 60)
    poses = np.stack([np.sin(9.0 * at), np.cos(14.0 * at), at**2], axis=1) + rng.normal(0.0, noise, (60, 3))
    steps = []
    solved = UsedReferences.solved

    def recorded(used: UsedReferences, weights: FloatArray) -> tuple[float, OffsetFit, FloatArray]:
        step = solved(used, weights)
        steps.append(abs(step[0]))
        return step

    with monkeypatch.context() as patched:
        patched.setattr(UsedReferences, 'solved', recorded)
        assert refined_offset(motion, at - 0.0123, poses, start, 0.0, None) is not None
    return steps


def test_a_refinement_ends_below_a_tenth_of_a_microsecond(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = steps_of(monkeypatch, 0.0, 0.02)
    assert 3 < len(steps) < 12
    assert steps[-1] < 1e-7
    assert min(steps[2:-1]) >= 1e-7
    # The weights of outliers are those of the second pass, so there are three.
    assert len(steps_of(monkeypatch, 0.0123, 1e-9)) == 3


def newey_west(scores: FloatArray) -> float:
    """By a matrix of Bartlett's weights, after what each has of the one before it is taken off."""
    k = len(scores)
    memory = np.dot(scores[1:], scores[:-1]) / np.dot(scores, scores)
    memory = min(memory, 0.97) if memory > 0.0 else 0.0
    new = np.array([b - memory * a for a, b in pairwise(scores)]) if memory else scores
    lags = int(4.0 * (k / 100.0) ** (2.0 / 9.0))
    apart = np.abs(np.subtract.outer(np.arange(len(new)), np.arange(len(new))))
    bartlett = np.maximum(1.0 - apart / (lags + 1.0), 0.0)
    return float(new @ bartlett @ new * k / len(new) / (1.0 - memory) ** 2)


@pytest.mark.parametrize('k', [2, 3, 5, 40, 100, 450])
@pytest.mark.parametrize('memory', [0.9, 0.3, -0.5])
def test_the_variance_of_a_sum_is_that_of_newey_and_west(k: int, memory: float) -> None:
    scores = np.random.default_rng(k).normal(0.0, 1.0, k)
    for i in range(1, k):
        scores[i] += memory * scores[i - 1]
    assert clock.variance_of_sum(scores) == pytest.approx(newey_west(scores), rel=1e-9)
    assert clock.variance_of_sum(1e-4 * scores) == pytest.approx(1e-8 * newey_west(scores), rel=1e-9)


def test_a_drift_is_not_taken_for_a_memory_without_end() -> None:
    scores = 5.0 + np.linspace(0.0, 0.1, 300)
    assert clock.variance_of_sum(scores) == pytest.approx(newey_west(scores), rel=1e-9)
    assert clock.variance_of_sum(np.full(2, 3.0)) == pytest.approx(1.5**2 * 2.0 / 0.25)


def test_few_scores_have_a_variance_too() -> None:
    assert (clock.variance_of_sum(np.zeros(30)), clock.variance_of_sum(np.array([3.0]))) == (0.0, 9.0)
    assert clock.variance_of_sum(np.empty(0)) == 0.0
