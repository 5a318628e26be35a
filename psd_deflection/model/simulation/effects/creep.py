# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The deflection continues to grow after each change of load."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Traced, Values
from psd_deflection.model.simulation.modes import Filter, held_lag_coefficients
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    for row in range(3):
        key = str(row)
        if key not in state:
            state[key] = Filter(held_lag_coefficients(values['time_constant'], samples.physics.period))
        samples.static[row] += values['amplitude'] * state[key](samples.static[row])


def _trace_back(block: Traced, values: Values, remembered: list[float]) -> None:
    """The deflection before creep, held over the block: p = q + amplitude y, tau y' = q - y."""
    if not remembered:
        # Unloaded until now.
        remembered += [0.0, 0.0, 0.0]
    amplitude, decay = values['amplitude'], block.physics.xp.exp(-block.seconds / values['time_constant'])
    for row in range(3):
        grown = block.pose[row] - amplitude * decay * remembered[row]
        block.pose[row] = grown / (1.0 + amplitude * (1.0 - decay))
        remembered[row] = decay * remembered[row] + (1.0 - decay) * block.pose[row]


EFFECT = Effect(
    name='creep',
    stage='link',
    summary='the deflection grows after each load change',
    equation='q += amplitude (1 - exp(-t/tau)) q after a step to q',
    source='standard linear solid',
    needs='a load held for more than a time constant, and its removal',
    parameters=(
        EffectParameter('amplitude', '', -0.9, 2.0, 1e-3, 'growth relative to the static deflection'),
        EffectParameter(
            'time_constant',
            's',
            0.05,
            1e4,
            1.0,
            'how slowly',
            nominal=5.0,
            kind='shape',
            grid=(0.3, 1.0, 3.0, 10.0, 40.0),
        ),
    ),
    point='static',
    apply=_apply,
    trace_back=_trace_back,
    order=4,
)
