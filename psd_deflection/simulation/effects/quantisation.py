"""The converter steps more coarsely than the rig file says.

If the signal is without noise (``chunk.noise`` > 0), the result is the mean over the noise: the
bias of rounding is a Fourier series whose terms the noise damps as exp(-2 (pi k sigma/step)^2).
"""

from __future__ import annotations

import math

import numpy as np

from psd_deflection.simulation.chunk import Chunk
from psd_deflection.simulation.declaration import Effect, EffectParameter, State, Values


def _apply(chunk: Chunk, values: Values, state: State) -> None:
    step = values['step']
    if step <= 0.0:
        return
    if chunk.noise <= 0.0:
        chunk.volts[:] = np.rint(chunk.volts / step) * step
        return
    if step > 8.0 * chunk.noise:
        # The series converges slowly here: average the rounding over the noise directly.
        nodes, weights = np.polynomial.hermite_e.hermegauss(41)
        mean = np.zeros_like(chunk.volts)
        for node, weight in zip(nodes, weights, strict=True):
            mean += weight / math.sqrt(2.0 * math.pi) * np.rint((chunk.volts + chunk.noise * node) / step)
        chunk.volts[:] = mean * step
        return
    bias = np.zeros_like(chunk.volts)
    for k in range(1, 12):
        size = (-1.0) ** k / k * math.exp(-2.0 * (math.pi * k * chunk.noise / step) ** 2)
        if abs(size) > 1e-9:
            bias += size * np.sin(2.0 * math.pi * k / step * chunk.volts)
    chunk.volts += step / math.pi * bias


EFFECT = Effect(
    name='quantisation',
    stage='electronics',
    summary='coarser steps than the converter has',
    equation='v -> step round(v/step)',
    source='Widrow and Kollar, Quantization Noise, 2008',
    needs='nothing',
    parameters=(EffectParameter('step', 'V', 0.0, 10.0, 1e-3, 'its step', propose='lattice'),),
    point='output',
    apply=_apply,
    order=4,
    finite=True,
)
