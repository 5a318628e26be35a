# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The tip plate leans with the bending slope, so that the beams meet it at an angle (E_Tilt)."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics


def _configure(physics: Physics, values: Values) -> None:
    physics.slope_ratio = values['slope_ratio']


EFFECT = Effect(
    name='plane_tilt',
    stage='optics',
    summary='the tip plate tilts with the bending slope',
    equation='R = Ry(k ΔX/L) Rx(-k ΔY/L) Rz(θ)',
    source='thesis section 2.3, corrected; beam theory',
    needs='large deflection; an even effect',
    parameters=(
        EffectParameter(
            'slope_ratio', '', 0.0, 20.0, 1.5, 'k of φ = -k ΔY/L: 3/2 for a force, 2 for a moment', grid=(1.5,), power=2
        ),
    ),
    point='configure',
    configure=_configure,
    finite=True,
    calibrated_as={'slope_ratio': 'link.slope_ratio'},
    also=('tilt',),
)
