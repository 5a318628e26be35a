# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The samples of one PSD are late, or early: another clock, or a converter that samples in turn.

Volts between samples come from the model at that time, so a delay of any size is exact, just after a
load step too. A value before a sample is one after the sample before.
"""

import math

import numpy as np

from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples


def _steps(physics: Physics, values: Values) -> tuple[int, float]:
    """By how many samples a reading is late, and the share of a sample by which that is too much."""
    steps = (values['delay'] - physics.phase) / physics.period
    integer = round(steps) if abs(steps - round(steps)) < 1e-9 else math.ceil(steps)
    return integer, max(integer - steps, 0.0)


def _searched(physics: Physics, values: Values) -> tuple[float, float]:
    # Earlier than the nearest sample is what studies.loads.alignment finds first; two early PSDs are late loads.
    return -0.6 * physics.period, 4.0


def _ahead(physics: Physics, values: Values) -> int:
    return max(-_steps(physics, values)[0], 0)


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    if samples.t.size == 0:
        return
    p = samples.physics
    integer, share = _steps(p, values)
    psd = int(values['psd']) - 1
    rows = slice(3 * psd, 3 * psd + 3)
    now = samples.between(share * p.period)[rows]
    if integer < 0:
        samples.volts[rows, :integer] = now[:, -integer:]
        return
    if 'before' not in state:
        # At rest until the first sample.
        state['before'] = np.repeat(samples.between(0.0)[rows, :1], integer, axis=1)
    line = np.concatenate((state['before'], now), axis=1)
    state['before'] = line[:, line.shape[1] - integer :].copy()
    samples.volts[rows] = line[:, : now.shape[1]]


EFFECT = Effect(
    name='channel_skew',
    stage='electronics',
    summary="one PSD's samples are late or early",
    equation='v_i(t) -> v_i(t - delay)',
    source='two clocks; multiplexed converters',
    needs='fast motion (steps, sweeps)',
    parameters=(PSD, EffectParameter('delay', 's', -4.0, 4.0, 1e-5, 'how late; below 0 how early', within=_searched)),
    point='volts',
    apply=_apply,
    ahead=_ahead,
    order=1,
)
