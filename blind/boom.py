# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A telescoping cantilever boom under tip forces, read with a ruler: a plant for ``discover_in``."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from psd_deflection.model.simulation.declaration import EffectParameter
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect

EI = 91.0  # N m^2, fitted by those who measured.
READING = 5e-4  # m rms, of a ruler with millimetres.

STIFFNESS = plant_effect(
    'bending_compliance',
    EffectParameter('scale', '', -0.9, 3.0, 0.1, 'relative change of 1/EI'),
    equation='1/EI *= 1 + scale',
)
SELF_WEIGHT = plant_effect(
    'self_weight', EffectParameter('weight', 'N/m', 0.0, 20.0, 0.2, 'per length'), equation='w L^4/(8 EI)'
)
TIP_FORCE = plant_effect(
    'tip_force', EffectParameter('force', 'N', -5.0, 5.0, 0.2, 'at the tip, always'), equation='F += force'
)
CLAMP = plant_effect(
    'clamp_compliance',
    EffectParameter('compliance', 'rad/(N m)', 0.0, 0.02, 2e-4, 'turn of the root per moment'),
    equation='slope at the root = compliance M',
)
ROOT = plant_effect(
    'root_length', EffectParameter('longer', 'm', -0.2, 0.5, 0.02, 'of the bending part'), equation='L += longer'
)
TILT = plant_effect('mount_tilt', EffectParameter('angle', 'rad', -0.1, 0.1, 2e-3, 'of the root'), equation='angle L')


class Boom(Plant):
    """``weighed``: the weight of the boom, N/m, and of its end cap, N, as the scales say, belong to the model."""

    channels = ('deflection',)
    units = ('m',)
    nuisance = (STIFFNESS,)
    noise = (READING,)

    def __init__(self, folder: Path, weighed: bool = False) -> None:
        """Raises OSError if ``folder`` has no ``readings.csv``."""
        with (folder / 'readings.csv').open(newline='') as stream:
            rows = np.array([[float(v) for v in row] for row in list(csv.reader(stream))[1:]]) * [1e-3, 1.0, 1e-3, 1e-3]
        self.lengths = np.unique(rows[:, 0])
        self.cases = tuple(f'{1e3 * v:.0f} mm' for v in self.lengths)
        self._rows = [rows[rows[:, 0] == v] for v in self.lengths]
        self._weighed = (0.188 * 9.81, 0.25) if weighed else (0.0, 0.0)
        self.library = (*(() if weighed else (SELF_WEIGHT,)), TIP_FORCE, CLAMP, ROOT, TILT)

    def measured(self) -> list[FloatArray]:
        """Return the deflection, m, of each reading, length by length."""
        return [r[:, 3][None, :] for r in self._rows]

    def inputs(self) -> Mapping[str, list[FloatArray]]:
        """Force, N, and length, m."""
        return {'force': [r[:, 1] for r in self._rows], 'length': [r[:, 0] for r in self._rows]}

    def simulate(self, model: Model) -> list[FloatArray]:
        """Euler's beam with a root that gives way."""

        def of(name: str, parameter: str) -> float:
            return model[name][parameter] if name in model else 0.0

        weight, cap = self._weighed
        weight += of('self_weight', 'weight')
        cap += of('tip_force', 'force')
        give = (1.0 + of('bending_compliance', 'scale')) / EI

        def tip(length: FloatArray, force: FloatArray) -> FloatArray:
            at = length + of('root_length', 'longer')
            moment = (force + cap) * at + 0.5 * weight * at**2
            bent = give * ((force + cap) * at**3 / 3.0 + weight * at**4 / 8.0)
            return np.asarray(bent + (of('clamp_compliance', 'compliance') * moment + of('mount_tilt', 'angle')) * at)

        start = tip(self.lengths[:1], np.zeros(1))
        return [(tip(r[:, 0], r[:, 1]) - start)[None, :] for r in self._rows]
