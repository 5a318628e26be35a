"""Pose to dots, exactly: golden readings, and derivatives against differences."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psd_deflection.mechanics.dots import beam_jacobian, plate_jacobian, plate_points, tie_matrix, tied_pose

GOLDEN: dict[str, Any] = json.loads((Path(__file__).parents[1] / 'data' / 'golden.json').read_text(encoding='utf-8'))
CENTERS = np.array([[0.0, 0.070], [-0.100, 0.0]])
POSES = np.random.default_rng(5).normal(size=(6, 5)) * [0.003, 0.003, 0.05, 0.02, 0.02]
HEIGHTS = np.array([0.05, -0.02])


@pytest.mark.parametrize('case', [c for c in GOLDEN['cases'] if c['name'] != 'G12'], ids=lambda c: str(c['name']))
def test_golden_readings(case: dict[str, Any]) -> None:
    dx, dy, _, theta, phi, omega = case['pose']
    beams = CENTERS + np.array(case['m0'])
    points = plate_points(np.array([dx, dy, theta, phi, omega]), beams, np.zeros(2))
    assert points - CENTERS == pytest.approx(np.array(case['readings']), abs=1e-15)


def test_derivatives_agree_with_differences() -> None:
    step = 1e-6
    moved = [
        (plate_points(POSES + d, CENTERS, HEIGHTS) - plate_points(POSES - d, CENTERS, HEIGHTS)) / (2.0 * step)
        for d in step * np.eye(5)
    ]
    jacobian = plate_jacobian(POSES, plate_points(POSES, CENTERS, HEIGHTS), HEIGHTS)
    assert jacobian == pytest.approx(np.stack(moved, axis=-1), abs=1e-9)

    pushed = [
        (plate_points(POSES, CENTERS + d, HEIGHTS) - plate_points(POSES, CENTERS - d, HEIGHTS)) / (2.0 * step)
        for d in step * np.eye(2)
    ]
    expected = np.broadcast_to(beam_jacobian(POSES)[:, None], (6, 2, 2, 2))
    assert np.stack(pushed, axis=-1) == pytest.approx(expected, abs=1e-9)


def test_the_tie_is_the_cantilevers() -> None:
    pose = np.array([0.00012, -0.00225, 0.01])
    tied = tied_pose(pose, 1.5, 0.585)
    assert tied == pytest.approx(tie_matrix(1.5, 0.585) @ pose, rel=1e-15)
    # Golden case G5: phi 0.33055 deg, omega 0.017629 deg.
    assert np.degrees(tied[3:]) == pytest.approx([0.3305525741, 0.01762947062], rel=1e-9)
