# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The modes lose energy faster or slower than the rig file says."""

import math

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics

RINGS_ON = (3e-4, 1e-3, 3e-3)
"""Ratios at which a mode still moves when the next load is hung."""


def _configure(physics: Physics, values: Values) -> None:
    if not math.isnan(values['bending_ratio']):
        physics.bending_damping_ratio = values['bending_ratio']
    if not math.isnan(values['torsion_ratio']):
        physics.torsion_damping_ratio = values['torsion_ratio']


EFFECT = Effect(
    name='damping',
    stage='link',
    summary='damping ratios differ',
    equation='zeta -> bending_ratio, torsion_ratio',
    source='second-order mode: zeta = c/(2 sqrt(k m))',
    needs='a step or a sweep through the modes',
    parameters=(
        EffectParameter(
            'bending_ratio',
            '',
            0.0,
            0.95,
            1e-3,
            'damping ratio of ΔX and ΔY',
            nominal=math.nan,
            starts=RINGS_ON,
            of_rig='bending_damping_ratio',
        ),
        EffectParameter(
            'torsion_ratio',
            '',
            0.0,
            0.95,
            1e-3,
            'damping ratio of θ',
            nominal=math.nan,
            starts=RINGS_ON,
            of_rig='torsion_damping_ratio',
        ),
    ),
    order=2,
    point='configure',
    configure=_configure,
)
