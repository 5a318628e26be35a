# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A positioning system driven by a voltage (EMPS): a plant for ``discover_in``."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from psd_deflection.model.simulation.declaration import Effect, EffectParameter
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect

MASS, VISCOUS, COULOMB, OFFSET, GAIN = 95.1089, 203.5034, 20.3935, -3.1648, 35.15065
"""kg, N s/m, N, N, N/V, as published."""
RATE = 1000.0
STEP = 2  # Samples a step of the simulation.
KEPT = 10  # Every tenth sample of the position is compared.
SEGMENT_S = 2.0


def _scale(name: str, words: str) -> Effect:
    return plant_effect(name, EffectParameter('scale', '', -0.9, 4.0, 0.02, words))


LIBRARY = (
    plant_effect('coulomb_friction', EffectParameter('force', 'N', 0.0, 100.0, 1.0, 'against the motion')),
    plant_effect('force_offset', EffectParameter('force', 'N', -30.0, 30.0, 0.5, 'always the same way')),
    plant_effect('quadratic_drag', EffectParameter('drag', 'N s^2/m^2', 0.0, 5e3, 20.0, 'grows with speed squared')),
    plant_effect('spring', EffectParameter('stiffness', 'N/m', -500.0, 500.0, 5.0, 'towards zero')),
    plant_effect('position_offset', EffectParameter('shift', 'm', -0.01, 0.01, 1e-4, 'of the reading')),
    plant_effect('position_gain', EffectParameter('scale', '', -0.5, 0.5, 0.002, 'of the reading')),
    plant_effect('input_delay', EffectParameter('delay', 's', 0.0, 0.05, 0.002, 'of the voltage')),
    _scale('viscous_friction', 'relative change of Fv'),
    _scale('mass', 'relative change of M'),
    _scale('drive_gain', 'relative change of the gain'),
)


def _read(path: Path) -> FloatArray:
    """(n, 3): time (s), position (m), voltage (V)."""
    if path.suffix == '.mat':
        tables = loadmat(path)
        return np.column_stack([np.asarray(tables[name], dtype=np.float64)[:, 0] for name in ('t', 'qm', 'vir')])
    with path.open(newline='') as stream:
        return np.array([[float(v) for v in row] for row in list(csv.reader(stream))[1:]])


class Emps(Plant):
    """``without``: published terms that the model lacks, ``coulomb_friction`` or ``force_offset``."""

    channels = ('position',)
    units = ('m',)
    library: tuple[Effect, ...] = LIBRARY
    period = KEPT / RATE

    def __init__(
        self, without: Sequence[str], folder: Path, record: str = 'emps.csv', segment: float = SEGMENT_S
    ) -> None:
        """``record``: a file, ``.csv`` or the benchmark's ``.mat``; ``segment``: s after which the simulation starts
        again. Raises OSError if ``folder`` has no such file."""
        rows = _read(folder / record)
        n = round(segment * RATE)
        count = len(rows) // n
        position = rows[: count * n, 1].reshape(count, n)
        self._voltage = rows[: count * n, 2].reshape(count, n)
        # Speed at the start of each segment, from a polynomial through 80 ms on either side.
        speed = np.zeros(count)
        reach = 80
        for i in range(1, count):
            around = rows[i * n - reach : i * n + reach + 1, 1]
            speed[i] = np.polyfit(np.arange(-reach, reach + 1) / RATE, around, 4)[3]
        self._start = np.stack([position[:, 0], speed])
        self._measured = [row[None, ::KEPT] for row in position]
        self.cases = tuple(f'{segment * i:.0f} s' for i in range(count))
        self._terms = (0.0 if 'coulomb_friction' in without else COULOMB, 0.0 if 'force_offset' in without else OFFSET)

    def measured(self) -> list[FloatArray]:
        """Position, m."""
        return self._measured

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """Voltage, V."""
        return {'voltage': list(self._voltage[:, ::KEPT])}

    def simulate(self, model: Model) -> list[FloatArray]:
        """Return all segments at once, semi-implicit Euler at the sample rate."""

        def of(name: str, parameter: str) -> float:
            return model[name][parameter] if name in model else 0.0

        mass = MASS * (1.0 + of('mass', 'scale'))
        viscous = VISCOUS * (1.0 + of('viscous_friction', 'scale'))
        coulomb = self._terms[0] + of('coulomb_friction', 'force')
        offset = self._terms[1] + of('force_offset', 'force')
        drag, spring = of('quadratic_drag', 'drag'), of('spring', 'stiffness')
        n = self._voltage.shape[1]
        at = np.clip(np.arange(n) - of('input_delay', 'delay') * RATE, 0.0, n - 1.0)
        low = np.minimum(at.astype(np.int64), n - 2)
        voltage = self._voltage[:, low] + (at - low) * (self._voltage[:, low + 1] - self._voltage[:, low])
        means = voltage.reshape(len(voltage), -1, STEP).mean(axis=2)
        force = (GAIN * (1.0 + of('drive_gain', 'scale')) * means - offset).T
        q, v = self._start[0].copy(), self._start[1].copy()
        out = np.empty((len(force), len(q)))
        # With the force held over a step, viscous friction is exact.
        h = STEP / RATE
        fade = np.exp(-h * viscous / mass)
        gain = (1.0 - fade) / viscous
        for i, given in enumerate(force):
            out[i] = q
            push = given - spring * q
            if drag:
                push = push - drag * v * np.abs(v)
            free = fade * v + gain * push
            # Friction holds what would turn round within the step.
            after = np.sign(free) * np.maximum(np.abs(free) - gain * coulomb, 0.0)
            q = q + 0.5 * h * (v + after)
            v = after
        observed = out[:: KEPT // STEP].T * (1.0 + of('position_gain', 'scale')) + of('position_offset', 'shift')
        return [row[None, :] for row in observed]
