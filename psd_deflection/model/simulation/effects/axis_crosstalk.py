# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Each axis of a PSD reads a part of the other axis."""

from psd_deflection.model.detector.response import crossed, uncrossed
from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, Reading, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    i = 2 * (int(values['psd']) - 1)
    dots = samples.dots
    dots[i], dots[i + 1] = crossed(dots[i], dots[i + 1], values['xy'], values['yx'])


def _correct(reading: Reading, values: Values) -> None:
    i = 2 * (int(values['psd']) - 1)
    dots = reading.dots
    dots[i], dots[i + 1] = uncrossed(dots[i], dots[i + 1], values['xy'], values['yx'])


EFFECT = Effect(
    name='axis_crosstalk',
    stage='psd',
    summary='the axes of a PSD mix',
    equation='x += xy y, y += yx x',
    source='PSD datasheets',
    needs='dots that move along both axes',
    parameters=(
        PSD,
        EffectParameter('xy', '', -0.9, 0.9, 1e-3, 'share of y in x'),
        EffectParameter('yx', '', -0.9, 0.9, 1e-3, 'share of x in y'),
    ),
    point='dots',
    apply=_apply,
    correct=_correct,
    order=4,
    calibrated_as={'xy': 'crosstalk_xy', 'yx': 'crosstalk_yx'},
)
