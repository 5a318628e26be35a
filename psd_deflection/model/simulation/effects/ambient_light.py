# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Light that is not the laser pulls the reading to its own centroid (E_DC, stray light)."""

from collections.abc import Callable

import numpy as np

from psd_deflection.model.detector.response import pulled
from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, Reading, State, Values
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples


def _on_the_detector(axis: int) -> Callable[[Physics, Values], tuple[float, float]]:
    # Measured light falls on the active area, so its centroid is there too.
    def within(physics: Physics, values: Values) -> tuple[float, float]:
        half = float(physics.half_area[int(values['psd']) - 1, axis])
        return -half, half

    return within


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    psd = int(values['psd']) - 1
    laser, level = samples.sums[psd], values['level']
    for row, center in ((2 * psd, values['x']), (2 * psd + 1, values['y'])):
        samples.dots[row] = pulled(samples.dots[row], laser, level, center)
    samples.sums[psd] = laser + level


def _correct(reading: Reading, values: Values) -> None:
    psd = int(values['psd']) - 1
    full, level = reading.sums[psd].copy(), values['level']
    laser = np.maximum(full - level, 1e-3 * full)
    for row, center in ((2 * psd, values['x']), (2 * psd + 1, values['y'])):
        reading.dots[row] = (full * reading.dots[row] - level * center) / laser
    reading.sums[psd] = laser


EFFECT = Effect(
    name='ambient_light',
    stage='psd',
    summary='background light pulls the reading to its centroid',
    equation='m -> (S m + level c)/(S + level), S -> S + level',
    source='Hamamatsu, PSD technical note; thesis E_DC',
    needs='the sum signal',
    parameters=(
        PSD,
        EffectParameter('level', 'V', 0.0, 100.0, 5e-3, 'its part of the sum signal'),
        EffectParameter('x', 'm', -0.5, 0.5, 1e-3, 'its centroid', kind='coupled', within=_on_the_detector(0)),
        EffectParameter('y', 'm', -0.5, 0.5, 1e-3, 'its centroid', kind='coupled', within=_on_the_detector(1)),
    ),
    point='dots',
    apply=_apply,
    correct=_correct,
    order=1,
    also=('light', 'stray_light'),
)
