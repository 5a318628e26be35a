# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The base is not square to the beams: the tip is displaced by a slope times the length."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics


def _configure(physics: Physics, values: Values) -> None:
    physics.static_offset[0] += values['x'] * physics.length
    physics.static_offset[1] += values['y'] * physics.length


EFFECT = Effect(
    name='mount_tilt',
    stage='link',
    summary='the base is tilted against the beams',
    equation='ΔX += x L, ΔY += y L',
    source='geometry: a slope times the length',
    needs='recordings at two lengths, zeroed at one',
    parameters=(
        EffectParameter('x', 'rad', -0.5, 0.5, 1e-6, 'slope of the link toward +X'),
        EffectParameter('y', 'rad', -0.5, 0.5, 1e-6, 'slope of the link toward +Y'),
    ),
    order=5,
    point='configure',
    configure=_configure,
)
