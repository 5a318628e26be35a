# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The expanded uncertainty of a measurement as the GUM has it (JCGM 100:2008), and Monte Carlo beside it (JCGM 101).

The standard uncertainty of an axis is u_c, u_c^2 the sum of the causes' variances u_i^2. Each u_i is known with its
own degrees of freedom nu_i; those of u_c are

    nu_eff = u_c^4 / sum_i u_i^4 / nu_i                                                 (Welch-Satterthwaite, G.2b)

truncated to an integer as G.4.1 allows and spreadsheets do. U = k u_c, k the quantile of Student's t for 95 %. A known
bias that nobody corrects is not random: its size is added, U = k u_c + |b| (F.2.4.5).

A cause counts as one: the deviations of its error parameters come from one input, and are known as well as that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from psd_deflection.records import FloatArray

PROBABILITY = 0.95
"""Coverage probability of U."""


class Expanded(NamedTuple):
    """Of dX, dY, theta, (3,) each: m, m, rad.

    ``standard``: u_c. ``freedom``: nu_eff as it is used, a whole number or infinite. ``factor``: k. ``bias``: not
    corrected. ``uncertainty``: U.
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
