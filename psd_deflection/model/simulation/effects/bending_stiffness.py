# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The link is stiffer or softer than the rig file says: EI."""

from psd_deflection.model.simulation.declaration import MOVES_FREQUENCY, Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics


def _configure(physics: Physics, values: Values) -> None:
    physics.bending_stiffness *= 1.0 + values['scale']
    if values['moves_frequency']:
        physics.bending_frequency *= (1.0 + values['scale']) ** 0.5


EFFECT = Effect(
    name='bending_stiffness',
    stage='link',
    summary='EI differs from the rig file',
    equation='EI -> EI (1 + scale)',
    source='beam theory (thesis appendix A)',
    needs='a known force',
    parameters=(EffectParameter('scale', '', -0.9, 10.0, 1e-3, 'relative change of EI'), MOVES_FREQUENCY),
    order=0,
    point='configure',
    configure=_configure,
    also=('stiffness',),
)
