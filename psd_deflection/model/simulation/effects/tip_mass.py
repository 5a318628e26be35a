# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A mass at the tip that is missing from the rig file lowers the bending frequency."""

import math

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics


def _configure(physics: Physics, values: Values) -> None:
    omega = 2.0 * math.pi * physics.bending_frequency
    modal = 1.0 / (physics.force_compliance * omega**2)
    physics.bending_frequency *= math.sqrt(modal / (modal + values['mass']))


EFFECT = Effect(
    name='tip_mass',
    stage='link',
    summary='an added tip mass lowers the bending frequency',
    equation='m0 = k/w^2, w -> w sqrt(m0/(m0 + mass))',
    source='Rayleigh',
    needs='a step or a sweep through the bending mode',
    parameters=(EffectParameter('mass', 'kg', 0.0, 100.0, 1e-3, 'added mass at the tip'),),
    order=2,
    point='configure',
    configure=_configure,
)
