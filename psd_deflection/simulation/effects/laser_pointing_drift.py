"""One beam wanders steadily."""

from __future__ import annotations

from psd_deflection.simulation.chunk import Chunk
from psd_deflection.simulation.declaration import PSD, Effect, EffectParameter, State, Values


def _apply(chunk: Chunk, values: Values, state: State) -> None:
    i = 2 * (int(values['psd']) - 1)
    chunk.beams[i] += values['rate_x'] * chunk.t
    chunk.beams[i + 1] += values['rate_y'] * chunk.t


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
)
