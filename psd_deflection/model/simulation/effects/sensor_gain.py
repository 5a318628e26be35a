# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A PSD reads too large or too small."""

from psd_deflection.model.detector.response import scaled, unscaled
from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, Reading, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    i = 2 * (int(values['psd']) - 1)
    dots = samples.dots
    dots[i], dots[i + 1] = scaled(dots[i], dots[i + 1], values['x'], values['y'])


def _correct(reading: Reading, values: Values) -> None:
    i = 2 * (int(values['psd']) - 1)
    dots = reading.dots
    dots[i], dots[i + 1] = unscaled(dots[i], dots[i + 1], values['x'], values['y'])


EFFECT = Effect(
    name='sensor_gain',
    stage='psd',
    summary='a reading is scaled',
    equation='x -> x (1 + x_scale), y likewise',
    source='PSD and amplifier datasheets',
    needs='dots that move',
    parameters=(
        PSD,
        EffectParameter('x', '', -0.9, 10.0, 1e-3, 'scale error of x'),
        EffectParameter('y', '', -0.9, 10.0, 1e-3, 'scale error of y'),
    ),
    point='dots',
    apply=_apply,
    correct=_correct,
    order=5,
    calibrated_as={'x': 'gain_x', 'y': 'gain_y'},
)
