# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The force does not point where the load record says."""

import math

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Traced, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    c, s = math.cos(values['angle']), math.sin(values['angle'])
    fx, fy = samples.loads[0].copy(), samples.loads[1].copy()
    samples.loads[0] = c * fx - s * fy
    samples.loads[1] = s * fx + c * fy


def _trace_back(block: Traced, values: Values, remembered: list[float]) -> None:
    xp = block.physics.xp
    c, s = xp.cos(values['angle']), xp.sin(values['angle'])
    fx, fy, _ = block.loads
    block.loads[:2] = c * fx + s * fy, c * fy - s * fx


EFFECT = Effect(
    name='load_direction',
    stage='load',
    summary='the force is turned about Z',
    equation='(Fx, Fy) -> Rz(angle) (Fx, Fy)',
    source='statics',
    needs='a force, and a torque to tell it from turned sensors',
    parameters=(EffectParameter('angle', 'rad', -3.2, 3.2, 1e-3, 'turn of the force about +Z'),),
    point='load',
    apply=_apply,
    trace_back=_trace_back,
    order=0,
)
