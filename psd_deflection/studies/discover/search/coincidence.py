"""Effects whose sizes agree too well to be independent: they stand in for one unknown cause.

If the true cause is not in the catalogue, several effects together may explain the data so well that
nothing unknown remains. But then their sizes are tied: a lag of the amplifiers becomes two delays of
equal length, a rotated load becomes two detectors rotated by the same angle. Two hypotheses about
the ratio of two amplitudes are compared. Under "one cause" it is 1 within the uncertainty of the
fit. Under "independent" it may be anywhere within two decades (Jeffreys's prior for a scale).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from psd_deflection.model.simulation.declaration import MOVES_FREQUENCY
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.fit import Fit

DECADES = 2.0
"""Range over which the ratio of two independent sizes is spread."""
ODDS = 20.0
"""Odds for one cause against independent effects, over all pairs compared. By Markov's inequality,
independent effects reach odds of N at most once in N searches.
"""
EXACT = 0.003
"""Relative; no ratio is trusted to better, because a stand-in matches the true cause only approximately."""
_SAME_UNIT: Mapping[str, str] = {'rad': ''}


@dataclass(frozen=True, slots=True)
class Coincidence:
    """Two of the fit's amplitudes, (index of the effect, parameter), that agree; ``odds`` for one cause."""

    first: tuple[int, str]
    second: tuple[int, str]
    sizes: tuple[float, float]
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
            out.append((column, size, _SAME_UNIT.get(p.unit, p.unit)))
    return out


def coincidences(fit: Fit, physics: Physics | None) -> list[Coincidence]:
    """The ties between amplitudes of different effects of ``fit`` that are beyond chance, the strongest first."""
    covariance = fit.covariance()
    sizes = _amplitudes(fit, physics, covariance)
    # What ties two stiffnesses is known, and told by :mod:`.ties`.
    stiff = [MOVES_FREQUENCY in fit.effects[fit.free[size[0]][0]].effect.parameters for size in sizes]
    compared = [
        (a, b)
        for (a, first), (b, second) in itertools.combinations(zip(sizes, stiff, strict=True), 2)
        if fit.free[a[0]][0] != fit.free[b[0]][0] and a[2] == b[2] and not (first and second)
    ]
    out = []
    for (j, a, unit), (k, b, _) in compared:
        slope = np.zeros(len(fit.free))
        slope[j], slope[k] = 1.0 / a, -1.0 / b
        sd = math.hypot(math.sqrt(max(float(slope @ covariance @ slope), 0.0)), EXACT)
        z = math.log(abs(a / b)) / sd
        factor = DECADES * math.log(10.0) / (sd * math.sqrt(2.0 * math.pi)) * math.exp(-0.5 * z * z)
        odds = factor / len(compared)
        if odds >= ODDS:
            out.append(Coincidence(fit.free[j], fit.free[k], (a, b), unit, odds))
    return sorted(out, key=lambda c: -c.odds)
