"""The amplifier is a first-order low-pass."""

from __future__ import annotations

from psd_deflection.simulation.chunk import Chunk
from psd_deflection.simulation.declaration import Effect, EffectParameter, State, Values
from psd_deflection.simulation.modes import Filter, lag_coefficients


def _apply(chunk: Chunk, values: Values, state: State) -> None:
    if chunk.t.size == 0 or values['time_constant'] <= 1e-9:
        return
    for row in range(6):
        key = str(row)
        if key not in state:
            state[key] = Filter(
                lag_coefficients(values['time_constant'], chunk.physics.period), float(chunk.volts[row, 0])
            )
        chunk.volts[row] = state[key](chunk.volts[row])


EFFECT = Effect(
    name='amplifier_lag',
    stage='electronics',
    summary='the output lags, first order',
    equation="tau v' = input - v",
    source='amplifier datasheets: bandwidth',
    needs='fast motion (steps, sweeps)',
    parameters=(EffectParameter('time_constant', 's', 0.0, 10.0, 1e-5, 'its time constant'),),
    point='volts',
    apply=_apply,
    order=0,
)
