# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The clamp gives way to torque and adds its own twist."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics


def _configure(physics: Physics, values: Values) -> None:
    physics.clamp_torsion += values['compliance']


EFFECT = Effect(
    name='clamp_torsional_compliance',
    stage='link',
    summary='the clamp twists with the torque',
    equation='θ += compliance Tz',
    source='thesis appendix B, experimental row',
    needs='known torques at two link lengths (at one length it is a change of GJ)',
    parameters=(EffectParameter('compliance', 'rad/(N m)', 0.0, 1e-1, 1e-6, 'twist of the clamp per torque'),),
    order=1,
    point='configure',
    configure=_configure,
    calibrated_as={'compliance': 'clamp.torsional_compliance'},
)
