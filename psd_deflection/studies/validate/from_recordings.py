# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What validate compares: the motion of a recording as each solver has it, and a reference."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.solvers.registry import SOLVERS, solver_from_rig
from psd_deflection.recordings.charts import moments
from psd_deflection.recordings.read.references import read_references, read_run, references_of
from psd_deflection.records import FloatArray, IntArray, Moment, SampleBlock
from psd_deflection.rig.config import Rig
from psd_deflection.studies.study import Opened
from psd_deflection.studies.validate.clock import Motion, Solve

ALL = 'all'


@dataclass(frozen=True)
class ValidateProblem:
    """``motion``: what the detectors saw. ``solvers``: those that are compared, the rig's first.

    ``t`` (k,), s, by the reference's clock, increasing. ``reference`` (k, 3), m, m, rad; ``sd`` (k, 3) of it if it is
    known; ``rejected``: measurements without an answer, by reason. ``estimate_sd`` (3,): of the published estimates.
    ``align``: remove the offset between the clocks if it is determined. ``largest``: offset that is looked for, s.
    ``exposure``: time over which each reference is a mean, s. ``sources``: what is compared, by name.
    ``marks``: of the recording, by the clock of the samples.
    """

    motion: Motion
    solvers: Mapping[str, Solve]
    t: FloatArray
    reference: FloatArray
    sd: FloatArray | None
    rejected: Mapping[str, int]
    estimate_sd: FloatArray
    align: bool
    largest: float
    exposure: float
    sources: Mapping[str, str]
    marks: tuple[Moment, ...] = ()

    @property
    def solver(self) -> str:
        """That of the rig."""
        return next(iter(self.solvers))


def read_validate(
    opened: Opened,
    reference: str | Path | None = None,
    *,
    align: bool = False,
    largest: float = 1.0,
    exposure: float = 0.0,
    solvers: Sequence[str] = (),
    with_progress: Callable[[Iterable[SampleBlock]], Iterable[SampleBlock]] = iter,
) -> ValidateProblem:
    """Read the recording and its reference, or the one of a file. Raises RecordingError if one lacks what is needed.

    ``solvers``: those that are compared beside the rig's; ``ALL``: every one that can solve the rig. ``with_progress``
    hands blocks on and counts them.
    """
    recording, rig = opened.recording, opened.rig
    references = references_of(recording) if reference is None else read_references(reference)
    run = read_run(recording, Pipeline(rig), with_progress(recording.blocks()))
    compared = _solvers(rig, solvers)
    start = int(run.t_ns[0])
    return ValidateProblem(
        motion=Motion(
            _seconds(run.t_ns, start), run.dots, 1.0 / rig.converter.sample_rate_hz, compared[rig.estimator.solver]
        ),
        solvers=compared,
        t=_seconds(references.t_ns, start),
        reference=references.poses,
        sd=references.sd,
        rejected=references.rejected,
        estimate_sd=run.estimate_sd,
        align=align,
        largest=largest,
        exposure=exposure,
        sources={**opened.sources, 'reference': str(reference or recording.path)},
        marks=moments(recording.marks(), start),
    )


def _seconds(t_ns: IntArray, start_ns: int) -> FloatArray:
    seconds: FloatArray = (t_ns - start_ns).astype(np.float64) * 1e-9
    return seconds


def _solvers(rig: Rig, beside: Sequence[str]) -> dict[str, Solve]:
    """Return the rig's, then those ``beside`` it."""
    variances = dot_noise_variances(rig) / rig.estimator.block_size
    named = [rig.estimator.solver, *(name for name in beside if name != ALL)]
    out: dict[str, Solve] = {}
    for name in dict.fromkeys([*named, *(SOLVERS if ALL in beside else ())]):
        try:
            out[name] = _solve(name, rig, variances)
        except (SolverError, ConfigError):
            # Of all, those that cannot solve the rig are left out.
            if name in named:
                raise
    return out


def _solve(name: str, rig: Rig, variances: FloatArray) -> Solve:
    solver = solver_from_rig(name, rig)

    def solve(dots: FloatArray) -> FloatArray:
        solution = solver.solve_many(dots, variances)
        poses = solution.pose.copy()
        poses[solution.status != 0] = float('nan')
        return poses

    return solve
