# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The clamp gives way to the root moment and turns the whole link."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics


def _configure(physics: Physics, values: Values) -> None:
    physics.clamp_bending += values['compliance']


EFFECT = Effect(
    name='clamp_bending_compliance',
    stage='link',
    summary='the clamp turns with the root moment',
    equation='slope at the root = compliance F L; tip += L times that',
    source='thesis appendix B, experimental row: root rotation',
    needs='known forces at two link lengths (at one length it is a change of EI)',
    parameters=(EffectParameter('compliance', 'rad/(N m)', 0.0, 1e-2, 1e-7, 'turn of the clamp per root moment'),),
    order=1,
    point='configure',
    configure=_configure,
    calibrated_as={'compliance': 'clamp.bending_compliance'},
)
