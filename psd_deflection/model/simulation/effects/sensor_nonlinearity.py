# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A PSD reads more (or less) the farther the dot is from its centre (E_R)."""

from psd_deflection.model.detector.response import grown, shrunk
from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, Reading, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    i = 2 * (int(values['psd']) - 1)
    dots = samples.dots
    dots[i], dots[i + 1] = grown(dots[i], dots[i + 1], values['k'])


def _correct(reading: Reading, values: Values) -> None:
    i = 2 * (int(values['psd']) - 1)
    dots = reading.dots
    dots[i], dots[i + 1] = shrunk(dots[i], dots[i + 1], values['k'], reading.xp)


EFFECT = Effect(
    name='sensor_nonlinearity',
    stage='psd',
    summary='the reading grows with the distance from the centre',
    equation='x -> x (1 + k r^2), y likewise',
    source='Hamamatsu S1880 datasheet: position detection error; thesis E_R',
    needs='dots far from the centre',
    parameters=(PSD, EffectParameter('k', '1/m^2', -1e4, 1e5, 100.0, 'cubic coefficient')),
    point='dots',
    apply=_apply,
    correct=_correct,
    order=3,
    calibrated_as={'k': 'nonlinearity'},
)
