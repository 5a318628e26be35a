# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The load acts beside the centroid, so that a force also turns the tip."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Traced, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    samples.loads[2] += values['x'] * samples.loads[1] - values['y'] * samples.loads[0]


def _trace_back(block: Traced, values: Values, remembered: list[float]) -> None:
    block.loads[2] -= values['x'] * block.loads[1] - values['y'] * block.loads[0]


EFFECT = Effect(
    name='load_offset',
    stage='load',
    summary='the load acts away from the centroid',
    equation='Tz += x Fy - y Fx',
    source='statics',
    needs='forces along both axes',
    parameters=(
        EffectParameter('x', 'm', -1.0, 1.0, 1e-4, 'where it acts'),
        EffectParameter('y', 'm', -1.0, 1.0, 1e-4, 'where it acts'),
    ),
    point='load',
    apply=_apply,
    trace_back=_trace_back,
    order=1,
)
