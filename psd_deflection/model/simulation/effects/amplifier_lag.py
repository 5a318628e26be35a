# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The amplifier is a first-order low-pass."""

import math

import numpy as np
from scipy.signal import lfilter

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.modes import LAG_NODES, lag_weights
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import FloatArray


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    tau, p = values['time_constant'], samples.physics
    if samples.t.size == 0 or tau <= 1e-9:
        return
    first, *weights, last = lag_weights(tau, p.period)
    here = samples.between(0.0)
    # What each interval's inputs add at its end, but for the one there.
    added = first * here
    for weight, node in zip(weights, LAG_NODES[1:], strict=False):
        added += weight * samples.between(node * p.period)
    decay = math.exp(-p.period / tau)
    if not state:
        # Settled until the first sample.
        state['added'] = (1.0 - last - decay) * here[:, :1]
        state['lag'] = decay * here[:, :1]
    drive = np.concatenate((state['added'], added[:, :-1]), axis=1) + last * here
    lagging, state['lag'] = lfilter([1.0], [1.0, -decay], drive, zi=state['lag'])
    state['added'] = added[:, -1:]
    samples.volts[:] = lagging if p.phase == 0.0 else _later(samples, lagging, tau)


def _later(samples: SimulatedSamples, lagging: FloatArray, tau: float) -> FloatArray:
    """The output ``phase`` after the samples at which it is ``lagging`` (6, n)."""
    phase = samples.physics.phase
    out = math.exp(-phase / tau) * lagging
    for weight, node in zip(lag_weights(tau, phase), LAG_NODES, strict=True):
        out += weight * samples.between(node * phase)
    return np.asarray(out)


EFFECT = Effect(
    name='amplifier_lag',
    stage='electronics',
    summary='the output lags, first order',
    equation="tau v' = input - v",
    source='amplifier datasheets: bandwidth',
    needs='fast motion (steps, sweeps)',
    parameters=(EffectParameter('time_constant', 's', 0.0, 10.0, 2e-4, 'its time constant'),),
    point='volts',
    apply=_apply,
    order=0,
)
