# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The converter steps more coarsely than the rig file says.

If the signal is without noise (``samples.noise`` > 0), the result is the mean over the noise: the
bias of rounding is a Fourier series whose terms the noise damps as exp(-2 (pi k sigma/step)^2).
"""

import math

import numpy as np
from scipy.special import ndtr

from psd_deflection.model.simulation.declaration import Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import FloatArray


def _rounded(volts: FloatArray, noise: float, step: float) -> FloatArray:
    """``volts`` (n,) to multiples of ``step``; the mean over ``noise`` if that is above 0. V."""
    if noise <= 0.0:
        return np.asarray(np.rint(volts / step) * step)
    if step > 8.0 * noise:
        # The series converges slowly here. Only the three nearest edges are within reach of the noise.
        below = np.floor(volts / step)
        edges = sum(ndtr((volts - (below + more) * step) / noise) for more in (-0.5, 0.5, 1.5))
        return np.asarray((below - 1.0 + edges) * step)
    bias = np.zeros_like(volts)
    for k in range(1, 12):
        size = (-1.0) ** k / k * math.exp(-2.0 * (math.pi * k * noise / step) ** 2)
        if abs(size) > 1e-9:
            bias += size * np.sin(2.0 * math.pi * k / step * volts)
    return volts + step / math.pi * bias


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    if values['step'] > 0.0:
        for row, noise in enumerate(samples.noise.tolist()):
            if row % 3 == 2 and not values['sums']:
                continue
            samples.volts[row] = _rounded(samples.volts[row], noise, values['step'])


EFFECT = Effect(
    name='quantisation',
    stage='electronics',
    summary='coarser steps than the converter has',
    equation='v -> step round(v/step)',
    source='Widrow and Kollar, Quantization Noise, 2008',
    needs='nothing',
    parameters=(
        EffectParameter(
            'step',
            'V',
            0.0,
            10.0,
            1e-3,
            'its step',
            propose=lambda values: 'value_grid' if values['sums'] else 'value_grid_dots',
        ),
        EffectParameter(
            'sums', '', 0, 1, 1, '1: the sum signals step as well', nominal=1, kind='choice', choices=(1, 0)
        ),
    ),
    point='output',
    apply=_apply,
    order=4,
    finite=True,
)
