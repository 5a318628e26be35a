# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The duels: a made Silverbox whose spring is known, the measures by hand, the rows of what is not there."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from blind import silverbox
from blind.silverbox import RATE, Silverbox
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plant_search import discover_in

pytestmark = pytest.mark.slow

COUNT, CUBIC = 2700, 4.0


def oscillator(folder: Path) -> FloatArray:
    """A file of an oscillator of 70 Hz, damping 0.05, whose spring stiffens by 4 y^3; its output.

    By scipy's integrator, with an input that is a sum of sines, in its second period: nothing of the plant.
    """
    rng = np.random.default_rng(5)
    periods = np.arange(40, 800, 8)
    phases = rng.uniform(0.0, 2.0 * math.pi, len(periods))
    w = 2.0 * math.pi * 70.0

    def force(t: float | FloatArray) -> FloatArray:
        turn = 2.0 * math.pi * periods * RATE / COUNT
        return np.asarray(0.005 * np.sin(np.multiply.outer(np.asarray(t), turn) + phases).sum(axis=-1))

    def rate(t: float, state: FloatArray) -> list[float]:
        y, v = state
        return [v, w**2 * (float(force(t)) - y - CUBIC * y**3) - 2.0 * 0.05 * w * v]

    times = np.arange(COUNT) / RATE
    later = times + COUNT / RATE
    y = np.asarray(solve_ivp(rate, (0.0, later[-1]), [0.0, 0.0], t_eval=later, rtol=1e-8, atol=1e-10).y[0])
    y = y + 1e-4 * rng.standard_normal(COUNT)
    rows = [f'{u:.9g},{v:.9g},' for u, v in zip(force(times), y, strict=True)]
    (folder / silverbox.FILE).write_text('\n'.join(['"V1","V2",', *rows, '', '']))
    return y


def test_cubic_spring_of_synthetic_silverbox_is_found(tmp_path: Path) -> None:
    y = oscillator(tmp_path)
    plant = Silverbox(tmp_path, train=(0, COUNT), shape=(4, 6))
    np.testing.assert_allclose(plant.y, y, atol=1e-9)
    np.testing.assert_array_equal(np.concatenate(plant.measured(), axis=1)[0], plant.y[50:2450])
    plant.library = tuple(e for e in plant.library if e.name in ('cubic_spring', 'quadratic_drag', 'force_offset'))
    found = discover_in(plant)
    (spring,) = found.effects
    assert spring.active.effect.name == 'cubic_spring'
    assert spring.active.values['stiffening'] == pytest.approx(CUBIC, rel=0.05)
    assert 0.9e-4 < found.gap_after < 2e-4
