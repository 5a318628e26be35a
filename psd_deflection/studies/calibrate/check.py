# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whether an old calibration still holds: which group of parameters moved, by how much, how sure.

The rig file gives p with covariance P. New rows with normal matrix N = J^T C^-1 J and b = J^T C^-1 r(p) are, if nothing
moved, b ~ N(0, N + N P N). What is left of b after P has explained what it can is

    b' = b - N Q b,    M = N - N Q N,    Q = (P^-1 + N)^-1,

and T = b'_g^T M_gg^-1 b'_g of a group g of parameters is chi-square with as many degrees of freedom as the rows show
directions of it. The smallest p over the groups, times their number, below ``LEVEL`` says that something moved
(Bonferroni). What moved is the group of the largest Bayes factor, for shifts of the size of the tolerances. The zero
and the reference's clock are free in any case.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from psd_deflection.model.misalignment.model import COUNT, PARAMETERS, TOLERANCES, ZERO
from psd_deflection.model.misalignment.rig import vector_of_rig
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.calibrate.calibrate import coarse_delay, fitted_parameters, kind_of
from psd_deflection.studies.calibrate.fit import (
    NAMES,
    CalibrationFit,
    Kind,
    Mask,
    Prior,
    explained,
    prior_of_rig,
    score_at,
    with_common_zero,
)
from psd_deflection.studies.calibrate.observation import CalibrationRun, Rows, joined, noise_of, rest_means, rows_of

LEVEL = 0.05
"""Share of rigs that did not move and are said to have moved."""
LIKE = 3.0
"""Natural logarithm of a Bayes factor below which two groups cannot be distinguished."""
BELIEVED = 0.02
"""Share of the tolerances below which a calibration is not believed: its covariance is that of a linear model."""
SHIFT = 3.0
"""Size of the shifts that are looked for, in tolerances."""
FITTED = 7
"""Groups, the likeliest, that are fitted in full if something moved."""
_OBSERVED = 1e-4
"""A direction that the rows show by less than this share of a tolerance's inverse variance counts as unseen."""


class MovedGroup(NamedTuple):
    """One group: ``p`` that it did not move, ``evidence`` (natural logarithm of the Bayes factor) that it did.

    ``shifts``: by parameter, the value that it moved by if it alone did, and its standard deviation.
    """

    group: str
    p: float
    evidence: float
    freedom: int
    shifts: dict[str, tuple[float, float]]


class CalibrationCheck(NamedTuple):
    """``unchanged``: nothing moved. ``p``: over all groups. ``groups``: the likeliest first. ``like``: groups that the
    first cannot be distinguished from. ``zero``: the unloaded readings less the file's, (4,) m, and their deviations.
    """

    unchanged: bool
    p: float
    groups: list[MovedGroup]
    like: list[str]
    zero: FloatArray
    zero_sd: FloatArray


def check(
    runs: Sequence[CalibrationRun],
    rig: Rig,
    *,
    alone: bool = False,
    progress: Callable[[str], None] = lambda words: None,
) -> CalibrationCheck:
    """Hold the rig file against recordings made since. Raises RecordingError as a calibration does."""
    kind = kind_of(runs, alone)
    progress('rows')
    noise = np.median([noise_of(run, rig) for run in runs], axis=0)
    clock = coarse_delay(runs, rig, noise) if kind == 'reference' else 0.0
    rows = joined([rows_of(run, rig, noise, delay=clock, blocks=kind != 'reference') for run in runs])
    if kind == 'loads':
        rows = rest_means(rows, rig, noise)
    progress('fitting')
    vector = vector_of_rig(rig)
    prior = prior_of_rig(rig, vector)
    prior.covariance[:COUNT, :COUNT] += np.diag((BELIEVED * TOLERANCES) ** 2)
    # The noise is that about the best fit of a rig that may have moved.
    wide = prior.covariance.copy()
    wide[:COUNT, :COUNT] += np.diag((3.0 * TOLERANCES) ** 2)
    free = fitted_parameters(kind)
    rows, best = with_common_zero(rows, rig, Prior(prior.mean, wide), kind, free)
    # Gradient and information at the file's values: from a rig that far off k and the heights would not be linear.
    z = prior.mean.copy()
    z[ZERO:] = best.values[ZERO:]
    gradient, information_of_all = score_at(rows, z, rig, kind, best)
    at = np.flatnonzero(free)
    scale = np.concatenate((TOLERANCES, prior.sd[COUNT:]))[at]
    information = information_of_all[np.ix_(at, at)] * np.outer(scale, scale)
    right = scale * gradient[at] + information @ ((z - prior.mean)[at] / scale)
    p = prior.covariance[np.ix_(at, at)] / np.outer(scale, scale)
    q = np.linalg.solve(np.eye(len(at)) + p @ information, p)
    score = right - information @ (q @ right)
    m = information - information @ q @ information
    groups = [moved_group(name, at, score, m, scale) for name in dict.fromkeys(d.group for d in PARAMETERS)]
    testable = [g for g in groups if g.freedom]
    testable.sort(key=lambda g: -g.evidence)
    overall = overall_p([g.p for g in testable])
    if overall < LEVEL:
        # A shift of several tolerances is beyond the linear: the likely ones are fitted in full.
        null = explained(rows, rig, prior, kind, free, best)[0]
        fitted = [fitted_group(g, rows, rig, prior, kind, free, best, null) for g in testable[:FITTED]]
        testable = [*sorted(fitted, key=lambda g: -g.evidence), *testable[FITTED:]]
    like = [g.group for g in testable[1:] if testable[0].evidence - g.evidence < LIKE] if overall < LEVEL else []
    zeros = slice(ZERO, COUNT)
    return CalibrationCheck(
        overall >= LEVEL,
        overall,
        testable,
        like,
        best.values[zeros] - vector.values[zeros],
        np.sqrt(np.diag(best.covariance)[zeros]),
    )


def overall_p(each: Sequence[float]) -> float:
    """p that nothing moved, from that of ``each`` group (Bonferroni); below ``LEVEL`` for at most its share of rigs."""
    return min([1.0, *(len(each) * p for p in each)])


def moved_group(name: str, at: IntArray, residual: FloatArray, m: FloatArray, scale: FloatArray) -> MovedGroup:
    """Return the shift of a group of parameters, with its evidence against nothing moved."""
    members = [i for i, index in enumerate(at) if index < ZERO and PARAMETERS[int(index)].group == name]
    block, score = m[np.ix_(members, members)], residual[members]
    size, vectors = np.linalg.eigh(0.5 * (block + block.T))
    shown = size > _OBSERVED
    along = vectors.T @ score
    statistic = float(np.sum(along[shown] ** 2 / size[shown]))
    freedom = int(shown.sum())
    size = np.maximum(size, 0.0)
    evidence = 0.5 * float(np.sum(along**2 / (size + 1.0) - np.log1p(size)))
    covariance = (vectors / (size + 1.0)) @ vectors.T
    shift = covariance @ score
    named = {
        NAMES[int(at[i])]: (float(scale[i] * shift[j]), float(scale[i] * covariance[j, j] ** 0.5))
        for j, i in enumerate(members)
    }
    return MovedGroup(name, float(chi2.sf(statistic, freedom)) if freedom else 1.0, evidence, freedom, named)


def fitted_group(
    group: MovedGroup, rows: Rows, rig: Rig, prior: Prior, kind: Kind, free: Mask, best: CalibrationFit, null: float
) -> MovedGroup:
    """The group with the evidence and the shifts of a full fit; ``null``: what :func:`explained` says if none moved."""
    covariance = prior.covariance.copy()
    for name in group.shifts:
        i = NAMES.index(name)
        covariance[i, i] += (SHIFT * TOLERANCES[i]) ** 2
    evidence, z = explained(rows, rig, Prior(prior.mean, covariance), kind, free, best)
    moved = {name: (float((z - prior.mean)[NAMES.index(name)]), sd) for name, (_, sd) in group.shifts.items()}
    return group._replace(evidence=evidence - null, shifts=moved)


def result(outcome: CalibrationCheck) -> dict[str, Any]:
    """As JSON."""
    return {
        'verdict': 'holds' if outcome.unchanged else 'moved',
        'level': LEVEL,
        'p': outcome.p,
        'moved': None if outcome.unchanged else outcome.groups[0].group,
        'or': outcome.like,
        'groups': [
            {
                'name': g.group,
                'p': min(1.0, g.p),
                'evidence': g.evidence,
                'shifts': {name: {'value': v, 'sd': sd} for name, (v, sd) in g.shifts.items()},
            }
            for g in outcome.groups
        ],
        'zero': {
            NAMES[ZERO + i]: {'value': float(v), 'sd': float(sd)}
            for i, (v, sd) in enumerate(zip(outcome.zero, outcome.zero_sd, strict=True))
        },
    }


def sentence(outcome: CalibrationCheck) -> str:
    """Return the answer in one sentence."""
    if outcome.unchanged:
        return f'The calibration holds: nothing moved (p {outcome.p:.2g}; false alarms at most {LEVEL:.0%}).'
    first = outcome.groups[0]
    shifts = ', '.join(f'{name} by {v:+.3g} ± {sd:.1g}' for name, (v, sd) in first.shifts.items())
    alternatives = f' (or {", ".join(outcome.like)}: this recording cannot tell)' if outcome.like else ''
    return f'{first.group} moved{alternatives}: {shifts} (p {outcome.p:.2g}). Calibrate again.'
