"""A PSD reads more (or less) the farther the dot is from its centre (E_R)."""

from __future__ import annotations

import math

import numpy as np

from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, Reading, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    i = 2 * (int(values['psd']) - 1)
    grown = 1.0 + values['k'] * (samples.dots[i] ** 2 + samples.dots[i + 1] ** 2)
    samples.dots[i] *= grown
    samples.dots[i + 1] *= grown


def _correct(reading: Reading, values: Values) -> None:
    i = 2 * (int(values['psd']) - 1)
    k = values['k']
    read = reading.by.hypot_many(reading.dots[i], reading.dots[i + 1])
    # With k < 0 the reading falls again farther out: no dot is sought where its slope is below a tenth.
    farthest = math.sqrt(0.3 / -k) if k < 0.0 else math.inf
    true = np.minimum(read, farthest)
    for _ in range(6):
        # Newton on true (1 + k true^2) = read; six steps reach rounding anywhere on a sensor.
        true = np.minimum(true - (true * (1.0 + k * true**2) - read) / (1.0 + 3.0 * k * true**2), farthest)
    grown = 1.0 + k * true**2
    reading.dots[i] /= grown
    reading.dots[i + 1] /= grown


EFFECT = Effect(
    name='sensor_nonlinearity',
    stage='psd',
    summary='the reading grows with the distance from the centre',
    equation='x -> x (1 + k r^2), y likewise',
    source='Hamamatsu S1880 datasheet: position detection error; thesis E_R',
    needs='dots far from the centre',
    parameters=(
        PSD,
        EffectParameter('k', '1/m^2', -1e4, 1e5, 100.0, 'cubic coefficient'),
    ),
    point='dots',
    apply=_apply,
    correct=_correct,
    order=3,
)
