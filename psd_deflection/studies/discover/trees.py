# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a search found, as trees of result.json and as sizes for a person (docs/discover.md)."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.studies.discover.laws import FoundLaw
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.weighing import Alternative, NamedEffect, covariance_of


def number(value: float) -> float:
    """For JSON, which has no infinity; for a chi-square or standard deviation 1e300 is as good."""
    if math.isnan(value):
        return 0.0
    return float(min(max(value, -1e300), 1e300))


def parameters_of(effect: NamedEffect | Alternative) -> dict[str, Any]:
    """Choices as numbers, the rest with standard deviation and unit."""
    return fitted(effect.active, effect.sd)


def fitted(active: ActiveEffect, sds: Mapping[str, float]) -> dict[str, Any]:
    """Return the tree of an effect's parameters; ``sds``: their standard deviations."""
    out: dict[str, Any] = {}
    for p in active.effect.parameters:
        value = active.values[p.name]
        if p.kind == 'choice':
            out[p.name] = int(value)
        elif math.isfinite(value):
            out[p.name] = {'value': number(value), 'sd': number(sds.get(p.name, 0.0)), 'unit': p.unit}
    return out


def covariance_tree(fit: Fit, effects: Iterable[NamedEffect]) -> dict[str, Any]:
    """Return the covariance of all amplitudes that were fitted together."""
    names, matrix = covariance_of(fit, tuple(effects))
    return {'names': list(names), 'matrix': [[number(v) for v in row] for row in matrix.tolist()]}


def effect_tree(e: NamedEffect) -> dict[str, Any]:
    """Return an effect of ``effects``."""
    return {
        'name': e.active.effect.name,
        'stage': e.active.effect.stage,
        'parameters': parameters_of(e),
        'equivalent': list(e.equivalent),
        'evidence': {
            'delta_bic': number(e.delta_bic),
            'p': number(e.p),
            'heldout_gain': number(e.heldout.gain),
            'heldout_gain_error': number(e.heldout.error),
        },
        'suggested_experiment': None if e.suggestion is None else e.suggestion.text,
        'rivals': [
            {'name': r.active.effect.name, 'parameters': parameters_of(r), 'delta_bic': number(r.delta_bic)}
            for r in e.fitted_alternatives
        ],
    }


def law_tree(found_law: FoundLaw) -> dict[str, Any]:
    """Return the tree of ``law``."""
    law = found_law.law
    return {
        'stage': law.stage,
        'acts_on': law.acts_on,
        'channels': list(found_law.channels),
        'variables': list(law.variables),
        'kind': law.kind,
        'expression': law.expression,
        'further': [e.expression for e in found_law.further],
        'heldout_after': found_law.heldout_gap,
        'beside': [a.label for a in found_law.beside],
        'equivalent': [
            {'stage': e.stage, 'acts_on': e.acts_on, 'variables': list(e.variables), 'expression': e.expression}
            for e in found_law.equivalent
        ],
        'evidence': {
            'delta_bic': number(found_law.delta_bic),
            'p': number(found_law.p),
            'heldout_gain': number(found_law.heldout.gain),
            'heldout_gain_error': number(found_law.heldout.error),
        },
    }


def size_of(effect: NamedEffect | Alternative) -> str:
    """Return the fitted amplitudes with their standard deviations, for a person: ``angle 0.00399 ± 2e-05 rad``."""
    out = []
    for p in effect.active.effect.parameters:
        value, sd = effect.active.values[p.name], effect.sd.get(p.name, 0.0)
        if p.kind == 'amplitude' and p.name in effect.sd and abs(value) > 2.0 * sd:
            digits = 1 if sd <= 0.0 else 2 + math.floor(math.log10(abs(value) / sd))
            out.append(f'{p.name} {value:.{min(digits, 6)}g} ± {sd:.1g} {p.unit}'.rstrip())
    return ', '.join(out)
