# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compare the motion that the detectors saw with an independent reference."""

from __future__ import annotations

import math

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.records import FloatArray
from psd_deflection.studies.validate.agreement import Agreement, agreement
from psd_deflection.studies.validate.clock import FEWEST, clock_offset
from psd_deflection.studies.validate.from_recordings import ValidateProblem
from psd_deflection.studies.validate.result import Validated


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
