"""The clamp sticks: the deflection lags behind the load by half a loop, whichever way it moves.

A play operator y <- min(max(y, x - r), x + r) of half width r. Each sample clamps the state, and a
composition of clamps is a clamp. So a prefix scan computes the whole chunk without a loop.
"""

from __future__ import annotations

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.simulation.chunk import Chunk
from psd_deflection.simulation.declaration import Effect, EffectParameter, State, Values


def play(x: FloatArray, half_width: float, start: float) -> FloatArray:
    """Play operator over (n,) inputs from state ``start``; exact selections, no rounding of its own."""
    moved = np.flatnonzero(np.diff(x)) + 1
    kept = np.concatenate(([0], moved))
    low, high = x[kept] - half_width, x[kept] + half_width
    reach = 1
    while reach < len(kept):
        low0, high0 = low[:-reach], high[:-reach]
        low1, high1 = low[reach:], high[reach:]
        low = np.concatenate((low[:reach], np.minimum(np.maximum(low0, low1), high1)))
        high = np.concatenate((high[:reach], np.minimum(np.maximum(high0, low1), high1)))
        reach *= 2
    settled = np.minimum(np.maximum(start, low), high)
    return np.repeat(settled, np.diff(np.concatenate((kept, [len(x)]))))


def _apply(chunk: Chunk, values: Values, state: State) -> None:
    if chunk.t.size == 0 or values['width'] <= 0.0:
        return
    axis = int(values['axis'])
    for row, on, lever in (
        (0, axis != 2, chunk.physics.length),
        (1, axis != 2, chunk.physics.length),
        (2, axis != 1, 1.0),
    ):
        if on:
            lagging = play(chunk.static[row], 0.5 * values['width'] * lever, state.get(str(row), 0.0))
            state[str(row)] = float(lagging[-1])
            chunk.static[row] = lagging


EFFECT = Effect(
    name='clamp_friction',
    stage='link',
    summary='play or stick in the clamp: a hysteresis loop',
    equation='deflection = play(static deflection, width/2), times L in bending',
    source='Visintin, Differential Models of Hysteresis, 1994: play operator',
    needs='loads that rise and fall through the same level',
    parameters=(
        EffectParameter('width', 'rad', 0.0, 0.1, 1e-5, 'full width of the loop, as an angle of the clamp'),
        EffectParameter(
            'axis', '', 1, 3, 1, '1: bending, 2: torsion, 3: both', nominal=3, kind='choice', choices=(1, 2, 3)
        ),
    ),
    point='static',
    apply=_apply,
    order=3,
)
