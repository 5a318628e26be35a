# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The mains hum on the channels (E_EMF)."""

import math

import numpy as np

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import MOST_PSDS, channel_names


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    angle = 2.0 * math.pi * values['frequency'] * samples.t
    c, s = np.cos(angle), np.sin(angle)
    for row, name in enumerate(channel_names(len(samples.volts) // 3)):
        size, phase = values.get(f'amplitude_{name}', 0.0), values.get(f'phase_{name}', 0.0)
        if size != 0.0:
            samples.volts[row] += size * (math.cos(phase) * s + math.sin(phase) * c)


def _of_psd(channel: str) -> int:
    number = int(channel[-1])
    return number if number > 2 else 0


_CHANNELS = channel_names(MOST_PSDS)
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
        *(
            EffectParameter(f'amplitude_{c}', 'V', -10.0, 10.0, 1e-3, f'its size on {c}', of_psd=_of_psd(c))
            for c in _CHANNELS
        ),
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
                of_psd=_of_psd(c),
            )
            for c in _CHANNELS
        ),
    ),
    point='volts',
    apply=_apply,
    order=2,
    also=('hum', 'mains'),
)
