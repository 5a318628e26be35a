# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A further bending mode rings on top of the first."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Traced, Values
from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples

HIGHER = 1.6
"""Smallest ratio to the first mode's frequency: a closer second mode would only mimic the first."""


def _above_the_first(physics: Physics, values: Values) -> tuple[float, float]:
    return HIGHER * physics.bending_frequency, float('inf')


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    for row in range(2):
        key = str(row)
        if key not in state:
            p = samples.physics
            state[key] = Filter(mode_coefficients(values['frequency'], values['damping_ratio'], p.period, p.phase))
            first = mode_coefficients(p.bending_frequency, p.bending_damping_ratio, p.period, p.phase)
            state['first' + key] = Filter(first)
        ringing = state[key](samples.static[row])
        if values['shares'] == 1:
            ringing = ringing - state['first' + key](samples.static[row])
        elif values['shares'] == 2:
            ringing = ringing - samples.static[row]
        samples.pose[row] += values['gain'] * ringing


def _trace_back(block: Traced, values: Values, remembered: list[float]) -> None:
    if values['shares'] == 0:
        block.pose[0] /= 1.0 + values['gain']
        block.pose[1] /= 1.0 + values['gain']


EFFECT = Effect(
    name='second_bending_mode',
    stage='link',
    summary='a second bending mode rings',
    equation="q2'' + 2 zeta w q2' + w^2 q2 = w^2 gain q_static; ΔX, ΔY += q2",
    source='Euler-Bernoulli cantilever: w2/w1 = 6.27',
    needs='steps',
    parameters=(
        EffectParameter('gain', '', -1.0, 1.0, 1e-3, 'its share of the static deflection'),
        EffectParameter(
            'frequency',
            'Hz',
            5.0,
            450.0,
            0.2,
            'its frequency',
            nominal=87.7,
            kind='shape',
            grid=(87.7,),
            propose='spectral',
            within=_above_the_first,
        ),
        EffectParameter(
            'damping_ratio', '', 1e-4, 0.5, 2e-3, 'its damping ratio', nominal=0.02, kind='shape', grid=(0.01,)
        ),
        EffectParameter(
            'shares',
            '',
            0,
            2,
            1,
            '0: adds its own static part, 1: takes it from the first mode, 2: rings only',
            kind='choice',
            choices=(0, 1, 2),
        ),
    ),
    point='pose',
    apply=_apply,
    trace_back=_trace_back,
)
