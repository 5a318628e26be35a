# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The budget: every cause at one situation, E_C of the method itself, totals and expanded uncertainty, and the Monte
Carlo that must agree (JCGM 100:2008, JCGM 101)."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from psd_deflection.base.errors import ConfigError
from psd_deflection.records import FloatArray
from psd_deflection.studies.budget import installation, sensor
from psd_deflection.studies.budget.chain import MeasuringChain, measure
from psd_deflection.studies.budget.term import Cause, Contribution, Kind, Sensitivity, Situation

PROBABILITY = 0.95
"""Coverage probability of U."""


class Expanded(NamedTuple):
    """Of dX, dY, theta, (3,) each: m, m, rad.

    ``standard``: u_c. ``freedom``: nu_eff as it is used, a whole number or infinite. ``factor``: k. ``bias``: not
    corrected. ``uncertainty``: U.

    The standard uncertainty of an axis is u_c, u_c^2 the sum of the causes' variances u_i^2. Each u_i is known with its
    own degrees of freedom nu_i; those of u_c are

        nu_eff = u_c^4 / sum_i u_i^4 / nu_i                                                 (Welch-Satterthwaite, G.2b)

    truncated to an integer as G.4.1 allows and spreadsheets do. U = k u_c, k the quantile of Student's t for 95 %. A
    known bias that nobody corrects is not random: its size is added, U = k u_c + |b| (F.2.4.5).

    A cause counts as one: the deviations of its error parameters come from one input, and are known as well as that.
    """

    standard: FloatArray
    freedom: FloatArray
    factor: FloatArray
    bias: FloatArray
    uncertainty: FloatArray


def effective_freedom(variances: Sequence[float], freedom: Sequence[float]) -> float:
    """nu_eff of a sum of ``variances``, each with its degrees of ``freedom``, down to a whole number; 1 at least."""
    doubt = math.fsum(v * v / n for v, n in zip(variances, freedom, strict=True))
    if doubt <= 0.0:
        return math.inf
    return float(max(math.floor(math.fsum(variances) ** 2 / doubt), 1))


def coverage_factor(freedom: float) -> float:
    """k for ``PROBABILITY``."""
    return float(student.ppf(0.5 + 0.5 * PROBABILITY, freedom))


def expanded(variances: FloatArray, freedom: Sequence[float], bias: FloatArray) -> Expanded:
    """``variances`` (n, 3) of n independent causes, their degrees of ``freedom`` (n,), the sum of known biases (3,)."""
    variance_rows: FloatArray = np.asarray(variances, dtype=np.float64).reshape(-1, 3)
    standard = np.sqrt(variance_rows.sum(axis=0))
    effective = np.array([effective_freedom(column.tolist(), freedom) for column in variance_rows.T])
    factor = np.array([coverage_factor(v) for v in effective.tolist()])
    return Expanded(standard, effective, factor, bias, factor * standard + np.abs(bias))


class Interval(NamedTuple):
    """What draws of all causes say: ``half`` (3,), half the width of the 95 % interval; ``middle`` (3,) of it."""

    half: FloatArray
    middle: FloatArray


def interval_of(errors: FloatArray) -> Interval:
    """Return the probabilistically symmetric interval (JCGM 101:2008, 7.7) of drawn ``errors`` (n, 3)."""
    tail = 0.5 - 0.5 * PROBABILITY
    low, high = np.quantile(errors, [tail, 1.0 - tail], axis=0)
    return Interval(0.5 * (high - low), 0.5 * (high + low))


def difference(expanded: Expanded, drawn: Interval) -> FloatArray:
    """(3,): by how much of the drawn half width k u_c is larger than that; 0 if nothing was drawn."""
    stated = expanded.factor * expanded.standard
    return np.asarray(np.divide(stated - drawn.half, drawn.half, out=np.zeros(3), where=drawn.half > 0.0))


def stop_window(beams: FloatArray, tolerance: float) -> float:
    """Distance from the true angle at which both 3.9 and 3.10 first hold, rad: tolerance / max(|E_x|, |E_y|)."""
    base = np.abs(beams[0] - beams[1])
    return tolerance / float(base.max())


def _iteration(at: Situation) -> Contribution:
    twist = float(at.pose[2])
    window, step = stop_window(at.rig.centers + at.rig.zeros, at['iteration_tolerance']), at['iteration_step']
    if window < step / 2.0:
        raise ConfigError(
            f'iteration_tolerance = {at["iteration_tolerance"]:g} m: its window of ±{window:g} rad is narrower than '
            f'iteration_step = {step:g} rad: the iteration may step over it; take a finer step'
        )
    # The first trial inside the window is uniform within one step of its edge.
    short, deviation = window - step / 2.0, step / math.sqrt(12.0)
    if abs(twist) <= window:
        short, deviation = abs(twist), 0.0
    # The thesis takes d from PSD 1: d = l_1 - R(theta) q_1, so an angle error moves it by that
    # angle times l_1 - d.
    arm = at.rig.centers[0] + at.rig.zeros[0] - at.pose[:2]
    response = np.array([arm[1], -arm[0], 1.0])
    return Contribution(-math.copysign(short, twist) * response, deviation**2 * np.outer(response, response))


class Computation(Cause):
    """E_C of the chosen method."""

    name = 'computation'
    row = 'E_C'
    kind = Kind.KNOWN
    formula = (
        "the method's answer to perfect readings of its own model, less the truth; thesis_iteration: its stop rule"
    )
    inputs = ('iteration_tolerance', 'iteration_step')

    def contribution(self, at: Situation) -> Contribution:
        """As declared; the stop rule leaves a bias and, because of its grid, a small random part."""
        if at.method == 'thesis_iteration':
            return _iteration(at)
        return Contribution(perfect_answer(at) - at.pose, np.zeros((3, 3)))

    def without(self, chain: MeasuringChain, at: Situation) -> MeasuringChain:
        """As declared: the chain is unchanged."""
        return chain

    def perturb(
        self, chain: MeasuringChain, at: Situation, count: int, random: np.random.Generator, *, shaped: bool = False
    ) -> MeasuringChain:
        """As declared."""
        return chain

    def beside(self, at: Situation, count: int, random: np.random.Generator) -> FloatArray:
        """As declared."""
        bias, covariance = self.contribution(at)
        return np.asarray(random.multivariate_normal(bias, covariance, size=count, method='svd'))


COMPUTATION = Computation()


def perfect_answer(at: Situation) -> FloatArray:
    """(3,): the estimator's answer if the chain is as the estimator models it."""
    chain = replace(at.chain, slope_ratio=np.array([at.estimator.slope_ratio]))
    return np.asarray(at.estimator.estimate(*measure(chain, at.pose))[0])


CAUSES: tuple[Cause, ...] = (*sensor.TERMS, *installation.ENVIRONMENT, *installation.INSTALLATION, COMPUTATION)
"""Every line of the budget."""

_CHUNK = 10_000
"""Number of draws computed at once; it limits memory."""


@dataclass(frozen=True, eq=False)
class Budget:
    """Contributions of all causes at ``at``, in the order of ``CAUSES``."""

    at: Situation
    lines: tuple[tuple[Cause, Contribution], ...]

    def total(self, *kinds: Kind) -> Contribution:
        """Sum over the causes of these kinds (none named: all): biases with their signs, covariances."""
        chosen = [c for cause, c in self.lines if not kinds or cause.kind in kinds]
        bias = np.sum([c.bias for c in chosen], axis=0, dtype=np.float64) + np.zeros(3)
        covariance = np.sum([c.covariance for c in chosen], axis=0, dtype=np.float64) + np.zeros((3, 3))
        return Contribution(bias, covariance)

    @functools.cached_property
    def sensitivities(self) -> tuple[list[Sensitivity], ...]:
        """Those of each line, computed once: every report of a budget has the same digits."""
        return tuple(cause.sensitivities(self.at) for cause, _ in self.lines)

    def expanded(self) -> Expanded:
        """Return the expanded uncertainty of an estimate, every cause as it is declared."""
        variances = np.array([np.diag(line.covariance) for _, line in self.lines])
        return expanded(variances, [cause.freedom(self.at) for cause, _ in self.lines], self.total().bias)

    def shares(self, line: Contribution) -> FloatArray:
        """(3,): mean square of a line over the total's, for dX, dY, theta.

        They add to 1 except for products of biases, which belong to no single line.
        """
        total_variance = self.total().rms ** 2
        return np.asarray(np.divide(line.rms**2, total_variance, out=np.zeros(3), where=total_variance > 0.0))


def evaluate(at: Situation) -> Budget:
    """Return every cause, to first order."""
    return Budget(at, tuple((cause, cause.contribution(at)) for cause in CAUSES))


def monte_carlo(
    at: Situation,
    count: int,
    seed: int,
    causes: Sequence[Cause] = CAUSES,
    drawn: Callable[[int], object] = lambda size: None,
) -> Contribution:
    """Mean error and covariance of ``count`` draws of all ``causes`` at once.

    Errors are normal; otherwise as :func:`draws` has it.
    """
    everything = draws(at, count, seed, causes, drawn)
    return Contribution(everything.mean(axis=0), np.cov(everything.T))


def draws(
    at: Situation,
    count: int,
    seed: int,
    causes: Sequence[Cause] = CAUSES,
    drawn: Callable[[int], object] = lambda size: None,
    *,
    shaped: bool = False,
) -> FloatArray:
    """Errors (count, 3) of draws of all ``causes`` at once; ``shaped``: each of its declared distribution.

    It uses the exact chain and the exact estimator; nothing is linearised. All other causes are
    absent, including the tilt of the tip. Errors are relative to the answer without ``causes``.
    ``drawn`` is called with the number of draws just done.
    """
    random = np.random.default_rng(seed)
    plain = at.chain
    for cause in causes:
        plain = cause.without(plain, at)
    nothing = at.estimator.estimate(*measure(plain, at.pose))[0]
    errors = []
    for start in range(0, count, _CHUNK):
        size = min(_CHUNK, count - start)
        chain, beside = at.chain, np.zeros((size, 3))
        for cause in causes:
            chain = cause.perturb(chain, at, size, random, shaped=shaped)
            beside = beside + cause.beside(at, size, random)
        errors.append(at.estimator.estimate(*measure(chain, at.pose)) - nothing + beside)
        drawn(size)
    return np.concatenate(errors)
