"""The mains hum on the channels (E_EMF)."""

from __future__ import annotations

import math

import numpy as np

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import CHANNELS


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    angle = 2.0 * math.pi * values['frequency'] * samples.t
    c, s = np.cos(angle), np.sin(angle)
    for row, name in enumerate(CHANNELS):
        size, phase = values['amplitude_' + name], values['phase_' + name]
        if size != 0.0:
            samples.volts[row] += size * (math.cos(phase) * s + math.sin(phase) * c)


EFFECT = Effect(
    name='mains_interference',
    stage='electronics',
    summary='a sinusoid on the channels',
    equation='v += amplitude sin(2 pi f t + phase)',
    source='thesis E_EMF',
    needs='nothing',
    parameters=(
        EffectParameter(
            'frequency',
            'Hz',
            0.5,
            499.0,
            2e-3,
            'its frequency',
            nominal=50.0,
            kind='shape',
            grid=(50.0, 60.0),
            propose='line',
        ),
        *(EffectParameter(f'amplitude_{c}', 'V', -10.0, 10.0, 1e-3, f'its size on {c}') for c in CHANNELS),
        *(
            EffectParameter(
                f'phase_{c}',
                'rad',
                -2.0 * math.pi,
                2.0 * math.pi,
                0.1,
                f'its phase on {c}',
                kind='phase',
                partner=f'amplitude_{c}',
            )
            for c in CHANNELS
        ),
    ),
    point='volts',
    apply=_apply,
    order=2,
)
