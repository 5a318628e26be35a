"""Each axis of a PSD reads a part of the other axis."""

from __future__ import annotations

from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, Reading, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    i = 2 * (int(values['psd']) - 1)
    x, y = samples.dots[i].copy(), samples.dots[i + 1].copy()
    samples.dots[i] += values['xy'] * y
    samples.dots[i + 1] += values['yx'] * x


def _correct(reading: Reading, values: Values) -> None:
    i = 2 * (int(values['psd']) - 1)
    x, y = reading.dots[i].copy(), reading.dots[i + 1].copy()
    det = 1.0 - values['xy'] * values['yx']
    reading.dots[i] = (x - values['xy'] * y) / det
    reading.dots[i + 1] = (y - values['yx'] * x) / det


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
)
