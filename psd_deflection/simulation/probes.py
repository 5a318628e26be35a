"""A typical size of each effect: what a search starts from and what the tests switch on."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from psd_deflection.simulation.catalogue import ActiveEffect, Effect
from psd_deflection.simulation.physics import Physics


def variants(effect: Effect) -> Iterator[dict[str, float]]:
    """Each combination of the discrete choices, by parameter name."""
    discrete = [p for p in effect.parameters if p.kind == 'choice']
    for combination in itertools.product(*(p.choices for p in discrete)):
        yield {p.name: float(c) for p, c in zip(discrete, combination, strict=True)}


def off_values(effect: Effect, physics: Physics, choice: dict[str, float]) -> dict[str, float]:
    """All parameters at the value where the effect is off."""
    return {p.name: choice.get(p.name, p.off(physics)) for p in effect.parameters}


def typical(effect: Effect, physics: Physics, choice: dict[str, float], size: float = 1.0) -> ActiveEffect:
    """Every amplitude ``size`` scales away from off."""
    values = off_values(effect, physics, choice)
    for p in effect.parameters:
        if p.kind == 'amplitude':
            if p.propose == 'highest':
                values[p.name] = 2.0
            elif effect.finite and p.grid:
                values[p.name] = p.grid[-1]
            else:
                values[p.name] = min(max(values[p.name] + size * p.scale, p.minimum), p.maximum)
        elif p.kind == 'coupled':
            values[p.name] = p.scale
    return ActiveEffect(effect, values)
