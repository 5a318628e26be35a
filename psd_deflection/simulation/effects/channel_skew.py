"""The samples of one PSD are late.

Values between samples come from a cubic through four samples. Future samples are not used, so a
live device can do the same.
"""

from __future__ import annotations

import math

import numpy as np

from psd_deflection.simulation.chunk import Chunk
from psd_deflection.simulation.declaration import PSD, Effect, EffectParameter, State, Values


def _apply(chunk: Chunk, values: Values, state: State) -> None:
    if chunk.t.size == 0:
        return
    steps = values['delay'] / chunk.physics.period
    whole = math.floor(steps)
    part = steps - whole
    # Four nodes around the wanted time; one-sided if a centred cubic would need the next sample.
    first = whole - 1 if whole >= 1 else 0
    where = steps - first
    psd = int(values['psd']) - 1
    for row in range(3 * psd, 3 * psd + 3):
        now = chunk.volts[row]
        if part == 0.0 and whole == 0:
            continue
        before = state.get(str(row))
        if before is None:
            before = np.full(first + 3, now[0])
        line = np.concatenate((before, now))
        state[str(row)] = line[len(line) - (first + 3) :].copy()
        late = np.zeros(len(now))
        for node in range(4):
            weight = 1.0
            for other in range(4):
                if other != node:
                    weight *= (where - other) / (node - other)
            late += weight * line[3 - node : 3 - node + len(now)]
        chunk.volts[row] = late


EFFECT = Effect(
    name='channel_skew',
    stage='electronics',
    summary="one PSD's samples are late",
    equation='v_i(t) -> v_i(t - delay)',
    source='multiplexed converters',
    needs='fast motion (steps, sweeps)',
    parameters=(
        PSD,
        EffectParameter('delay', 's', 0.0, 0.1, 1e-5, 'how late'),
    ),
    point='volts',
    apply=_apply,
    order=1,
)
