# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Figures 5.30 to 5.35 of the thesis: the same load with laser dots of 1 mm and of 2 mm.

The thesis finds that dots twice as large make the computed deflection no worse. Here the rig of the thesis is simulated
with both, the same noise, and the part of each Gaussian dot that falls beside the active area missing from its reading.
Blocks of 20 samples are averaged, as there, and solved by its two methods, iteration and weighted least squares.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from psd_deflection.model.detector.clipping import cut_by_edges
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.model.solvers.registry import make_solver
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.thesis.comparison import SIDEBAR, VARIANCES, thesis_geometry

FORCES, DIAMETERS = (50.0, 30.0), (1e-3, 2e-3)
"""Weights on the sidebar, N, and diameters of a dot on the sensor (to 1/e^2 of its peak), m."""
ARM, LEAN = 0.585, 0.054
"""From the link to the weight, m. How far the weight's line is off the rig's Y axis, rad: 0.12 mm of dX at 50 N."""
REST_S, HELD_S = 1.5, 3.5
BLOCK = 20
METHODS: Mapping[str, tuple[str, dict[str, Any]]] = {
    'iteration': ('iterative', {}),
    'weighted least squares': ('wls', {'weights': 'thesis', 'row_scaling': SIDEBAR}),
}


class SpotRun(NamedTuple):
    """One run. ``t`` (n,) s: middle of each block; ``truth`` (n, 3), ``found`` by method (n, 3): m, m, rad."""

    force: float
    diameter: float
    t: FloatArray
    truth: FloatArray
    found: Mapping[str, FloatArray]


@functools.cache
def spot_run(force: float, diameter: float) -> SpotRun:
    """Return the weight ``force``, N, hung on the sidebar, seen by dots of ``diameter``, m."""
    rig = load_rig()
    rest, held = (round(s * rig.converter.sample_rate_hz) for s in (REST_S, HELD_S))
    loads = np.repeat([[0.0, 0.0, 0.0], [LEAN * force, -force, -ARM * force]], [rest, held], axis=0)
    made = RigSimulator(rig, seed=1).step(loads)
    readings = made.counts[:, [0, 1, 3, 4]] * rig.converter.volts_per_count * rig.sensitivities.ravel()
    half = np.array([side / 2.0 for psd in rig.psds for side in psd.active_area])
    for column, edge in enumerate(half.tolist()):
        _, moved = cut_by_edges(made.dots[:, column], edge, 0.5 * diameter)
        readings[:, column] += moved
    dots = readings.reshape(-1, BLOCK, 4).mean(axis=1)
    truth = made.pose[:, :3].reshape(-1, BLOCK, 3).mean(axis=1)
    t = np.asarray((np.arange(len(dots)) + 0.5) * BLOCK / rig.converter.sample_rate_hz, np.float64)
    geometry = thesis_geometry()
    results = {
        label: make_solver(name, geometry, **options).solve_many(dots, VARIANCES).pose[:, :3]
        for label, (name, options) in METHODS.items()
    }
    return SpotRun(force, diameter, t, truth, results)


class SpotChange(NamedTuple):
    """What dots of 2 mm change of those of 1 mm, of one weight and method; (3,) m, m, rad each.

    ``largest``: of any block, with the same noise. ``error``: mean error while the weight is held, of either.
    """

    force: float
    method: str
    largest: FloatArray
    error: tuple[FloatArray, FloatArray]


def spot_changes() -> list[SpotChange]:
    """For each weight and method of the figures."""
    out = []
    for force in FORCES:
        small, large = (spot_run(force, diameter) for diameter in DIAMETERS)
        held = small.t > REST_S + HELD_S - 1.0
        for method in METHODS:
            largest = np.abs(large.found[method] - small.found[method]).max(axis=0)
            errors = [(run.found[method] - run.truth)[held].mean(axis=0) for run in (small, large)]
            out.append(SpotChange(force, method, largest, (errors[0], errors[1])))
    return out
