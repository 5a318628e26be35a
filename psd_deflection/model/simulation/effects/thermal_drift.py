# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reading of one PSD moves with temperature (E_TH)."""

from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, Reading, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    i = 2 * (int(values['psd']) - 1)
    samples.dots[i] += values['x'] * samples.warmer
    samples.dots[i + 1] += values['y'] * samples.warmer


def _correct(reading: Reading, values: Values) -> None:
    i = 2 * (int(values['psd']) - 1)
    reading.dots[i] -= values['x'] * reading.warmer
    reading.dots[i + 1] -= values['y'] * reading.warmer


EFFECT = Effect(
    name='thermal_drift',
    stage='psd',
    summary='a reading moves with temperature',
    equation='m += (x, y) (T - T0)',
    source='PSD datasheets; thesis E_TH',
    needs='a change of temperature',
    parameters=(
        PSD,
        EffectParameter('x', 'm/K', -1e-3, 1e-3, 1e-7, 'drift of x'),
        EffectParameter('y', 'm/K', -1e-3, 1e-3, 1e-7, 'drift of y'),
    ),
    point='dots',
    apply=_apply,
    correct=_correct,
    order=6,
    uses=frozenset({'temperature'}),
    also=('temperature',),
)
