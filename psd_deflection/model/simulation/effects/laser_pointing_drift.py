# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One beam wanders steadily."""

from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    i = 2 * (int(values['psd']) - 1)
    samples.beams[i] += values['rate_x'] * samples.t
    samples.beams[i + 1] += values['rate_y'] * samples.t


EFFECT = Effect(
    name='laser_pointing_drift',
    stage='optics',
    summary='one beam wanders linearly in time',
    equation='l_i += rate t',
    source='laser datasheets: pointing stability',
    needs='time; temperature that is not itself a ramp',
    parameters=(
        PSD,
        EffectParameter('rate_x', 'm/s', -1e-3, 1e-3, 1e-7, 'speed of the beam'),
        EffectParameter('rate_y', 'm/s', -1e-3, 1e-3, 1e-7, 'speed of the beam'),
    ),
    point='beam',
    apply=_apply,
    uses=frozenset({'time'}),
    also=('drift',),
)
