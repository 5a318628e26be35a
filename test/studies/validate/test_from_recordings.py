# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What validate compares, from a made-up recording: times, solvers, sources."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from blind.clock import dots
from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.solvers.registry import SOLVERS
from psd_deflection.recordings.read.references import References, TrustedSamples
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import Mark, SampleBlock
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.study import Opened
from psd_deflection.studies.validate import from_recordings as module
from psd_deflection.studies.validate.from_recordings import read_validate

START = 1_760_000_000_123_456_789
BLOCKS = [
    SampleBlock(i, np.arange(2), START + np.arange(2), np.zeros((2, 6), np.float32), np.zeros(2, np.uint8))
    for i in range(2)
]
POSES = np.array([[1e-3, -2e-3, 0.01], [0.0, 0.0, 0.0], [-2e-3, 1e-3, -0.02]])
SAMPLES = TrustedSamples(START + np.array([0, 1_000_000, 2_500_000]), dots(POSES), np.array([1e-6, 2e-6, 3e-6]))
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
    np.testing.assert_allclose(found.motion.solve(dots(POSES)), POSES, atol=1e-12)
    assert found.motion.solve is found.solvers['exact']
    # No rigid plate has dots like these: the beam says that it did not converge, and where it was then.
    lost = dots(POSES)
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
    # _replace is public: the one of named tuples.
    inline = run._replace(rig=load_rig(overrides={'psd_2.center': [0.0, -0.07]}))
    assert 'appendix_d' not in read_validate(inline, solvers=['all']).solvers
    for solvers in (['appendix_d'], ['all', 'appendix_d']):
        with pytest.raises(SolverError, match='appendix_d divides by both'):
            read_validate(inline, solvers=solvers)
