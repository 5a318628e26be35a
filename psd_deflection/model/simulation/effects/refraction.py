# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Air of another temperature bends both beams alike (E_RF)."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    samples.beams[0::2] += values['x'] * samples.warmer
    samples.beams[1::2] += values['y'] * samples.warmer


EFFECT = Effect(
    name='refraction',
    stage='optics',
    summary='both dots move with temperature',
    equation='l_i += (x, y) (T - T0)',
    source='thesis 3.2; Edlen, 3.3 corrected',
    needs='a change of temperature',
    parameters=(
        EffectParameter('x', 'm/K', -1e-3, 1e-3, 1e-7, 'shift of both beams'),
        EffectParameter('y', 'm/K', -1e-3, 1e-3, 1e-7, 'shift of both beams'),
    ),
    point='beam',
    apply=_apply,
    uses=frozenset({'temperature'}),
)
