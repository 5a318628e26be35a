# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The comparison as a whole and its parts: times, solvers, bias, scale and noise of made-up recordings."""

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.stats import linregress

from blind.generator import flat_dots
from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.solvers.registry import SOLVERS
from psd_deflection.recordings.read.references import References, TrustedSamples
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import FloatArray, Mark, SampleBlock
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.study import Opened
from psd_deflection.studies.validate import validate as module
from psd_deflection.studies.validate.agreement import Agreement, agreement
from psd_deflection.studies.validate.clock import Motion, Offset
from psd_deflection.studies.validate.validate import Validated, ValidateProblem, read_validate, validate

LATE = 0.0123
"""s, by which the stamps of the reference are early."""


def first_three(dots: FloatArray) -> FloatArray:
    poses: FloatArray = dots[:, :3].copy()
    return poses


def pose(t: FloatArray) -> FloatArray:
    return np.stack([np.sin(9.0 * t), np.cos(14.0 * t), np.sin(4.0 * t + t**2)], axis=1)


T = np.arange(3000.0) * 1e-3
STAMPS = np.linspace(0.1, 2.8, 90)
NOISE = np.random.default_rng(0).normal(0.0, [1e-3, 2e-3, 3e-3], (90, 3))


@pytest.fixture
def problem() -> ValidateProblem:
    """Late stamps; the bias is 0.1, -0.2, 0.3."""
    return ValidateProblem(
        motion=Motion(T, np.column_stack([pose(T), np.zeros(len(T))]), 1e-3, first_three),
        solvers={'exact': first_three},
        t=STAMPS - LATE,
        reference=pose(STAMPS) - [0.1, -0.2, 0.3] + NOISE,
        sd=None,
        rejected={},
        estimate_sd=np.array([0.0, 0.0, 0.0]),
        align=True,
        largest=0.5,
        exposure=0.0,
        sources={},
    )


def test_the_offset_is_removed_if_asked(problem: ValidateProblem) -> None:
    validation = validate(problem)
    assert validation.applied
    assert validation.offset.value == pytest.approx(LATE, abs=4.0 * validation.offset.sd)
    assert validation.t == pytest.approx(problem.t + validation.offset.value)
    np.testing.assert_allclose(validation.estimates['exact'], pose(validation.t), atol=1e-6)
    assert validation.reference.tolist() == problem.reference.tolist()
    assert [a.bias for a in validation.agreements['exact']] == pytest.approx([0.1, -0.2, 0.3], abs=2e-3)
    assert [a.noise for a in validation.agreements['exact']] == pytest.approx(NOISE.std(axis=0).tolist(), rel=0.1)
    assert validation.excluded == 0
    assert np.isnan(validation.covered).all()
    assert validation.problem is problem


def test_an_offset_that_is_not_reported_is_not_removed(problem: ValidateProblem) -> None:
    noise = np.random.default_rng(1).normal(0.0, 1.0, (90, 3))
    validation = validate(replace(problem, reference=noise))
    assert not validation.offset.determined
    assert not validation.applied
    assert validation.t.tolist() == problem.t.tolist()


def test_each_reference_is_a_mean_over_its_exposure(problem: ValidateProblem) -> None:
    within = (np.arange(100) - 49.5) * 0.4e-3
    validation = validate(replace(problem, align=False, exposure=0.04))
    expected = np.mean([pose(problem.t + u) for u in within], axis=0)
    middle = (problem.t > 0.1) & (problem.t < 2.7)
    np.testing.assert_allclose(validation.estimates['exact'][middle], expected[middle], atol=2e-5)
    assert np.abs(pose(problem.t) - expected).max() > 0.01


def test_references_without_samples_are_left_out(problem: ValidateProblem) -> None:
    early = np.linspace(-0.4, -0.2, 7)
    t = np.concatenate([early, problem.t])
    reference = np.concatenate([np.zeros((7, 3)), problem.reference])
    sd = np.concatenate([np.zeros((7, 3)), np.ones((90, 3))])
    validation = validate(replace(problem, t=t, reference=reference, sd=sd, align=False))
    assert (validation.excluded, validation.t.tolist()) == (7, problem.t.tolist())
    assert validation.reference.tolist() == problem.reference.tolist()
    assert (validation.estimates['exact'].shape, validation.covered) == ((90, 3), (1.0, 1.0, 1.0))


def test_cover_counts_what_lies_within_both_deviations(problem: ValidateProblem) -> None:
    """Differences of 1, and deviations of 0.3 of the estimate and 0.4 of the reference together are 0.5."""
    exact = pose(STAMPS)
    # Beyond 0.98 are 9, 18 and 27 of 90.
    size = np.where(np.arange(90)[:, None] < [9, 18, 27], 0.985, 0.975) * np.resize([1.0, -1.0], (90, 1))
    both = replace(
        problem, t=STAMPS, align=False, reference=exact + size, sd=np.full((90, 3), 0.4), estimate_sd=np.full(3, 0.3)
    )
    assert validate(both).covered == pytest.approx((0.9, 0.8, 0.7))


def test_a_solver_that_answers_too_rarely_is_not_judged(problem: ValidateProblem) -> None:
    def rarely(answers: int) -> ValidateProblem:
        def solve(dots: FloatArray) -> FloatArray:
            poses = first_three(dots)
            poses[answers:, 1] = np.nan
            return poses

        sd = np.full((90, 3), 1.0)
        return replace(problem, align=False, sd=sd, solvers={'exact': first_three, 'wls': solve})

    validation = validate(rarely(20))
    assert list(validation.agreements) == ['exact', 'wls']
    fewer = validate(replace(problem, align=False, t=problem.t[:20], reference=problem.reference[:20]))
    assert [a.bias for a in validation.agreements['wls']] == pytest.approx([a.bias for a in fewer.agreements['exact']])
    validation = validate(rarely(19))
    assert (list(validation.agreements), list(validation.estimates)) == (['exact'], ['exact', 'wls'])
    # The solver of the rig itself: nothing is said about its cover.
    rare = rarely(19)
    validation = validate(replace(rare, solvers={'wls': rare.solvers['wls'], 'exact': first_three}))
    assert list(validation.agreements) == ['exact']
    assert np.isnan(validation.covered).all()


START = 1_760_000_000_123_456_789
BLOCKS = [
    SampleBlock(i, np.arange(2), START + np.arange(2), np.zeros((2, 6), np.float32), np.zeros(2, np.uint8))
    for i in range(2)
]
POSES = np.array([[1e-3, -2e-3, 0.01], [0.0, 0.0, 0.0], [-2e-3, 1e-3, -0.02]])
SAMPLES = TrustedSamples(START + np.array([0, 1_000_000, 2_500_000]), flat_dots(POSES), np.array([1e-6, 2e-6, 3e-6]))
OWN = References(START + np.array([-500_000_000, 1_500_000_000]), POSES[:2], POSES[1:], {'blurred': 2})
OTHERS = References(START + np.array([250_000_000]), POSES[2:])


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Opened:
    """A recording of three samples at 500 Hz with two references, and a table of one."""

    def read_run(recording: Recording, pipeline: Pipeline, blocks: Iterable[SampleBlock]) -> TrustedSamples:
        assert isinstance(pipeline, Pipeline)
        assert list(blocks) == BLOCKS
        return SAMPLES

    monkeypatch.setattr(module, 'read_run', read_run)
    monkeypatch.setattr(module, 'references_of', lambda _: OWN)
    monkeypatch.setattr(module, 'read_references', {'camera.csv': OTHERS}.__getitem__)
    recording = SimpleNamespace(
        path=Path('run.csv'), blocks=lambda: iter(BLOCKS), marks=lambda: [Mark(START + 2_000_000_000, 'push')]
    )
    rig = load_rig(overrides={'converter.sample_rate_hz': 500.0})
    return Opened(cast(Recording, recording), rig, Path('rig.yaml'))


def test_everything_is_in_seconds_from_the_first_sample(run: Opened) -> None:
    problem = read_validate(run)
    assert problem.motion.t == pytest.approx([0.0, 1e-3, 2.5e-3], abs=1e-15)
    assert problem.t == pytest.approx([-0.5, 1.5])
    assert problem.motion.period == pytest.approx(2e-3)
    assert problem.motion.dots is SAMPLES.dots
    assert [tuple(mark) for mark in problem.marks] == [(2.0, 'push')]


def test_the_references_are_those_of_the_recording_or_of_a_file(run: Opened) -> None:
    problem = read_validate(run)
    assert problem.reference is OWN.poses
    assert problem.sd is OWN.sd
    assert problem.rejected == {'blurred': 2}
    assert problem.estimate_sd is SAMPLES.estimate_sd
    assert problem.sources == {'recording': 'run.csv', 'rig': 'rig.yaml', 'reference': 'run.csv'}
    problem = read_validate(run, 'camera.csv', align=True, largest=3.0, exposure=0.01)
    assert problem.reference is OTHERS.poses
    assert problem.sd is None
    assert problem.t == pytest.approx([0.25])
    assert problem.sources['reference'] == 'camera.csv'
    assert (problem.align, problem.largest, problem.exposure) == (True, 3.0, 0.01)


def test_a_solver_gives_the_pose_or_none(run: Opened) -> None:
    problem = read_validate(run, solvers=['beam', 'wls'])
    assert list(problem.solvers) == ['exact', 'beam', 'wls']
    np.testing.assert_allclose(problem.motion.solve(flat_dots(POSES)), POSES, atol=1e-12)
    assert problem.motion.solve is problem.solvers['exact']
    # No rigid plate has dots like these: the beam says that it did not converge, and where it was then.
    lost = flat_dots(POSES)
    lost[1] = [0.3, 0.3, -0.3, 0.3]
    assert np.isnan(problem.solvers['beam'](lost)).tolist() == [[False] * 3, [True] * 3, [False] * 3]


def test_of_all_solvers_those_that_can_are_compared(run: Opened) -> None:
    every = list(read_validate(run, solvers=['all']).solvers)
    assert every[0] == 'exact'
    assert {'wls', 'beam', 'appendix_d'} < set(every) <= set(SOLVERS)
    # base_pair takes PSDs at the base, these are at the tip.
    assert list(read_validate(run, solvers=['beam', 'all', 'exact']).solvers)[:2] == ['exact', 'beam']
    with pytest.raises(ConfigError, match='bean'):
        read_validate(run, solvers=['bean'])
    # Both centres on one line through the middle.
    inline = run._replace(rig=load_rig(overrides={'psd_2.center': [0.0, -0.07]}))
    assert 'appendix_d' not in read_validate(inline, solvers=['all']).solvers
    for solvers in (['appendix_d'], ['all', 'appendix_d']):
        with pytest.raises(SolverError, match='appendix_d divides by both'):
            read_validate(inline, solvers=solvers)


def test_bias_scale_and_noise_are_separated() -> None:
    rng = np.random.default_rng(0)
    true = 2e-3 * np.sin(np.linspace(0.0, 40.0, 3000))
    reference = true + rng.normal(0.0, 10e-6, 3000)
    stats = agreement(1.004 * true + 5e-6, reference)
    assert stats.bias == pytest.approx(5e-6 + 0.004 * true.mean(), abs=4 * stats.bias_sd)
    assert stats.scale == pytest.approx(0.004, abs=4 * stats.scale_sd)
    assert stats.scale_sd < 3e-4
    assert stats.noise == pytest.approx(10e-6, rel=0.05)
    assert stats.share == pytest.approx(stats.rms / np.abs(reference).max())


def test_a_noisy_reference_does_not_shrink_the_scale() -> None:
    rng = np.random.default_rng(1)
    true = 1e-4 * np.sin(np.linspace(0.0, 300.0, 20000))
    stats = agreement(true, true + rng.normal(0.0, 50e-6, 20000))
    # The slope of the estimate on this reference would be 1/3 too small.
    assert abs(stats.scale) < 4 * stats.scale_sd < 0.1


def test_limits_are_those_of_bland_and_altman() -> None:
    estimate = np.array([1.0, 2.0, 3.0, 4.0, 6.0])
    reference = np.array([1.1, 1.8, 3.3, 3.9, 5.7])
    stats = agreement(estimate, reference)
    d = estimate - reference
    assert stats.bias == pytest.approx(d.mean())
    assert stats.limits == pytest.approx((d.mean() - 1.96 * d.std(ddof=1), d.mean() + 1.96 * d.std(ddof=1)))
    assert stats.rms == pytest.approx(np.sqrt((d**2).mean()))
    assert stats.largest == pytest.approx(0.3)


def test_a_reference_that_moves_the_other_way_is_mirrored() -> None:
    rng = np.random.default_rng(3)
    true = 2e-3 * np.sin(np.linspace(0.0, 40.0, 3000))
    noise = rng.normal(0.0, 10e-6, 3000)
    assert agreement(true, noise - true).mirrored
    assert not agreement(true, noise + true).mirrored
    assert not agreement(rng.normal(0.0, 1e-6, 3000), noise).mirrored
    # Of eight differences the slope is too uncertain.
    assert not agreement(np.arange(8.0), np.resize([2.0, -2.0, -2.0, 2.0], 8) - np.arange(8.0)).mirrored


def test_deviations_match_many_runs_of_coloured_noise() -> None:
    rng = np.random.default_rng(4)
    true = 2e-3 * np.sin(np.linspace(0.0, 40.0, 400))
    plain, half = [], []
    for _ in range(200):
        noise = rng.normal(0.0, 10e-6, 400)
        for i in range(1, 400):
            noise[i] += 0.9 * noise[i - 1]
        plain.append(agreement(true, true + noise))
        half.append(agreement(true, 2.0 * true + noise))
    assert np.std([f.bias for f in plain]) == pytest.approx(np.median([f.bias_sd for f in plain]), rel=0.35)
    assert np.mean([f.scale for f in half]) == pytest.approx(-0.5, abs=1e-3)
    assert np.std([f.scale for f in half]) == pytest.approx(np.median([f.scale_sd for f in half]), rel=0.35)


def test_slope_and_deviations_are_those_of_a_regression() -> None:
    """Errors that change sign each time have no memory: the deviations are those of least squares."""
    estimate = np.array([0.0, 1.0, 2.0, 4.0, 5.0, 7.0, 8.0, 9.0, 11.0, 12.0]) + 100.0
    error = 0.1 * np.resize([1.0, -1.0], 10) * [1.0, 2.0, 1.0, 3.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0]
    reference = 0.8 * estimate - 3.0 + error
    stats = agreement(estimate, reference)
    fit = linregress(estimate, reference)
    residual = reference - fit.slope * estimate - fit.intercept
    assert stats.scale == pytest.approx(1.0 / fit.slope - 1.0)
    assert stats.noise == pytest.approx(np.sqrt(residual @ residual / 8.0))
    # Of one over the slope.
    assert (stats.scale_sd, stats.share) == pytest.approx((fit.stderr / fit.slope**2, stats.rms / reference[-1]))
    even = agreement(5.0 + error, np.full(10, 5.0))
    assert even.bias_sd == pytest.approx(error.std(ddof=1) / math.sqrt(10.0))


def test_an_estimate_that_stands_still_has_no_scale() -> None:
    stats = agreement(np.full(20, 0.5), np.resize([0.0, 1.0, 0.2], 20))
    assert np.isnan([stats.scale, stats.scale_sd, stats.share]).all()
    assert not stats.mirrored
    assert stats.noise == pytest.approx(np.resize([0.0, 1.0, 0.2], 20).std(ddof=1))
    assert stats.largest == 0.5


PERIOD = 2.0**-10
"""s: sums of it are exact."""


def of(places: FloatArray, seed: int = 0, period: float = PERIOD) -> Motion:
    """Samples at the places ``places``, a cubic with noise on each channel."""
    rng = np.random.default_rng(seed)
    t = places * period
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
        window = np.abs(places - instant) <= half + 0.5
        for channel in range(4):
            # From the instant, in samples.
            u = places[window] - instant
            fit = Polynomial.fit(u, motion.dots[window, channel], 4).convert()
            deviation = fit.integ()
            mean = (deviation(0.5 * exposure) - deviation(-0.5 * exposure)) / exposure if exposure else fit(0.0)
            ends = (fit(0.5 * exposure) - fit(-0.5 * exposure)) / exposure if exposure else fit.deriv()(0.0)
            assert values[i, channel] == pytest.approx(mean, rel=1e-9)
            assert rates[i, channel] == pytest.approx(ends / PERIOD, rel=1e-8)
            residual = motion.dots[window, channel] - fit(u)
            design = np.vander(u / half, 5)
            share = 0.5 * weights @ np.vander(0.5 * exposure * inside / half, 5)
            factor = share @ np.linalg.solve(design.T @ design, share)
            assert variances[i, channel] == pytest.approx(residual @ residual / (len(u) - 5) * factor, rel=1e-7)


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


def none(dots: FloatArray) -> FloatArray:
    return dots[:, :3]


STAMPED_LATE = Offset(0.0123, 1e-4, 0.0, 1e-6, True, (), 100)
X = Agreement(1.5e-6, 0.25e-6, (-2.5e-6, 5.5e-6), 0.004, 0.001, 2e-6, 3e-6, 4e-6, 0.05)
Y = Agreement(-2e-6, 0.5e-6, (-4e-6, 0.0), math.nan, math.nan, 5e-6, 6e-6, 7e-6, math.nan, mirrored=True)
# A milliradian is 57.3 mdeg.
TWIST = Agreement(1e-3, 1e-4, (-1e-3, 2e-3), -0.02, 0.005, 2e-3, 3e-3, 4e-3, 1.25)
PROBLEM = ValidateProblem(
    motion=Motion(np.arange(30.0), np.zeros((30, 4)), 1.0, none),
    solvers={'exact': none, 'wls': none},
    t=np.arange(4.0),
    reference=np.zeros((4, 3)),
    sd=None,
    rejected={},
    estimate_sd=np.ones(3),
    align=False,
    largest=1.0,
    exposure=0.0,
    sources={'recording': 'run.csv', 'reference': 'camera.csv'},
)
PLAIN = Validated(
    problem=PROBLEM,
    t=np.arange(4.0),
    reference=np.arange(12.0).reshape(4, 3),
    estimates={'exact': 10.0 * np.arange(12.0).reshape(4, 3), 'wls': np.full((4, 3), math.nan)},
    agreements={'exact': (X, Y, TWIST), 'wls': (Y, X, TWIST)},
    offset=STAMPED_LATE,
    applied=False,
    covered=(math.nan, math.nan, math.nan),
    excluded=0,
)


def test_a_plain_answer_has_the_clock_and_one_sentence_an_axis() -> None:
    assert PLAIN.sentences() == [
        'ΔX: the estimate is +1.50 ± 0.49 µm off on average; 95 % of the differences lie between -2.5 and +5.5 µm; '
        'it is +0.400 ± 0.196 % larger.',
        'ΔY: the estimate is -2.00 ± 0.98 µm off on average; 95 % of the differences lie between -4.0 and +0.0 µm; '
        'the reference moves the other way: turn its sign (of a camera, camera.view), '
        'or that of the readings if `psd-deflection check` says so.',
        'θ: the estimate is +57.30 ± 11.23 mdeg off on average; 95 % of the differences lie between -57.3 and '
        '+114.6 mdeg; it is -2.000 ± 0.980 % larger.',
        STAMPED_LATE.sentence,
        'It was not removed; --align removes it.',
    ]


@pytest.mark.parametrize(
    ('offset', 'applied', 'words'),
    [
        (STAMPED_LATE, True, 'The offset was removed before the comparison.'),
        (STAMPED_LATE, False, 'It was not removed; --align removes it.'),
        (replace(STAMPED_LATE, value=-0.0123), False, 'It was not removed; --align removes it.'),
        # 0.19 ms with 0.1 ms of deviation is no offset, 0.2 ms is one.
        (replace(STAMPED_LATE, value=0.2e-3), False, 'It was not removed; --align removes it.'),
        (replace(STAMPED_LATE, value=0.19e-3), False, None),
        (replace(STAMPED_LATE, value=-0.19e-3), False, None),
        # It is large, but nobody knows how large.
        (replace(STAMPED_LATE, explained=False), False, None),
        (replace(STAMPED_LATE, alternatives=(0.2,)), False, None),
    ],
)
def test_offset_removal_is_reported_if_offset_exists(offset: Offset, applied: bool, words: str | None) -> None:
    message = replace(PLAIN, offset=offset, applied=applied).sentences()
    assert (message[3], message[4:]) == (offset.sentence, [] if words is None else [words])


def test_coverage_is_reported_if_reference_has_sd() -> None:
    message = replace(PLAIN, covered=(0.95, 0.5, 1.0)).sentences()
    assert len(message) == 6
    assert message[3] == (
        'Differences within 1.96 standard deviations of both instruments (95 % expected): ΔX 95.0 %, ΔY 50.0 %, '
        'θ 100.0 %.'
    )


def test_what_was_left_out_and_rejected_is_counted() -> None:
    validation = replace(PLAIN, excluded=3, problem=replace(PROBLEM, rejected={'too dark': 2, 'blurred': 5}))
    assert validation.sentences()[-2:] == [
        '3 of 7 references have no samples about them and are left out.',
        'The reference gave no answer 7 times: blurred 5, too dark 2.',
    ]
    assert len(validation.sentences()) == 7


def test_the_table_has_the_solvers_in_units_that_people_read() -> None:
    rows = PLAIN.rows()
    assert rows == [
        ['solver', 'axis', 'unit', 'bias', 'scale %', 'noise', 'rms', 'largest', '% of deflection'],
        ['exact', 'ΔX', 'µm', '+1.50', '+0.400', '2.00', '3.00', '4.00', '5.00'],
        ['', 'ΔY', 'µm', '-2.00', '-', '5.00', '6.00', '7.00', '-'],
        ['', 'θ', 'mdeg', '+57.30', '-2.000', '114.59', '171.89', '229.18', '125.00'],
        ['wls', 'ΔX', 'µm', '-2.00', '-', '5.00', '6.00', '7.00', '-'],
        ['', 'ΔY', 'µm', '+1.50', '+0.400', '2.00', '3.00', '4.00', '5.00'],
        ['', 'θ', 'mdeg', '+57.30', '-2.000', '114.59', '171.89', '229.18', '125.00'],
    ]
    lines = PLAIN.lines()
    assert lines[:6] == [*PLAIN.sentences(), '']
    assert [line.split() for line in lines[6:]][2:] == [[c for c in row if c] for row in rows[1:]]
    # Words lie to the left, numbers to the right.
    assert lines[9] == '        ΔY    µm     -2.00        -    5.00    6.00     7.00                -'


def test_programs_get_si_units() -> None:
    tree = replace(PLAIN, excluded=3, problem=replace(PROBLEM, rejected={'blurred': 5})).tree()
    assert (tree['solver'], tree['references'], tree['left_out']) == ('exact', 4, 3)
    assert tree['rejected'] == {'blurred': 5}
    offset = tree['offset']
    assert offset['value'] == 0.0123
    assert offset['interval'] == pytest.approx((0.0123 - 0.196e-3, 0.0123 + 0.196e-3))
    assert (offset['determined'], offset['applied'], offset['unit']) == (True, False, 's')
    assert (offset['sentence'], list(tree['solvers'])) == (STAMPED_LATE.sentence, ['exact', 'wls'])
    assert [axis['unit'] for axis in tree['solvers']['exact'].values()] == ['m', 'm', 'rad']
    assert (tree['solvers']['wls']['dy']['bias'], list(tree['covered'])) == (1.5e-6, ['dx', 'dy', 'theta'])
