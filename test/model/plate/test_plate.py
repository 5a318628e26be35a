# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pose to dots and back, against a simulator in space that shares no code, and against golden readings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from psd_deflection.model.plate import Geometry
from psd_deflection.model.plate.plate import (
    Tilts,
    crossing,
    crossings,
    flat_points,
    flat_pose,
    flat_poses,
    plate_points,
    points_under,
    reading_slopes,
    tie_matrix,
    tied_pose,
)
from psd_deflection.model.plate.rays import hit, lifted, rotation
from psd_deflection.rig.config import load_rig

POSES = np.random.default_rng(5).normal(size=(6, 5)) * [0.003, 0.003, 0.05, 0.02, 0.02]
STAGGERED = Geometry(
    np.array([[0.0, 0.070], [-0.100, 0.0], [0.03, -0.05]]),
    np.array([[7e-5, -5e-5], [-3e-5, 4e-5], [1e-4, 0.0]]),
    np.array([0.05, -0.02, 0.01]),
    0.585,
)


@pytest.mark.parametrize('case', [f'G{i}' for i in range(1, 12)])
def test_golden_readings(golden: Any, case: str) -> None:
    dx, dy, _, theta, phi, omega = golden.cases[case]['pose']
    geometry = golden.geometry(case)
    points = plate_points(np.array([dx, dy, theta, phi, omega]), geometry.beams, geometry.heights)
    assert (points - geometry.centers).ravel() == pytest.approx(np.array(golden.dots(case)), abs=1e-15)


def test_the_dots_are_where_the_rays_meet_the_plate(rays: Any) -> None:
    expected = np.array([rays.tip_dots(STAGGERED, pose) for pose in POSES]).reshape(6, 3, 2) + STAGGERED.centers
    beams, heights = STAGGERED.beams, STAGGERED.heights
    points, jacobian = crossings(POSES, beams, heights)
    assert points == pytest.approx(expected, abs=1e-15)
    np.testing.assert_array_equal(plate_points(POSES, beams, heights), points)
    np.testing.assert_array_equal(
        np.stack(
            points_under((beams[:, 0], beams[:, 1], heights), tuple(np.moveaxis(POSES[..., None], 1, 0))),
            axis=-1,
        ),
        points,
    )
    # One beam and pose at a time, in floats.
    for i in range(len(POSES)):
        dx, dy, theta, phi, omega = POSES[i].tolist()
        for j in range(3):
            lx, ly = beams[j].tolist()
            qx, qy, row_x, row_y = crossing((lx, ly, float(heights[j])), (dx, dy, theta, phi, omega))
            assert (qx, qy) == pytest.approx(points[i, j], abs=1e-16)
            assert np.array([row_x, row_y]) == pytest.approx(jacobian[i, j], abs=1e-14)
    # A beam of its own for each pose.
    many = np.broadcast_to(beams, (6, 3, 2))
    np.testing.assert_array_equal(crossings(POSES, many, heights)[1], jacobian)


def test_derivatives_agree_with_differences() -> None:
    step = 1e-6
    beams, heights = STAGGERED.beams, STAGGERED.heights
    moved = [
        (plate_points(POSES + d, beams, heights) - plate_points(POSES - d, beams, heights)) / (2.0 * step)
        for d in step * np.eye(5)
    ]
    jacobian = crossings(POSES, beams, heights)[1]
    assert jacobian == pytest.approx(np.stack(moved, axis=-1), abs=1e-9)
    pushed = [
        (plate_points(POSES, beams + d, heights) - plate_points(POSES, beams - d, heights)) / (2.0 * step)
        for d in step * np.eye(2)
    ]
    assert -jacobian[..., :2] == pytest.approx(np.stack(pushed, axis=-1), abs=1e-9)


def test_a_flat_pose_comes_back(rays: Any) -> None:
    flat = POSES * [1.0, 1.0, 20.0, 0.0, 0.0]
    level = Geometry(STAGGERED.centers, STAGGERED.zeros, np.zeros(3), 0.585)
    points = np.array([rays.tip_dots(level, pose) for pose in flat]).reshape(6, 3, 2) + level.centers
    assert flat_points(flat[:, :3], level.beams) == pytest.approx(points, abs=1e-15)
    assert flat_poses(points, level.beams) == pytest.approx(flat[:, :3], abs=1e-14)
    places = [(x, y) for x, y in level.beams.tolist()]
    for i in range(6):
        assert flat_pose(points[i].ravel().tolist(), places) == pytest.approx(flat[i, :3], abs=1e-14)


def test_beams_and_surfaces_of_any_direction(rays: Any) -> None:
    """Inclined beams on sensors that are turned in the plate, by the simulator and by ``rays``."""
    rolls, directions = [0.02, -0.01, 0.0], np.array([[0.01, 0.0, 1.0], [0.0, -0.02, 1.0], [0.005, 0.005, 1.0]])
    pose = POSES[0]
    expected = rays.tip_dots(STAGGERED, pose, directions=directions, rolls=rolls).reshape(3, 2)
    own = rotation(np.array(rolls), 0.0, 0.0)
    plate = rotation(*pose[2:])
    assert plate == pytest.approx(rays.rotation(*pose[2:]), abs=1e-15)
    centers = lifted(STAGGERED.centers, STAGGERED.heights)
    start = centers + np.einsum('pij,pj->pi', own[..., :2], STAGGERED.zeros)
    got = hit(start, directions, centers @ plate.T + [pose[0], pose[1], 0.0], plate @ own)
    assert got == pytest.approx(expected, abs=1e-15)


def test_the_tie_is_the_cantilevers() -> None:
    pose = np.array([0.00012, -0.00225, 0.01])
    tied = tied_pose(pose, 1.5, 0.585)
    assert tied == pytest.approx(tie_matrix(1.5, 0.585) @ pose, rel=1e-15)
    # Golden case G5: phi 0.33055 deg, omega 0.017629 deg.
    assert np.degrees(tied[3:]) == pytest.approx([0.3305525741, 0.01762947062], rel=1e-9)


def test_many_poses_are_tied_one_by_one() -> None:
    flat = POSES[:, :3]
    for ratios in (1.5, np.linspace(1.0, 2.0, 6)):
        want = [tied_pose(p, k, 0.585) for p, k in zip(flat, np.broadcast_to(ratios, 6), strict=True)]
        np.testing.assert_array_equal(tied_pose(flat, ratios, 0.585), want)


def test_the_geometry_is_that_of_the_rig_file() -> None:
    values = {'psd_1.height': 0.02, 'psd_2.height': -0.01, 'psd_1.zero': [1e-3, 2e-3], 'link.length': 0.4}
    geometry = Geometry.from_rig(load_rig(overrides={**values, 'link.slope_ratio': 1.4, 'psd_2.center': [-0.09, 0.01]}))
    assert geometry.heights.tolist() == [0.02, -0.01]
    assert geometry.centers.tolist() == [[0.0, 0.07], [-0.09, 0.01]]
    assert geometry.zeros.tolist() == [[1e-3, 2e-3], [0.0, 0.0]]
    assert (geometry.link_length, geometry.slope_ratio) == (0.4, 1.4)


@pytest.mark.parametrize('tilts', ['none', 'tied', 'bounded', 'free'])
def test_readings_go_with_what_is_solved_for_as_differences_say(tilts: Tilts) -> None:
    """Of a flat plate whatever its heights and tilts; tied to the deflection; with tilts of their own."""
    pose, beams, k = np.array([2e-3, -3e-3, 0.04, 0.02, -0.03]), STAGGERED.beams, 1.4 / 0.585
    heights = np.zeros(3) if tilts == 'none' else STAGGERED.heights

    def readings(change: Any) -> Any:
        if tilts == 'free':
            moved = change
        else:
            tie = 0.0 if tilts == 'none' else k
            moved = np.array([*change, -tie * change[1], tie * change[0]])
        at = np.array([*pose[:3], 0.0, 0.0]) if tilts == 'none' else pose
        return plate_points(at + moved, beams, heights).ravel()

    steps = 1e-6 * np.eye(5 if tilts == 'free' else 3)
    want = np.stack([(readings(e) - readings(-e)) / 2e-6 for e in steps], axis=1)
    got = reading_slopes(beams, STAGGERED.heights, pose, tilts, 1.4, 0.585)
    np.testing.assert_allclose(got, want, atol=1e-8)
