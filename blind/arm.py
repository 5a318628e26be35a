# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A two-link flexible arm: a plant for ``discover_in``."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from psd_deflection.model.simulation.declaration import Effect, EffectParameter
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect

RATE = 100.0
SUBSTEPS = 8
CREEP_RATE = 0.02  # Hub rate, rad/s, below which Coulomb friction fades: a sign function would stop any integrator.

KS = 2.068427e11 * (3.0 * 0.0254) * (0.050 * 0.0254) ** 3 / (4.0 * 0.202)
B1 = 4.0
KT = 0.75 * 0.119 * 100.0
J1 = 100.0**2 * 6.28e-6 + 0.00073616
J2 = 0.18028257 - 1.578 * 0.079**2


def _scale(name: str, words: str) -> Effect:
    return plant_effect(name, EffectParameter('scale', '', -0.8, 4.0, 0.05, words))


LIMIT = EffectParameter('limit', 'A', 0.05, 20.0, 0.2, 'of the amplifier', nominal=20.0, grid=(0.3, 0.6))

LIBRARY = (
    plant_effect('coulomb_friction', EffectParameter('torque', 'N m', 0.0, 20.0, 0.5, 'at the hub')),
    plant_effect('tip_damping', EffectParameter('damping', 'N m s', 0.0, 50.0, 0.5, 'of the link itself')),
    _scale('hub_damping', 'relative change of B1'),
    _scale('link_stiffness', 'relative change of Ks'),
    _scale('hub_inertia', 'relative change of J1'),
    _scale('tip_inertia', 'relative change of J2'),
    _scale('motor_gain', 'relative change of Kt'),
    plant_effect('input_delay', EffectParameter('delay', 's', 0.0, 0.1, 0.005, 'of the current')),
    plant_effect('current_limit', LIMIT, finite=True),
    _scale('tip_gain', 'strain reading'),
    plant_effect('tip_offset', EffectParameter('offset', 'rad', -0.01, 0.01, 1e-4, 'strain zero')),
)


class Arm(Plant):
    """Measured segments, the maker's model, and what might be missing from it."""

    channels = ('theta_hub', 'theta_tip')
    units = ('rad', 'rad')
    library = LIBRARY
    period = 1.0 / RATE

    def __init__(self, folder: Path) -> None:
        """``folder`` holds ``excerpt.csv``. Raises OSError if it does not."""
        rows: dict[str, list[list[float]]] = {}
        with (folder / 'excerpt.csv').open(newline='') as stream:
            for row in csv.DictReader(stream):
                names = ('t', 'current', 'theta_hub', 'theta_tip', 'rate_hub', 'rate_tip')
                rows.setdefault(row['segment'], []).append([float(row[n] or 'nan') for n in names])
        self.cases = tuple(rows)
        tables = [np.array(rows[c]) for c in self.cases]
        self._measured = [np.ascontiguousarray(t[:, 2:4].T) for t in tables]
        self._start = np.array([t[0, 2:6] for t in tables])
        self._current = np.array([t[:, 1] for t in tables])

    def measured(self) -> list[FloatArray]:
        """Hub and tip angle, rad, of each segment."""
        return self._measured

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """Current, A."""
        return {'current': list(self._current)}

    def simulate(self, model: Model) -> list[FloatArray]:
        """Return all segments at once, second-order Runge-Kutta with the current held over each sample."""

        def of(name: str, parameter: str, default: float) -> float:
            return model[name][parameter] if name in model else default

        ks = KS * (1.0 + of('link_stiffness', 'scale', 0.0))
        b1 = B1 * (1.0 + of('hub_damping', 'scale', 0.0))
        j1 = J1 * (1.0 + of('hub_inertia', 'scale', 0.0))
        j2 = J2 * (1.0 + of('tip_inertia', 'scale', 0.0))
        kt = KT * (1.0 + of('motor_gain', 'scale', 0.0))
        b2 = of('tip_damping', 'damping', 0.0)
        friction = of('coulomb_friction', 'torque', 0.0)
        limit = of('current_limit', 'limit', np.inf)
        late = of('input_delay', 'delay', 0.0) * RATE
        read, zero = 1.0 + of('tip_gain', 'scale', 0.0), of('tip_offset', 'offset', 0.0)

        x = self._start.T.copy()
        x[1] -= zero
        current = np.clip(self._current, -limit, limit)
        n = current.shape[1]
        at = np.arange(n) - late
        low = np.clip(np.floor(at).astype(np.int64), 0, n - 1)
        part = np.clip(at - low, 0.0, 1.0)
        torque = kt * ((1.0 - part) * current[:, low] + part * current[:, np.minimum(low + 1, n - 1)])
        out = np.empty((len(current), 2, n))
        # Rates of change of the two angles and their speeds: rates @ x + push * (torque - friction).
        both, h = 1.0 / j1 + 1.0 / j2, 1.0 / (RATE * SUBSTEPS)
        rates = np.array(
            [
                [0.0, 0.0, 1.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
                [0.0, ks / j1, -b1 / j1, b2 / j1],
                [0.0, -both * ks, b1 / j1, -both * b2],
            ]
        )
        push = np.array([0.0, 0.0, 1.0 / j1, -1.0 / j1])
        step = np.eye(4) + h * rates + 0.5 * h * h * rates @ rates
        early, late_half = 0.5 * h * h * rates @ push[:, None], h * push[:, None]
        # Without friction the substeps of a sample are one linear map.
        full = np.linalg.matrix_power(step, SUBSTEPS)
        held = sum(np.linalg.matrix_power(step, k) for k in range(SUBSTEPS)) @ (early + late_half)
        for i in range(n):
            out[:, 0, i] = x[0]
            out[:, 1, i] = x[1] * read + zero
            if friction == 0.0:
                x = full @ x + held * torque[:, i]
                continue
            for _ in range(SUBSTEPS):
                force = torque[:, i] - friction * np.tanh(x[2] / CREEP_RATE)
                middle = x[2] + 0.5 * h * (rates[2] @ x + push[2] * force)
                x = step @ x + early * force
                x += late_half * (torque[:, i] - friction * np.tanh(middle / CREEP_RATE))
        return [np.clip(rows, -10.0, 10.0) for rows in out]
