"""Effects that agree in size as independent ones hardly would: one cause that the catalogue lacks.

Where the true cause is not in the catalogue, several effects together may do its work, so well that
nothing unknown remains to be seen. What gives them away is that their sizes are tied: a lag of the
amplifiers becomes two delays of the same length, a turned load two detectors turned alike. The ratio
of two amplitudes is weighed under "one cause", where it is 1 to within what the fit can tell, against
"independent", where it may lie anywhere within two decades (Jeffreys's prior of a scale).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from psd_deflection.discovery.fit import Fit
from psd_deflection.records import FloatArray
from psd_deflection.simulation.physics import Physics

DECADES = 2.0
"""Over which the ratio of two independent sizes spreads."""
ODDS = 20.0
"""For one cause against independent effects, over all pairs compared; by Markov's inequality
independent effects come to this at most once in as many searches."""
EXACT = 0.003
"""Relative; no ratio is trusted to better, since a stand-in does the work of another only nearly."""
_SAME_UNIT: Mapping[str, str] = {'rad': ''}


@dataclass(frozen=True, slots=True)
class Coincidence:
    """Two of the fit's amplitudes, (index of the effect, parameter), that agree; ``odds`` for one cause."""

    first: tuple[int, str]
    second: tuple[int, str]
    sizes: tuple[float, float]
    unit: str
    odds: float


def _amplitudes(fit: Fit, physics: Physics, covariance: FloatArray) -> list[tuple[int, float, str]]:
    """Column, distance from off and unit of every amplitude that stands clear of zero."""
    out = []
    for column, (i, name) in enumerate(fit.free):
        p = fit.effects[i].effect.parameter(name)
        size = fit.effects[i].values[name] - p.off(physics)
        clear = abs(size) > 5.0 * math.sqrt(max(float(covariance[column, column]), 0.0))
        if p.kind == 'amplitude' and clear and not fit.effects[i].effect.finite:
            out.append((column, size, _SAME_UNIT.get(p.unit, p.unit)))
    return out


def coincidences(fit: Fit, physics: Physics) -> list[Coincidence]:
    """The ties between amplitudes of different effects of ``fit`` that are beyond chance, the strongest first."""
    covariance = fit.covariance()
    sizes = _amplitudes(fit, physics, covariance)
    compared = [
        (a, b) for a, b in itertools.combinations(sizes, 2) if fit.free[a[0]][0] != fit.free[b[0]][0] and a[2] == b[2]
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
