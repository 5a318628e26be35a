# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Readings taken apart, against the formulas of a plate and a dense least squares."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.loads.plate_motion import across_of, across_plate, moved_plate

RIG = load_rig(
    overrides={
        'psd_1.sensitivity': [4e-4, 6e-4],
        'psd_2.sensitivity': [5e-4, 8e-4],
        'psd_1.zero': [0.002, -0.01],
        'psd_2.zero': [0.01, 0.004],
    }
)
GAINS = np.array([4e-4, 6e-4, 5e-4, 8e-4])
PLATE = np.array([[-1.0, 0.0, 0.06], [0.0, -1.0, -0.002], [-1.0, 0.0, 0.004], [0.0, -1.0, 0.09]])
"""Rows x1 y1 x2 y2 of beams at (0 + 2, 70 - 10) and (-100 + 10, 0 + 4) mm: x_i = -X + ly θ, y_i = -Y - lx θ."""


def as_volts(dots: FloatArray) -> FloatArray:
    """(6, m) of dots (4, m), m."""
    volts = np.full((6, dots.shape[1]), 5.0)
    volts[[0, 1, 3, 4]] = dots / GAINS[:, None]
    return volts


def test_plate_motion_needs_every_reading() -> None:
    poses = np.array([[1e-4, 0.0, 3e-5, 1e-5], [0.0, -2e-4, 1e-5, 2e-5], [0.0, 1e-3, -2e-3, 3e-3]])
    volts, there = as_volts(PLATE @ poses), np.ones((6, 4))
    assert moved_plate(RIG, volts, there) == pytest.approx(poses, abs=1e-12)
    there[[0, 4], [0, 2]] = 0.0
    there[1, 1] = 0.05
    # Without a sum the dots are still known.
    there[5, 3] = 0.0
    lost = np.where([True, False, True, False], np.nan, poses)
    assert moved_plate(RIG, volts, there) == pytest.approx(lost, abs=1e-12, nan_ok=True)


def test_part_across_plate_is_least_squares_residual() -> None:
    dots = np.random.default_rng(1).normal(size=(4, 5))
    left = dots - PLATE @ np.linalg.lstsq(PLATE, dots, rcond=None)[0]
    (found,), (across,) = across_plate(RIG, as_volts(dots)), across_of(RIG)
    assert np.abs(found) == pytest.approx(np.linalg.norm(left, axis=0))
    assert across[:, None] * found == pytest.approx(left)
    assert PLATE.T @ across == pytest.approx(np.zeros(3), abs=1e-12)
