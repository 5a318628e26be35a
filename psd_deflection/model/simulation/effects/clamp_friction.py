# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The clamp sticks: the deflection lags behind the load by half a loop, whichever way it moves."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Traced, Values
from psd_deflection.model.simulation.law_forms import play
from psd_deflection.model.simulation.samples import SimulatedSamples

_REST_BLOCKS = 12
"""Blocks in which the link is at rest if it has not moved by more than a quarter of the loop."""


def _levers(axis: float, length: float) -> tuple[float, float, float]:
    """m or rad of dX, dY, theta per rad of the clamp; 0 where the clamp does not stick."""
    bending, torsion = (length if axis != 2 else 0.0), (1.0 if axis != 1 else 0.0)
    return bending, bending, torsion


def _trace_back(block: Traced, values: Values, remembered: list[float]) -> None:
    """The deflection without friction: half a loop further on, the way the link last moved from rest to rest.

    The load of a link that sticks can be anywhere in the loop. ``remembered``, of each axis: where the link last
    rested, which way it came there (-1, 0, 1), then its last blocks.
    """
    length = 2 + _REST_BLOCKS
    if not remembered:
        # Unloaded until now.
        remembered += [0.0] * (3 * length)
    for row, lever in enumerate(_levers(values['axis'], block.physics.length)):
        half = 0.5 * values['width'] * lever
        rested, way, _, *recent = remembered[length * row : length * (row + 1)]
        place = block.pose[row]
        recent.append(place)
        if abs(place - rested) > 0.5 * half:
            now = 1.0 if place > rested else -1.0
            if max(recent) - min(recent) <= 0.5 * half:
                rested, way = place, now
        else:
            now = way
        remembered[length * row : length * (row + 1)] = [rested, way, *recent]
        block.pose[row] += now * half


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    if samples.t.size == 0 or values['width'] <= 0.0:
        return
    for row, lever in enumerate(_levers(values['axis'], samples.physics.length)):
        if lever > 0.0:
            lagging = play(samples.static[row], 0.5 * values['width'] * lever, state.get(str(row), 0.0))
            state[str(row)] = float(lagging[-1])
            samples.static[row] = lagging


EFFECT = Effect(
    name='clamp_friction',
    stage='link',
    summary='play or stick in the clamp: a hysteresis loop',
    equation='deflection = play(static deflection, width/2), times L in bending',
    source='Visintin, Differential Models of Hysteresis, 1994: play operator',
    needs='loads that rise and fall through the same level',
    parameters=(
        EffectParameter('width', 'rad', 0.0, 0.1, 1e-5, 'full width of the loop, as an angle of the clamp'),
        EffectParameter(
            'axis', '', 1, 3, 1, '1: bending, 2: torsion, 3: both', nominal=3, kind='choice', choices=(1, 2, 3)
        ),
    ),
    point='static',
    apply=_apply,
    trace_back=_trace_back,
    order=3,
    also=('hysteresis',),
)
