# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Part of the spot leaves the active area, and the centroid of the rest is read (E_LP)."""

from psd_deflection.model.detector.clipping import cut_by_edges, cut_disc
from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples


def _apply(samples: SimulatedSamples, values: Values, state: State) -> None:
    psd, radius = int(values['psd']) - 1, values['radius']
    if radius <= 0.0:
        return
    for axis in range(2):
        row, half = 2 * psd + axis, float(samples.physics.half_area[psd, axis])
        place = samples.dots[row].copy()
        if values['profile'] == 1:
            for side in (1.0, -1.0):
                share, moved = cut_disc(half - side * place, radius)
                samples.dots[row] -= side * moved
                samples.sums[psd] *= share
        else:
            share, moved = cut_by_edges(place, half, radius)
            samples.dots[row] += moved
            samples.sums[psd] *= share


EFFECT = Effect(
    name='spot_clipping',
    stage='psd',
    summary='part of the spot leaves the active area',
    equation='m = centroid of the spot within the area; the sum falls',
    source='geometry of a cut disc; thesis E_LP',
    needs='dots near the edge',
    parameters=(
        PSD,
        EffectParameter(
            'radius',
            'm',
            0.0,
            0.05,
            1e-3,
            'radius of the spot (1/e^2 where the profile is Gaussian)',
            grid=(1.0e-3, 1.5e-3, 2.0e-3, 2.5e-3, 3.0e-3, 3.5e-3, 4.0e-3, 5.0e-3),
        ),
        EffectParameter('profile', '', 1, 2, 1, '1: even disc, 2: Gaussian', nominal=1, kind='choice', choices=(1, 2)),
    ),
    point='dots',
    apply=_apply,
    order=0,
    finite=True,
    also=('clipping',),
)
