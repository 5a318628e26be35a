# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A force that no reading of the load shows always pulls at the tip: the load cell's zero, or what hangs there."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics


def _configure(physics: Physics, values: Values) -> None:
    physics.constant_force[0] += values['x']
    physics.constant_force[1] += values['y']


EFFECT = Effect(
    name='tip_force',
    stage='link',
    summary='a constant force at the tip is not in the annotated load',
    equation='ΔX += x (L^3/(3 EI) + c L^2), ΔY likewise with y, c the compliance of the clamp',
    source='beam theory',
    needs='recordings at two lengths, zeroed at one',
    parameters=(
        EffectParameter('x', 'N', -100.0, 100.0, 0.01, 'force along +X'),
        EffectParameter('y', 'N', -100.0, 100.0, 0.01, 'force along +Y'),
    ),
    order=5,
    point='configure',
    configure=_configure,
)
