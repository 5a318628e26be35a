# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The thesis's own discrepancies: the sizes of effects that close them, and what the methods make of Table 5.1."""

import math
import sys

import numpy as np
from scipy.optimize import brentq

from blind.campaign import conclude, options
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.model.solvers import solver_from_rig
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig, replace_values

SETTLE = 14.0  # s under load before the figures are read: the modes have decayed.
BENDING, TWIST, POINT_D = 3.38e-3, 0.022, 29.45e-3
ARM = loads.SIDEBAR_ARM
CLOSING = (
    (0, 'bending_stiffness', 'scale', -0.5, 0.5),
    (0, 'clamp_bending_compliance', 'compliance', 0.0, 1e-3),
    (0, 'second_bending_mode', 'gain', 0.0, 1.0),
    (1, 'torsional_stiffness', 'scale', -0.5, 0.5),
    (1, 'clamp_torsional_compliance', 'compliance', 0.0, 1e-3),
)
"""Gap (0: bending, 1: twist), effect, parameter, and the sizes between which it closes the gap."""


def at_rest(rig: Rig, load: tuple[float, float, float], effects: list[ActiveEffect]) -> tuple[FloatArray, FloatArray]:
    """Pose (3,) and dots (4,) at the end of a long hold, from rest."""
    history = loads.constant((0.0, 0.0, 0.0), 0.5).then(loads.constant(load, SETTLE))
    chunk = ForwardModel(rig, effects).run(history.loads)
    return chunk.pose[:, -1].copy(), chunk.volts[[0, 1, 3, 4], -1] * chunk.physics.sensitivity.ravel()


def table_b1() -> list[str]:
    """The experimental row, 60 N on the sidebar, and the effects that close its gaps."""
    rig = load_rig()

    def figures(effects: list[ActiveEffect]) -> tuple[float, float, float]:
        pose, _ = at_rest(rig, (0.0, -60.0, -60.0 * ARM), effects)
        return -pose[1], -pose[2], -pose[1] + ARM * math.sin(-pose[2])

    b, t, d = figures([])
    at_d = BENDING + ARM * math.sin(TWIST)
    lines = [
        f'Table B1, simulated: bending {1e3 * b:.3f} mm, twist {t:.5f} rad, point D {1e3 * d:.2f} mm',
        f'measured: {1e3 * BENDING:.2f} mm, {TWIST:.3f} rad, {1e3 * POINT_D:.2f} mm; bending and twist alone make '
        f'{1e3 * at_d:.2f} mm at D: {1e3 * (POINT_D - at_d):.2f} mm are in no motion of the link tip',
    ]
    for gap, name, parameter, low, high in CLOSING:
        effect = catalogue()[name]
        off = effect.off_values(Physics.of(rig), next(iter(effect.variants())))

        def apart(size: float, gap: int, effect: Effect, off: dict[str, float], parameter: str) -> float:
            return figures([ActiveEffect(effect, {**off, parameter: size})])[gap] - (BENDING, TWIST)[gap]

        size = float(brentq(apart, low, high, (gap, effect, off, parameter), 1e-9))
        lines.append(f'  {("bending", "twist")[gap]} closes with {name}.{parameter} {size:.4g}')
    return lines


def table_51() -> list[str]:
    """Errors of the methods at the pose that fits the table's figures (1.07 degrees, 0.120 and -2.28 mm)."""
    rig = replace_values(load_rig(), {'wls.weights': 'thesis'})
    p = Physics.of(rig)
    camera = np.array([0.120e-3, -2.28e-3, -math.radians(1.07)])
    load = (camera[0] / p.force_compliance, camera[1] / p.force_compliance, camera[2] / p.torque_compliance)
    x1, y1, x2, y2 = at_rest(rig, load, [])[1].tolist()
    lines = ['Table 5.1, 50 N on the sidebar: error against the camera, no effect on:']
    for name in ('iterative_printed', 'appendix_d', 'wls', 'ols', 'exact'):
        s = solver_from_rig(name, rig).solve((x1, y1, x2, y2), (1e-12,) * 4)
        dx, dy, theta = (100.0 * (a / b - 1.0) for a, b in zip((s.dx, s.dy, s.theta), camera, strict=True))
        lines.append(f'  {name:18s} dX {dx:+7.1f} %   dY {dy:+6.2f} %   theta {theta:+6.2f} %')
    return lines


def main() -> int:
    options(__doc__).parse_args()
    return conclude('\n'.join([*table_b1(), *table_51()]))


if __name__ == '__main__':
    sys.exit(main())
