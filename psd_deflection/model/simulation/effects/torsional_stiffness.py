# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The link is stiffer or softer than the rig file says: GJ."""

from psd_deflection.model.simulation.declaration import MOVES_FREQUENCY, Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics


def _configure(physics: Physics, values: Values) -> None:
    physics.torsional_stiffness *= 1.0 + values['scale']
    if values['moves_frequency']:
        physics.torsion_frequency *= (1.0 + values['scale']) ** 0.5


EFFECT = Effect(
    name='torsional_stiffness',
    stage='link',
    summary='GJ differs from the rig file',
    equation='GJ -> GJ (1 + scale)',
    source='torsion of a tube (thesis A-17, corrected)',
    needs='a known torque',
    parameters=(EffectParameter('scale', '', -0.9, 10.0, 1e-3, 'relative change of GJ'), MOVES_FREQUENCY),
    order=0,
    point='configure',
    configure=_configure,
)
