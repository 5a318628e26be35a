# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The uncertainty of a calibrated rig at stated poses, with every input of it: the numbers of a certificate.

What a calibration measured is known with its uncertainty: parameters p with a covariance, by the reference. An error
dp of what the rig file says of them makes the pose wrong by c dp, c = -K S^-1 df/dp
(:mod:`psd_deflection.model.misalignment.rig`, K the weighted least squares of the rig's solver). They
are correlated, so that their part of u_c^2 is c^T P c (JCGM 100:2008, equation 16). Nothing in the recordings sees an
error in the scale of the reference: it is an input. What acts since the zero was taken, drift, air, noise, are the
causes of the error budget that no calibration measures. The zero is taken before use, so the calibration's own does not
count.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.misalignment.model import ALL, ZERO
from psd_deflection.model.misalignment.rig import dots_by_parameters, is_calibrated, known_of_rig, vector_of_rig
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.budget.chain import ExactEstimator, method_of
from psd_deflection.studies.budget.evaluate import CAUSES, Expanded, expanded
from psd_deflection.studies.budget.inputs import INPUTS, REFERENCE_INPUTS, is_assumed, read_inputs
from psd_deflection.studies.budget.term import Kind, Situation

CALIBRATION, REFERENCE = 'calibration', 'reference'
"""Causes of a certificate beside those of the budget."""


class InputQuantity(NamedTuple):
    """One input of the uncertainty. ``observed``: of type A. ``u``: its standard uncertainty, ``freedom``: of that.

    ``coefficients`` (n, 3): how dX, dY, theta go with it at each of n poses, m and rad per ``unit``.
    """

    cause: str
    parameter: str
    observed: bool
    distribution: str
    u: float
    unit: str
    freedom: float
    coefficients: FloatArray


@dataclass(frozen=True, eq=False)
class CertificateProblem:
    """``rig``: calibrated. ``calibration``: the tree of its calibration.json. ``inputs``: as ``read_inputs`` gives
    them with those of the reference. ``poses`` (n, 3), m, m, rad; none: the ends of what the calibration saw.

    ``limits`` (3,): largest errors that are allowed, m, m, rad; None: nothing is judged. ``fields``: words for the
    page. ``rig_file``: its name.
    """

    rig: Rig
    calibration: Mapping[str, Any]
    inputs: Mapping[str, float] = field(
        default_factory=lambda: read_inputs(None, {}, declared=(*INPUTS, *REFERENCE_INPUTS))
    )
    poses: Sequence[tuple[float, float, float]] = ()
    limits: tuple[float, float, float] | None = None
    fields: Mapping[str, str] = field(default_factory=dict)
    rig_file: str = ''


@dataclass(frozen=True, eq=False)
class Certificate:
    """``inputs``: all; the first ones are the calibration's, whose ``correlations`` (m, m) are beside them.

    ``poses`` (n, 3). ``as_found`` (n, 3): error of the pose by the rig file before the calibration, to first order.
    ``stated``: the expanded uncertainty at each pose.
    """

    poses: FloatArray
    inputs: tuple[InputQuantity, ...]
    correlations: FloatArray
    as_found: FloatArray
    stated: tuple[Expanded, ...]


def certify(problem: CertificateProblem) -> Certificate:
    """Return every input and the expanded uncertainty at each pose.

    Raises ConfigError if the rig is not calibrated, if its calibration has no reference, for a solver that has no
    budget, or for a pose that no detector sees.
    """
    rig, tree = problem.rig, problem.calibration
    if not is_calibrated(rig):
        raise ConfigError(f'{problem.rig_file}: calibration.names: not there; give the folder of a calibration')
    if tree.get('kind') != 'reference':
        raise ConfigError(
            f'{problem.rig_file}: calibrated by {tree.get("kind")}, without a reference: its scale is traceable to '
            f'nothing; calibrate with a reference'
        )
    poses = np.array(problem.poses or default_poses(tree), dtype=np.float64).reshape(-1, 3)
    sights = [_situation(problem, pose) for pose in poses]
    gains = np.stack([at.estimator.response(at.pose, at.chain.zeros)[0] for at in sights])
    rows, correlations = _of_calibration(problem, poses, gains)
    as_found = _as_found(problem, rows)
    every = (*rows, *_of_reference(problem, poses), *_since_zero(problem.inputs, sights))
    stated = tuple(_expanded(every, correlations, n) for n in range(len(poses)))
    return Certificate(poses, every, correlations, as_found, stated)


def default_poses(tree: Mapping[str, Any]) -> list[tuple[float, float, float]]:
    """At rest, and at either end of what the calibration saw along each axis."""
    low, high = tree['range']['low'], tree['range']['high']
    ends = [(axis, value) for axis in range(3) for value in (low[axis], high[axis])]
    alone = [tuple(value if i == axis else 0.0 for i in range(3)) for axis, value in ends]
    return [(0.0, 0.0, 0.0), *((dx, dy, theta) for dx, dy, theta in alone)]


def _situation(problem: CertificateProblem, pose: FloatArray) -> Situation:
    rig = problem.rig
    words = f'pose {pose[0]:g} {pose[1]:g} {pose[2]:g}'
    at = Situation.at_pose(rig, problem.inputs, pose, method_of(rig), (words, 'take a smaller one'))
    if not isinstance(at.estimator, ExactEstimator):
        return at
    # As the solver weighs the readings.
    return replace(at, estimator=replace(at.estimator, weights=1.0 / dot_noise_variances(rig)))


def _of_calibration(
    problem: CertificateProblem, poses: FloatArray, gains: FloatArray
) -> tuple[list[InputQuantity], FloatArray]:
    """What the calibration left open, and its correlations."""
    rig = problem.rig
    covariance = known_of_rig(rig).covariance[:ZERO, :ZERO]
    values = vector_of_rig(rig).as_used
    slopes = dots_by_parameters(values, poses.T, rig.link.length)[:, :, :ZERO]
    coefficients = -np.einsum('nic,ncp->npi', gains, slopes)
    sd = np.sqrt(np.diag(covariance))
    freedom = _frames(problem.calibration)
    rows = [
        InputQuantity(CALIBRATION, p.name, True, 'normal', float(u), p.unit, freedom, coefficients[:, i])
        for i, (p, u) in enumerate(zip(ALL[:ZERO], sd.tolist(), strict=True))
    ]
    scale = np.where(sd > 0.0, sd, 1.0)
    return rows, covariance / np.outer(scale, scale)


def _frames(tree: Mapping[str, Any]) -> float:
    """Degrees of freedom of the fit: frames of the reference that counted, less the parameters."""
    reference = tree['reference']
    return float(max(reference['rows'] - reference['outliers'] - len(tree['parameters']), 1))


def _as_found(problem: CertificateProblem, rows: Sequence[InputQuantity]) -> FloatArray:
    """Return the error by the values that were in use before."""
    given = problem.calibration['parameters']
    moved = {name: entry['used'] - entry['value'] for name, entry in given.items()}
    return np.asarray(np.sum([moved.get(row.parameter, 0.0) * row.coefficients for row in rows], axis=0))


def _of_reference(problem: CertificateProblem, poses: FloatArray) -> list[InputQuantity]:
    """The scale of the reference is that of every pose."""
    lengths, angles = poses * [1.0, 1.0, 0.0], poses * [0.0, 0.0, 1.0]
    out = []
    for name, words, slopes in (
        ('reference_scale', 'scale of its lengths', lengths),
        ('reference_angle_scale', 'scale of its angles', angles),
    ):
        u, doubt = problem.inputs[name], problem.inputs['assumption_doubt']
        freedom = 1.0 / (2.0 * doubt**2) if doubt > 0.0 and is_assumed(name, u) else math.inf
        out.append(InputQuantity(REFERENCE, words, False, 'normal', u, '', freedom, slopes))
    return out


def _since_zero(inputs: Mapping[str, float], sights: Sequence[Situation]) -> list[InputQuantity]:
    """Return the causes that no calibration measures."""
    out = []
    for cause in CAUSES:
        if cause.calibrated or cause.kind is Kind.KNOWN:
            continue
        each = [cause.sensitivities(at) for at in sights]
        freedom = cause.freedom(sights[0])
        for per_pose in zip(*each, strict=True):
            first = per_pose[0]
            slopes = np.stack([s.coefficient for s in per_pose])
            words = (cause.name, first.name, cause.observed, cause.distribution.value)
            out.append(InputQuantity(*words, first.deviation, cause.unit, freedom, slopes))
    return out


def _expanded(rows: Sequence[InputQuantity], correlations: FloatArray, pose: int) -> Expanded:
    """At one pose; every cause counts as one."""
    parts = {cause: [row for row in rows if row.cause == cause] for cause in dict.fromkeys(r.cause for r in rows)}
    variances, freedom = [], []
    for cause, cause_rows in parts.items():
        g = np.stack([row.u * row.coefficients[pose] for row in cause_rows])
        together = correlations if cause == CALIBRATION else np.eye(len(cause_rows))
        variances.append(np.einsum('pi,pq,qi->i', g, together, g))
        freedom.append(cause_rows[0].freedom)
    return expanded(np.stack(variances), freedom, np.zeros(3))


class Conformity(NamedTuple):
    """Of one pose: as found and as left, each axis together."""

    as_found: str
    as_left: str

    def tree(self) -> dict[str, str]:
        """For JSON."""
        return {'as_found': self.as_found, 'as_left': self.as_left}


CONFORMS, FAILS, OPEN = 'conforms', 'does not conform', 'not decided'


def verdict_of(as_found: FloatArray, uncertainty: FloatArray, limits: FloatArray) -> Conformity:
    """Guarded acceptance with a guard band of U (JCGM 106:2012, 8.3.2): |error| + U within the limit on every axis.

    It does not conform if |error| - U is beyond the limit on any axis.
    """
    return Conformity(*(_verdict(np.abs(error), uncertainty, limits) for error in (as_found, np.zeros(3))))


def _verdict(error: FloatArray, uncertainty: FloatArray, limits: FloatArray) -> str:
    if bool((error + uncertainty <= limits).all()):
        return CONFORMS
    return FAILS if bool((error - uncertainty > limits).any()) else OPEN
