# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What identify looks at: the poses of single samples of a recording."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.solvers.registry import solver_from_rig
from psd_deflection.recordings.charts import moments
from psd_deflection.recordings.read.references import read_run
from psd_deflection.records import FloatArray, Moment, SampleBlock
from psd_deflection.studies.study import Opened

Counted = Callable[[Iterable[SampleBlock]], Iterable[SampleBlock]]
"""Hands blocks on and counts them, for a progress bar."""


@dataclass(frozen=True)
class IdentifyProblem:
    """``poses`` (n, 3): dX m, dY m, theta rad of single samples on an even grid, NaN if lost; ``rate``, Hz.

    ``marks``: of the recording, from the first of them.
    """

    opened: Opened
    poses: FloatArray
    rate: float
    marks: tuple[Moment, ...] = ()


def read_identify(opened: Opened, with_progress: Counted = iter) -> IdentifyProblem:
    """Solve every trusted sample. Raises RecordingError if there are none."""
    recording, rig = opened.recording, opened.rig
    run = read_run(recording, Pipeline(rig), with_progress(recording.blocks()))
    rate = rig.converter.sample_rate_hz
    solved = solver_from_rig(rig.estimator.solver, rig).solve_many(run.dots, dot_noise_variances(rig))
    place = np.rint((run.t_ns - run.t_ns[0]) * 1e-9 * rate).astype(np.int64)
    poses = np.full((int(place[-1]) + 1, 3), np.nan)
    good = solved.status == 0
    poses[place[good]] = solved.pose[good]
    return IdentifyProblem(opened, poses, rate, moments(recording.marks(), int(run.t_ns[0])))
