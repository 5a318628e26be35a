# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The samples of one PSD are late, or early by less than a sample.

Volts between samples come from the model at that time, so a delay of any size is exact, just after a
load step too. No future sample is used: a value before a sample is one after the sample before, and the load that acts
until the next sample is known.
"""

import math

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples


def _bounds(physics: Physics, values: Values) -> tuple[float, float]:
    return 1e-3 * physics.period - physics.period, math.inf


def _check(physics: Physics, values: Values) -> None:
    least = _bounds(physics, values)[0]
    if values['delay'] < least:
        raise ConfigError(
            f'channel_skew: delay = {values["delay"]:g} s: must be at least {least:.3g} s, a sample: a simulation '
            'knows no load ahead of its time'
        )


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    if samples.t.size == 0:
        return
    p = samples.physics
    # Only the delay of another PSD asks for a phase: it takes no reading of this one.
    steps = max((values['delay'] - p.phase) / p.period, 1e-3 - 1.0)
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
    summary="one PSD's samples are late, or a little early",
    equation='v_i(t) -> v_i(t - delay)',
    source='multiplexed converters',
    needs='fast motion (steps, sweeps)',
    parameters=(
        PSD,
        EffectParameter('delay', 's', -0.2, 0.1, 1e-5, 'how late; early by less than a sample if < 0', within=_bounds),
    ),
    point='volts',
    configure=_check,
    apply=_apply,
    order=1,
)
