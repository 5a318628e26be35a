# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects whose sizes agree too well to be independent: they stand in for one unknown cause.

If the true cause is not in the catalogue, several effects together may explain the data so well that
nothing unknown remains. But then their sizes are tied: a lag of the amplifiers becomes two delays of
equal length, a rotated load becomes two detectors rotated by the same angle, a mass at the tip a
softer link and two detectors that read as much too little. Two hypotheses about the ratios of two or
three amplitudes of one unit are compared. Under "one cause" they are 1 within the uncertainty of the fit. Under
"independent" each may be anywhere within two decades (Jeffreys's prior for a scale).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.model.simulation.declaration import MOVES_FREQUENCY
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.fit import Fit

DECADES = 2.0
"""Range over which the ratio of two independent sizes is spread."""
ODDS = 20.0
"""Odds for one cause against independent effects, over all pairs or triples compared. By Markov's inequality,
independent effects reach odds of N at most once in N searches.
"""
EXACT = 0.003
"""Relative; no ratio is trusted to better, because a stand-in matches the true cause only approximately."""


@dataclass(frozen=True, slots=True)
class Coincidence:
    """Amplitudes of the fit, (index of the effect, parameter), whose ``sizes`` agree; ``odds`` for one cause."""

    members: tuple[tuple[int, str], ...]
    sizes: tuple[float, ...]
    unit: str
    odds: float


def _amplitudes(fit: Fit, physics: Physics | None, covariance: FloatArray) -> list[tuple[int, float, str]]:
    """Column, distance from off and unit of every amplitude that is significantly different from zero."""
    out = []
    for column, (i, name) in enumerate(fit.free):
        if i < 0:
            continue
        p = fit.effects[i].effect.parameter(name)
        size = fit.effects[i].values[name] - p.off(physics)
        clear = abs(size) > 5.0 * math.sqrt(covariance[column, column])
        if p.kind == 'amplitude' and clear and not fit.effects[i].effect.finite:
            out.append((column, size, p.unit))
    return out


def coincidences(fit: Fit, physics: Physics | None) -> list[Coincidence]:
    """The ties between amplitudes of different effects of ``fit`` that are beyond chance, the strongest first."""
    covariance = fit.covariance()
    sizes = _amplitudes(fit, physics, covariance)
    out = []
    for count in (2, 3):
        compared = [group for group in itertools.combinations(sizes, count) if _may_coincide(fit, group)]
        for group in compared:
            odds = _odds(group, covariance) / len(compared)
            if odds >= ODDS:
                members = tuple(fit.free[column] for column, _, _ in group)
                out.append(Coincidence(members, tuple(size for _, size, _ in group), group[0][2], odds))
    return sorted(out, key=lambda c: -c.odds)


def _may_coincide(fit: Fit, group: Sequence[tuple[int, float, str]]) -> bool:
    """Return whether these amplitudes are of different effects and of one unit, and no known cause ties them."""
    effects = [fit.free[column][0] for column, _, _ in group]
    # What ties two stiffnesses is known, and told by :mod:`.ties`.
    stiff = [i for i in effects if MOVES_FREQUENCY in fit.effects[i].effect.parameters]
    return len(set(effects)) == len(group) == len([g for g in group if g[2] == group[0][2]]) and len(stiff) < 2


def _odds(group: Sequence[tuple[int, float, str]], covariance: FloatArray) -> float:
    """Odds that the sizes of ``group`` are one against independent ones, of this group alone."""
    columns, sizes = [g[0] for g in group], np.array([g[1] for g in group])
    of_logs = covariance[np.ix_(columns, columns)] / np.outer(sizes, sizes)
    # The logarithm of the first less those of the others.
    less = np.column_stack((np.ones(len(group) - 1), -np.eye(len(group) - 1)))
    size_covariance = less @ (of_logs + 0.5 * EXACT**2 * np.eye(len(group))) @ less.T
    off = less @ np.log(np.abs(sizes))
    density = math.exp(-0.5 * float(off @ np.linalg.solve(size_covariance, off))) / math.sqrt(
        np.linalg.det(2.0 * np.pi * size_covariance)
    )
    return float((DECADES * math.log(10.0)) ** len(off) * density)
