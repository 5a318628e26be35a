# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Statements of the audit that are more than one number: how often, how much, which way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from psd_deflection.model.plate import Geometry
from psd_deflection.model.solvers import make_solver
from psd_deflection.studies.thesis.comparison import VARIANCES, dots_of, grid, thesis_geometry

pytestmark = pytest.mark.slow

UNITS = np.array([1e6, 1e6, 1e3 * 180.0 / np.pi])


@pytest.fixture(scope='module')
def code_runs() -> tuple[Any, Any]:
    """Appendix D on 12,000 flat poses within 5 mm and 3 degrees: poses, answers."""
    rng = np.random.default_rng(7)
    poses = np.zeros((12_000, 5))
    poses[:, :3] = rng.uniform(-1.0, 1.0, (12_000, 3)) * (5e-3, 5e-3, np.radians(3.0))
    geometry = thesis_geometry()
    return poses, make_solver('appendix_d', geometry).solve_many(dots_of(geometry, poses), VARIANCES)


def test_the_code_stops_early_on_clockwise_twist(code_runs: Any) -> None:
    poses, found = code_runs
    clockwise = poses[:, 2] < 0.0
    assert not found.status[clockwise].any()
    off = (found.pose - poses[:, :3])[clockwise] * UNITS
    assert np.abs(off[:, 2]).max() < 200.0
    np.testing.assert_allclose(off[:, 2].mean(), 75.7, atol=0.5)
    np.testing.assert_allclose(off[:, 0].mean(), 92.5, atol=0.5)


def test_the_code_loses_and_mistakes_counter_clockwise_twist(code_runs: Any) -> None:
    poses, found = code_runs
    counter = poses[:, 2] > 0.0
    lost = found.status[counter] != 0
    off = np.abs(found.pose - poses[:, :3])[counter, 2] * UNITS[2]
    assert lost.mean() == pytest.approx(0.0268, abs=0.005)
    assert (off[~lost] > 200.0).mean() == pytest.approx(0.0089, abs=0.004)
    small = np.abs(poses[counter, 1]) < 50e-6
    assert lost[small].mean() > 0.7
    assert not lost[np.abs(poses[counter, 1]) > 0.3e-3].any()


@pytest.mark.parametrize('k', [1.0, 1.395, 2.0])
def test_a_wrong_slope_ratio_costs_little(k: float) -> None:
    """rms over the grid where the beam solver takes 1.5: micrometres and millidegrees (docs/methods.md)."""
    true = Geometry(thesis_geometry().centers, np.zeros((2, 2)), np.zeros(2), 0.585, k)
    poses = grid('cantilever tilts', true)
    found = make_solver('beam', thesis_geometry()).solve_many(dots_of(true, poses), VARIANCES)
    rms = np.sqrt(np.mean((found.pose - poses[:, :3]) ** 2, axis=0)) * UNITS
    want = {1.0: (1.9, 1.5, 1.0), 1.395: (0.45, 0.36, 0.25), 2.0: (2.6, 2.1, 1.4)}[k]
    np.testing.assert_allclose(rms, want, rtol=0.05)


def test_printed_test_stops_at_0_with_psd_2_opposite(rays: Any) -> None:
    """2.20-2.23 without magnitudes, c_2 at (+100, 0) mm, d = (1, -2) mm: 0 for 1 and 2 degrees."""
    geometry = Geometry(np.array([[0.0, 0.07], [0.1, 0.0]]), np.zeros((2, 2)), np.zeros(2), 0.585)
    for degrees, absolute in ((1.0, 0.95), (2.0, 1.95)):
        dots = tuple(rays.tip_dots(geometry, (1e-3, -2e-3, np.radians(degrees), 0.0, 0.0)).tolist())
        printed = make_solver('iterative_printed', geometry).solve(dots, (4e-12,) * 4)
        assert printed.theta == 0.0
        meant = make_solver('iterative_printed', geometry, criterion='absolute').solve(dots, (4e-12,) * 4)
        assert np.degrees(meant.theta) == pytest.approx(absolute, abs=1e-9)
