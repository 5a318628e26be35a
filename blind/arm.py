"""discover on open data of another machine, a two-link flexible arm, through the adapter.

``python -m blind.arm [FOLDER]``; the folder holds ``excerpt.csv``, by default ``../shared/data/two_link_arm`` beside
this checkout. The data are nine steps measured by others (repository basta/quanser-2-dof-serial-flexible-link, MIT).

Stage 1 of the arm: a geared motor turns a hub, and a flexible link carries the rest. The equations
of motion are (hub angle h, tip angle against the hub d, motor current u)::

    J1 h'' = Ks d - B1 h' + B2 d' - T(h') + Kt u
    d'' = -(1/J1 + 1/J2)(Ks d + B2 d') + (B1 h' + T(h') - Kt u)/J1

The maker's model has B2 = 0 and no Coulomb friction T. Each measured step is simulated from its first
state with the current that the arm's controller commanded: the linear-quadratic gain of the nominal
model applied to the recorded states. A closed loop would hide many of the model's errors.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from blind.adapter import Model, PlantDiscovery, PlantEffect, discover_in
from psd_deflection.records import FloatArray
from psd_deflection.simulation.declaration import EffectParameter

DATA = Path(__file__).resolve().parent.parent.parent / 'shared' / 'data' / 'two_link_arm'
RATE = 100.0
SUBSTEPS = 8
CREEP_RATE = 0.02
"""Hub rate, rad/s, below which Coulomb friction fades: a sign function would stop any integrator."""

KS = 2.068427e11 * (3.0 * 0.0254) * (0.050 * 0.0254) ** 3 / (4.0 * 0.202)
B1 = 4.0
KT = 0.75 * 0.119 * 100.0
J1 = 100.0**2 * 6.28e-6 + 0.00073616
J2 = 0.18028257 - 1.578 * 0.079**2


def _scale(name: str, words: str) -> PlantEffect:
    p = EffectParameter('scale', '', -0.8, 4.0, 0.1, words)
    return PlantEffect(name, (p,), {'scale': 0.05})


LIBRARY = (
    PlantEffect('coulomb_friction', (EffectParameter('torque', 'N m', 0.0, 20.0, 1.0, 'at the hub'),), {'torque': 0.5}),
    PlantEffect(
        'tip_damping', (EffectParameter('damping', 'N m s', 0.0, 50.0, 0.5, 'of the link itself'),), {'damping': 0.2}
    ),
    _scale('hub_damping', 'relative change of B1'),
    _scale('link_stiffness', 'relative change of Ks'),
    _scale('hub_inertia', 'relative change of J1'),
    _scale('tip_inertia', 'relative change of J2'),
    _scale('motor_gain', 'relative change of Kt'),
    PlantEffect('input_delay', (EffectParameter('delay', 's', 0.0, 0.1, 0.01, 'of the current'),), {'delay': 0.005}),
    PlantEffect('current_limit', (EffectParameter('limit', 'A', 0.05, 20.0, 0.2, 'of the amplifier'),), {'limit': 0.6}),
    PlantEffect('tip_gain', (EffectParameter('scale', '', -0.8, 4.0, 0.1, 'strain reading'),), {'scale': 0.05}),
    PlantEffect('tip_offset', (EffectParameter('offset', 'rad', -0.01, 0.01, 1e-3, 'strain zero'),), {'offset': 1e-4}),
)


class Arm:
    """The adapter: measured segments, the nominal model, and what might be missing from it."""

    channels = ('theta_hub', 'theta_tip')
    library = LIBRARY

    def __init__(self, folder: Path = DATA) -> None:
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

    def simulate(self, model: Model, cases: Sequence[int]) -> list[FloatArray]:
        """All listed segments at once, second-order Runge-Kutta with the current held over each sample."""

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

        x = self._start[list(cases)].T.copy()
        x[1] -= zero
        current = np.clip(self._current[list(cases)], -limit, limit)
        n = current.shape[1]
        at = np.arange(n) - late
        low = np.clip(np.floor(at).astype(np.int64), 0, n - 1)
        part = np.clip(at - low, 0.0, 1.0)
        torque = kt * ((1.0 - part) * current[:, low] + part * current[:, np.minimum(low + 1, n - 1)])
        out = np.empty((len(cases), 2, n))
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
        whole = np.linalg.matrix_power(step, SUBSTEPS)
        held = sum(np.linalg.matrix_power(step, k) for k in range(SUBSTEPS)) @ (early + late_half)
        for i in range(n):
            out[:, 0, i] = x[0]
            out[:, 1, i] = x[1] * read + zero
            if friction == 0.0:
                x = whole @ x + held * torque[:, i]
                continue
            for _ in range(SUBSTEPS):
                force = torque[:, i] - friction * np.tanh(x[2] / CREEP_RATE)
                middle = x[2] + 0.5 * h * (rates[2] @ x + push[2] * force)
                x = step @ x + early * force
                x += late_half * (torque[:, i] - friction * np.tanh(middle / CREEP_RATE))
        return [np.clip(rows, -10.0, 10.0) for rows in out]


def report(found: PlantDiscovery) -> str:
    """The steps in words."""

    def mrad(values: Sequence[float]) -> str:
        return ', '.join(f'{n} {1e3 * v:.3f}' for n, v in zip(Arm.channels, values, strict=True))

    lines = [f'compare: rms of measured minus simulated, mrad: {mrad(found.gap_before)}', 'where, worst first:']
    lines += [f'  {case:16s} {channel:10s} {1e3 * v:.3f} mrad' for case, channel, v in found.where[:6]]
    lines.append('which (BIC gained if added alone):')
    lines += [f'  {name:18s} {gain:9.1f}' for name, gain in found.tried]
    lines.append('added:')
    for s in found.steps:
        values = ', '.join(f'{k} {v:.4g}' for k, v in s.values.items())
        lines.append(
            f'  {s.name} ({values}): BIC better by {s.delta_bic:.1f}, unseen segments {s.heldout_gain:+.1f} '
            f'+- {s.heldout_error:.1f}; gap then {mrad(s.gap_after)}'
        )
    lines.append(f'held out, before, mrad: {mrad(found.heldout_before)}')
    lines.append(f'held out, after,  mrad: {mrad(found.heldout_after)}')
    lines.append(f'{found.simulations} simulations')
    return '\n'.join(lines)


def main() -> int:
    """Run the five steps and print them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument('folder', nargs='?', type=Path, default=DATA, help='with excerpt.csv (default: %(default)s)')
    folder = parser.parse_args().folder
    try:
        arm = Arm(folder)
    except OSError as error:
        print(f'{error.filename}: {error.strerror}', file=sys.stderr)
        return 3
    print(report(discover_in(arm)))
    return 0


if __name__ == '__main__':
    sys.exit(main())
