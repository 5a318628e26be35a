# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The comparison as a whole and what it compares: times, solvers, sources of a made-up recording."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from blind.generator import flat_dots
from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.solvers.registry import SOLVERS
from psd_deflection.recordings.read.references import References, TrustedSamples
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import FloatArray, Mark, SampleBlock
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.study import Opened
from psd_deflection.studies.validate import from_recordings as module
from psd_deflection.studies.validate.clock import Motion
from psd_deflection.studies.validate.from_recordings import ValidateProblem, read_validate
from psd_deflection.studies.validate.validate import validate

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
    found = validate(problem)
    assert found.applied
    assert found.offset.value == pytest.approx(LATE, abs=4.0 * found.offset.sd)
    assert found.t == pytest.approx(problem.t + found.offset.value)
    np.testing.assert_allclose(found.estimates['exact'], pose(found.t), atol=1e-6)
    assert found.reference.tolist() == problem.reference.tolist()
    assert [a.bias for a in found.agreements['exact']] == pytest.approx([0.1, -0.2, 0.3], abs=2e-3)
    assert [a.noise for a in found.agreements['exact']] == pytest.approx(NOISE.std(axis=0).tolist(), rel=0.1)
    assert found.excluded == 0
    assert np.isnan(found.covered).all()
    assert found.problem is problem


def test_an_offset_that_is_not_reported_is_not_removed(problem: ValidateProblem) -> None:
    noise = np.random.default_rng(1).normal(0.0, 1.0, (90, 3))
    found = validate(replace(problem, reference=noise))
    assert not found.offset.determined
    assert not found.applied
    assert found.t.tolist() == problem.t.tolist()


def test_each_reference_is_a_mean_over_its_exposure(problem: ValidateProblem) -> None:
    within = (np.arange(100) - 49.5) * 0.4e-3
    found = validate(replace(problem, align=False, exposure=0.04))
    expected = np.mean([pose(problem.t + u) for u in within], axis=0)
    middle = (problem.t > 0.1) & (problem.t < 2.7)
    np.testing.assert_allclose(found.estimates['exact'][middle], expected[middle], atol=2e-5)
    assert np.abs(pose(problem.t) - expected).max() > 0.01


def test_references_without_samples_are_left_out(problem: ValidateProblem) -> None:
    early = np.linspace(-0.4, -0.2, 7)
    t = np.concatenate([early, problem.t])
    reference = np.concatenate([np.zeros((7, 3)), problem.reference])
    sd = np.concatenate([np.zeros((7, 3)), np.ones((90, 3))])
    found = validate(replace(problem, t=t, reference=reference, sd=sd, align=False))
    assert found.excluded == 7
    assert found.t.tolist() == problem.t.tolist()
    assert found.reference.tolist() == problem.reference.tolist()
    assert found.estimates['exact'].shape == (90, 3)
    assert found.covered == (1.0, 1.0, 1.0)


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

    found = validate(rarely(20))
    assert list(found.agreements) == ['exact', 'wls']
    kept = validate(replace(problem, align=False, t=problem.t[:20], reference=problem.reference[:20]))
    assert [a.bias for a in found.agreements['wls']] == pytest.approx([a.bias for a in kept.agreements['exact']])
    found = validate(rarely(19))
    assert list(found.agreements) == ['exact']
    assert list(found.estimates) == ['exact', 'wls']
    # The solver of the rig itself: nothing is said about its cover.
    own = rarely(19)
    found = validate(replace(own, solvers={'wls': own.solvers['wls'], 'exact': first_three}))
    assert list(found.agreements) == ['exact']
    assert np.isnan(found.covered).all()


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
    found = read_validate(run)
    assert found.motion.t == pytest.approx([0.0, 1e-3, 2.5e-3], abs=1e-15)
    assert found.t == pytest.approx([-0.5, 1.5])
    assert found.motion.period == pytest.approx(2e-3)
    assert found.motion.dots is SAMPLES.dots
    assert [tuple(mark) for mark in found.marks] == [(2.0, 'push')]


def test_the_references_are_those_of_the_recording_or_of_a_file(run: Opened) -> None:
    found = read_validate(run)
    assert found.reference is OWN.poses
    assert found.sd is OWN.sd
    assert found.rejected == {'blurred': 2}
    assert found.estimate_sd is SAMPLES.estimate_sd
    assert found.sources == {'recording': 'run.csv', 'rig': 'rig.yaml', 'reference': 'run.csv'}
    found = read_validate(run, 'camera.csv', align=True, largest=3.0, exposure=0.01)
    assert found.reference is OTHERS.poses
    assert found.sd is None
    assert found.t == pytest.approx([0.25])
    assert found.sources['reference'] == 'camera.csv'
    assert (found.align, found.largest, found.exposure) == (True, 3.0, 0.01)


def test_a_solver_gives_the_pose_or_none(run: Opened) -> None:
    found = read_validate(run, solvers=['beam', 'wls'])
    assert list(found.solvers) == ['exact', 'beam', 'wls']
    np.testing.assert_allclose(found.motion.solve(flat_dots(POSES)), POSES, atol=1e-12)
    assert found.motion.solve is found.solvers['exact']
    # No rigid plate has dots like these: the beam says that it did not converge, and where it was then.
    lost = flat_dots(POSES)
    lost[1] = [0.3, 0.3, -0.3, 0.3]
    assert np.isnan(found.solvers['beam'](lost)).tolist() == [[False] * 3, [True] * 3, [False] * 3]


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
