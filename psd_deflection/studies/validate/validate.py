# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compares the motion of a recording, as each solver has it, with a reference: the answer, its tree and its page."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection.base.axes import AXES, SHOWN, SHOWN_UNITS, SYMBOLS, UNITS
from psd_deflection.base.errors import ConfigError, RecordingError, SolverError
from psd_deflection.base.tables import Column, Table, columns, columns_of
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.solvers.registry import SOLVERS, solver_from_rig
from psd_deflection.recordings.charts import moments
from psd_deflection.recordings.read.references import read_references, read_run, references_of
from psd_deflection.records import FloatArray, IntArray, Moment, SampleBlock
from psd_deflection.rig.config import Rig
from psd_deflection.studies.study import Opened, PageSection, StudyResult
from psd_deflection.studies.validate.agreement import Agreement, agreement
from psd_deflection.studies.validate.clock import FEWEST, Motion, Offset, Solve, clock_offset

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


@dataclass(frozen=True, repr=False)
class Validated(StudyResult):
    """The answer of :func:`~psd_deflection.studies.validate.validate.validate`.

    ``t`` (k,), s, when the references were taken by the clock of the samples; ``reference`` (k, 3), m, m, rad;
    ``estimates``: of each solver at these times (k, 3), NaN if it has no answer. ``agreements``: of each solver, for
    dX, dY, theta. ``offset``: between the clocks; ``applied``: whether it was removed. ``covered``: share of
    differences within 1.96 standard deviations of estimate and reference together, for each axis; NaN if the
    reference does not state its own. ``excluded``: references without samples about them.
    """

    study, json_name = 'validate', 'validate.json'
    title = 'Estimate against reference'

    problem: ValidateProblem
    t: FloatArray
    reference: FloatArray
    estimates: dict[str, FloatArray]
    agreements: dict[str, tuple[Agreement, Agreement, Agreement]]
    offset: Offset
    applied: bool
    covered: tuple[float, float, float]
    excluded: int

    @property
    def solver(self) -> str:
        """That of the rig."""
        return self.problem.solver

    @property
    def sources(self) -> Mapping[str, str]:
        """What was compared, by name."""
        return self.problem.sources

    def sentences(self) -> list[str]:
        """Bias and scale of each axis, cover, clock, and what was left out."""
        out = []
        for i, name in enumerate(SYMBOLS):
            a = self.agreements[self.solver][i]
            text = (
                f'{name}: the estimate is {_pm(a.bias, a.bias_sd, i)} off on average; 95 % of the differences lie '
                f'between {SHOWN[i] * a.limits[0]:+.1f} and {SHOWN[i] * a.limits[1]:+.1f} {SHOWN_UNITS[i]}'
            )
            if a.mirrored:
                text += (
                    '; the reference moves the other way: turn its sign (of a camera, camera.view), '
                    'or that of the readings if `psd-deflection check` says so'
                )
            if math.isfinite(a.scale):
                text += f'; it is {100.0 * a.scale:+.3f} ± {196.0 * a.scale_sd:.3f} % larger'
            out.append(text + '.')
        if math.isfinite(self.covered[0]):
            cover = ', '.join(f'{n} {100.0 * c:.1f} %' for n, c in zip(SYMBOLS, self.covered, strict=True))
            out.append(f'Differences within 1.96 standard deviations of both instruments (95 % expected): {cover}.')
        out.append(self.offset.sentence)
        if self.applied:
            out.append('The offset was removed before the comparison.')
        elif self.offset.determined and abs(self.offset.value) > 1.96 * self.offset.sd:
            out.append('It was not removed; --align removes it.')
        if self.excluded:
            total = len(self.t) + self.excluded
            out.append(f'{self.excluded} of {total} references have no samples about them and are left out.')
        if rejected := self.problem.rejected:
            reasons = ', '.join(f'{reason} {count}' for reason, count in sorted(rejected.items()))
            out.append(f'The reference gave no answer {sum(rejected.values())} times: {reasons}.')
        return out

    def lines(self) -> list[str]:
        """Return the sentences and the table of solvers."""
        return [*self.sentences(), '', *columns(self.rows(), align_left=3).splitlines()]

    def rows(self) -> list[list[str]]:
        """The table of solvers, its head first: errors as in Table 5.1 of the thesis, with bias, scale, noise."""
        out = [['solver', 'axis', 'unit', 'bias', 'scale %', 'noise', 'rms', 'largest', '% of deflection']]
        for name, three in self.agreements.items():
            for i, a in enumerate(three):
                out.append(
                    [
                        name if i == 0 else '',
                        SYMBOLS[i],
                        SHOWN_UNITS[i],
                        f'{SHOWN[i] * a.bias:+.2f}',
                        f'{100.0 * a.scale:+.3f}' if math.isfinite(a.scale) else '-',
                        f'{SHOWN[i] * a.noise:.2f}',
                        f'{SHOWN[i] * a.rms:.2f}',
                        f'{SHOWN[i] * a.largest:.2f}',
                        f'{100.0 * a.share:.2f}' if math.isfinite(a.share) else '-',
                    ]
                )
        return out

    def tree(self) -> dict[str, Any]:
        """In SI units."""
        offset = {**asdict(self.offset), 'interval': self.offset.interval, 'determined': self.offset.determined}
        return {
            'solver': self.solver,
            'references': len(self.t),
            'left_out': self.excluded,
            'rejected': dict(self.problem.rejected),
            'offset': {**offset, 'applied': self.applied, 'unit': 's', 'sentence': self.offset.sentence},
            'solvers': {
                name: {axis: {'unit': unit, **asdict(a)} for axis, unit, a in zip(AXES, UNITS, three, strict=True)}
                for name, three in self.agreements.items()
            },
            'covered': dict(zip(AXES, self.covered, strict=True)),
        }

    def table(self) -> Table:
        """Return one row a reference over ``t`` (s): the ``reference_`` pose, and that of each solver (m, m, rad)."""
        parts = [('reference', self.reference), *self.estimates.items()]
        out = [c for name, pose in parts for c in columns_of(pose, [f'{name}_{a}' for a in AXES], UNITS, [name] * 3)]
        return Table(Column('t', self.t, 's', 'by the clock of the samples'), out, {'solver': self.solver})

    def sections(self) -> Iterable[PageSection]:
        """Return the solvers, over time, agreement."""
        from psd_deflection.studies.validate.pictures import DrawnAgreement, sections

        of = self.solver
        shown = DrawnAgreement(of, self.t, self.estimates[of], self.reference, self.agreements[of], self.problem.marks)
        return sections(shown, self.rows())


def _pm(value: float, sd: float, axis: int) -> str:
    return f'{SHOWN[axis] * value:+.2f} ± {196e-2 * SHOWN[axis] * sd:.2f} {SHOWN_UNITS[axis]}'


def validate(problem: ValidateProblem) -> Validated:
    """Find the offset of the clocks, then compare each solver at the instants of the references.

    Raises RecordingError if fewer than 20 references lie within the motion.
    """
    motion, t = problem.motion, problem.t
    offset = clock_offset(motion, t, problem.reference, largest=problem.largest, exposure=problem.exposure)
    applied = problem.align and offset.determined
    at = t + offset.value if applied else t
    dots, _, _ = motion.dots_at(at, problem.exposure)
    there = np.isfinite(dots).all(axis=1)
    if there.sum() < FEWEST:
        raise RecordingError(
            f'{int(there.sum())} references lie within the recording by their stamps; at least {FEWEST} are needed '
            f'(with the offset between the clocks removed there may be more: --align)'
        )
    reference, dots = problem.reference[there], dots[there]
    estimates = {name: solve(dots) for name, solve in problem.solvers.items()}
    agreements = {name: of for name, poses in estimates.items() if (of := _on_each_axis(poses, reference)) is not None}
    covered = (math.nan, math.nan, math.nan)
    if problem.sd is not None and problem.solver in agreements:
        error = np.abs(estimates[problem.solver] - reference)
        both = np.sqrt(problem.sd[there] ** 2 + problem.estimate_sd**2)
        good = np.isfinite(error).all(axis=1)
        x, y, twist = (float(v) for v in (error[good] <= 1.96 * both[good]).mean(axis=0))
        covered = (x, y, twist)
    return Validated(
        problem=problem,
        t=at[there],
        reference=reference,
        estimates=estimates,
        agreements=agreements,
        offset=offset,
        applied=applied,
        covered=covered,
        excluded=int((~there).sum()),
    )


def _on_each_axis(poses: FloatArray, reference: FloatArray) -> tuple[Agreement, Agreement, Agreement] | None:
    good = np.isfinite(poses).all(axis=1)
    if good.sum() < FEWEST:
        return None
    x, y, twist = (agreement(poses[good, i], reference[good, i]) for i in range(3))
    return x, y, twist
