# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A PSD's centre is not where the rig file says."""

from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics


def _configure(physics: Physics, values: Values) -> None:
    i = int(values['psd']) - 1
    physics.centers[i, 0] += values['x']
    physics.centers[i, 1] += values['y']
    if values['aimed']:
        physics.beams[i, 0] += values['x']
        physics.beams[i, 1] += values['y']


EFFECT = Effect(
    name='sensor_position',
    stage='psd',
    summary="a PSD's centre is not where the rig file says",
    equation='c_i += (x, y), and l_i with it where the laser was aimed',
    source='thesis chapter 3',
    needs='twist',
    parameters=(
        PSD,
        EffectParameter('x', 'm', -0.5, 0.5, 1e-4, 'centre, from where the rig file has it'),
        EffectParameter('y', 'm', -0.5, 0.5, 1e-4, 'centre, from where the rig file has it'),
        EffectParameter(
            'aimed',
            '',
            0,
            1,
            1,
            '1: the laser was aimed at the true centre; 0: it stands where the rig file says',
            nominal=1,
            kind='choice',
            choices=(1, 0),
        ),
    ),
    point='configure',
    configure=_configure,
    calibrated_as={'x': 'center_x', 'y': 'center_y', 'aimed': 'aimed'},
)
