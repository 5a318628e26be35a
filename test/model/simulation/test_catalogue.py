# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The catalogue as rig files rely on it: names, order, bounds, defaults, choices; and where a search looks."""

from __future__ import annotations

from pathlib import Path

from psd_deflection.model.simulation.catalogue import catalogue, sort_effects
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.rig.config import load_rig

TABLE = Path(__file__).parents[2] / 'data' / 'effects.txt'


def lines_of(effect: Effect) -> list[str]:
    out = [f'{effect.name}: {effect.stage} {effect.order}, at {effect.point}' + ', finite' * effect.finite]
    for p in effect.parameters:
        low, high = (f'{v:.6g}' for v in (p.minimum, p.maximum))
        words = [
            f'{p.kind}, {low} to {high} {p.unit}'.rstrip(),
            f'default {p.of_rig or f"{p.nominal:g}"}',
            f'probe {p.scale:g}',
        ]
        words += ['required'] * p.required + ['each'] * p.each + [f'power {p.power}'] * bool(p.power)
        words += [f'choices {" ".join(map(str, p.choices))}'] * bool(p.choices)
        words += [f'tried {" ".join(f"{v:g}" for v in p.grid)}'] * bool(p.grid)
        words += [f'with {p.partner}'] * bool(p.partner)
        words += [f'from {" ".join(p.proposed_by(c) for c in effect.variants())}'] * bool(p.propose)
        out.append(f'  {p.name}: ' + ', '.join(words))
    return out


def test_the_catalogue_is_the_one_that_rig_files_know() -> None:
    """In the order in which effects act. An effect that is added is held by its second formula, not by this table."""
    physics = Physics.of(load_rig())
    table = TABLE.read_text()
    known = [line.partition(':')[0] for line in table.splitlines() if not line.startswith(' ')]
    every = [ActiveEffect(e, e.off_values(physics, next(e.variants()))) for e in catalogue().values()]
    got = [line for a in sort_effects(every) if a.effect.name in known for line in lines_of(a.effect)]
    assert '\n'.join(got) + '\n' == table
