# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One PSD alone: its covariance against matrices, at a twist at which every term counts."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.model.plate import Geometry
from psd_deflection.model.solvers.one_psd import OnePsd
from psd_deflection.rig.config import load_rig


@pytest.mark.parametrize('psd', [0, 1])
@pytest.mark.parametrize('theta_sd', [0.0, 1e-4])
def test_covariance_is_rotated_reading_plus_twist(psd: int, theta_sd: float) -> None:
    geometry = Geometry.from_rig(load_rig())
    dot, variances, theta = np.array([2e-3, -3e-3]), np.array([4e-12, 1e-12]), 0.7
    c, s = np.cos(theta), np.sin(theta)
    turn, slope = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
    gain = -slope @ (geometry.centers[psd] + dot)
    wanted = np.zeros((3, 3))
    wanted[:2, :2] = turn @ np.diag(variances) @ turn.T
    full = np.append(gain, 1.0)
    wanted += theta_sd**2 * np.outer(full, full)
    dx, dy, found = OnePsd(geometry).solve(psd, (2e-3, -3e-3), (4e-12, 1e-12), theta, theta_sd**2)
    np.testing.assert_allclose(np.reshape(found, (3, 3)), wanted, rtol=1e-9, atol=1e-24)
    np.testing.assert_allclose((dx, dy), geometry.beams[psd] - turn @ (geometry.centers[psd] + dot), atol=1e-15)
