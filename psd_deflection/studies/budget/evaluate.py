# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The budget: every cause at one situation, the totals, and the Monte Carlo that must agree with them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.studies.budget import environment, installation, sensor
from psd_deflection.studies.budget.chain import measure
from psd_deflection.studies.budget.computation import COMPUTATION
from psd_deflection.studies.budget.expanded import Expanded, expanded
from psd_deflection.studies.budget.term import Cause, Contribution, Kind, Sensitivity, Situation

CAUSES: tuple[Cause, ...] = (*sensor.TERMS, *environment.TERMS, *installation.TERMS, COMPUTATION)
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
