# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The samples of one PSD are late.

Volts between samples come from the model at that time, so a delay of any size is exact, just after a
load step too. No future sample is used: a value before a sample is one after the sample before.
"""

import math

import numpy as np

from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    if samples.t.size == 0:
        return
    p = samples.physics
    steps = (values['delay'] - p.phase) / p.period
    integer = math.ceil(steps)
    if abs(steps - round(steps)) < 1e-9:
        integer = round(steps)
        steps = float(integer)
    psd = int(values['psd']) - 1
    rows = slice(3 * psd, 3 * psd + 3)
    now = samples.between((integer - steps) * p.period)[rows]
    if 'before' not in state:
        # At rest until the first sample.
        state['before'] = np.repeat(samples.between(0.0)[rows, :1], integer, axis=1)
    line = np.concatenate((state['before'], now), axis=1)
    state['before'] = line[:, line.shape[1] - integer :].copy()
    samples.volts[rows] = line[:, : now.shape[1]]


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
