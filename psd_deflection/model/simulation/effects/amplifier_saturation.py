# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The amplifier clips before the converter does.

If the signal is without noise (``samples.noise`` > 0), the result is the mean of the clipped noisy
signal. This keeps a comparison fair where the signal is close to the limit.
"""

import numpy as np
from scipy.special import ndtr

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import FloatArray, dot_channels


def _excess(v: FloatArray, sigma: float) -> FloatArray:
    """Mean of max(v + noise, 0)."""
    if sigma <= 0.0:
        return np.maximum(v, 0.0)
    z = v / sigma
    return np.asarray(v * ndtr(z) + sigma * np.exp(-0.5 * np.minimum(z * z, 1e3)) / np.sqrt(2.0 * np.pi))


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    rows = range(len(samples.volts)) if values['sums'] else dot_channels(len(samples.volts) // 3)
    for row in rows:
        v, noise = samples.volts[row], float(samples.noise[row])
        samples.volts[row] = v - _excess(v - values['limit'], noise) + _excess(-v - values['limit'], noise)


EFFECT = Effect(
    name='amplifier_saturation',
    stage='electronics',
    summary='the output clips',
    equation='v -> min(max(v, -limit), limit)',
    source='amplifier datasheets',
    needs='signals up to the limit',
    parameters=(
        EffectParameter(
            'limit',
            'V',
            0.05,
            1e3,
            0.01,
            'largest output',
            nominal=1e3,
            propose=lambda values: 'highest' if values['sums'] else 'highest_dots',
        ),
        EffectParameter(
            'sums', '', 0, 1, 1, '1: the sum signals clip as well', nominal=1, kind='choice', choices=(1, 0)
        ),
    ),
    point='output',
    apply=_apply,
    order=3,
    finite=True,
    also=('saturation',),
)
