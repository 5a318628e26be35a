# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The link sags under its own weight."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics


def _configure(physics: Physics, values: Values) -> None:
    physics.weight_per_length += values['weight_per_length']


EFFECT = Effect(
    name='self_weight',
    stage='link',
    summary='the link bends under its own weight',
    equation='ΔY -= w L^4/(8 EI) + c w L^3/2, c the compliance of the clamp',
    source='beam theory',
    needs='recordings at two lengths, zeroed at one',
    parameters=(EffectParameter('weight_per_length', 'N/m', 0.0, 1e3, 1e-2, 'weight of the link per length'),),
    order=5,
    point='configure',
    configure=_configure,
)
