# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Lasers on the plate, and beams that lean: against rays in space."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate import Geometry
from psd_deflection.model.plate.landing import landing, landings
from psd_deflection.model.plate.layout import check_shapes, check_twist
from psd_deflection.model.plate.plate import points_under_leaning
from psd_deflection.model.plate.rays import hit, rotation

POSES = np.array([[1e-3, -2e-3, 0.05, 0.02, -0.03], [0.0, 0.0, -0.3, -0.2, 0.25], [2e-3, 1e-3, 0.1, 0.15, 0.1]])
PLACE = (0.03, -0.08)


@pytest.mark.parametrize('pose', POSES)
@pytest.mark.parametrize('height', [0.0, 0.05])
def test_laser_on_plate_lands_where_ray_meets_surface(pose: np.ndarray, height: float) -> None:
    plate = rotation(*pose[2:])
    start = plate @ [*PLACE, 0.0] + [pose[0], pose[1], 0.0]
    want = hit(start, plate[:, 2], np.array([0.0, 0.0, height]), np.eye(3))
    x, y, by_x, by_y = landing((*PLACE, height), tuple(pose.tolist()))
    assert (x, y) == pytest.approx(want, abs=1e-15)
    lx, ly, h, dx, dy, theta, phi, omega = (np.asarray(v) for v in (*PLACE, height, *pose))
    many = landings((lx, ly, h), (dx, dy, theta, phi, omega))
    assert np.array(many) == pytest.approx(want, abs=1e-15)
    for i in range(5):
        step = 1e-6 * np.eye(5)[i]
        moved = [tuple((pose + s).tolist()) for s in (step, -step)]
        ahead, behind = (np.array(landing((*PLACE, height), p)[:2]) for p in moved)
        assert (by_x[i], by_y[i]) == pytest.approx((ahead - behind) / 2e-6, abs=1e-9)


@pytest.mark.parametrize('height', [-0.05, 0.0, 0.04])
def test_a_beam_that_leans_meets_the_plate_where_its_ray_does(height: float) -> None:
    pose, slopes = np.array([1e-3, -2e-3, 0.05, 0.03, -0.02]), (0.02, -0.01)
    plate = rotation(*pose[2:])
    origin = plate @ [0.0, 0.0, height] + [pose[0], pose[1], 0.0]
    want = hit(np.array([*PLACE, height]), np.array([*slopes, 1.0]), origin, plate)
    lx, ly, sx, sy, h, dx, dy, theta, phi, omega = (np.asarray(v) for v in (*PLACE, *slopes, height, *pose))
    got = points_under_leaning((lx, ly, h), (sx, sy), (dx, dy, theta, phi, omega))
    # Three passes, each of which leaves 6e-4 of the error before it, of 10 um at first.
    assert np.array(got) == pytest.approx(want, abs=3e-14)


@pytest.mark.parametrize(
    ('centers', 'heights', 'message'),
    [
        (np.zeros((2, 3)), 2, r'centers has shape \(2, 3\)'),
        (np.zeros(4), 2, r'centers has shape \(4,\)'),
        (np.zeros((1, 2)), 1, '1 PSD: one dot cannot tell'),
        (np.zeros((2, 2)), 3, 'must all be of the same 2 PSDs'),
        (np.full((2, 2), np.nan), 2, 'centers must be finite'),
    ],
)
def test_arrays_that_are_no_geometry_are_rejected(centers: np.ndarray, heights: int, message: str) -> None:
    with pytest.raises(SolverError, match=message):
        check_shapes(Geometry(centers, np.zeros(centers.shape), np.zeros(heights), 0.585))


def test_beams_closer_than_a_micrometre_are_rejected() -> None:
    """The rejection says where they are: at the first one's place."""
    for along in ((1.0, 0.0), (0.0, 1.0), (-0.6, 0.8)):
        for apart, message in ((0.9e-6, True), (1.1e-6, False)):
            centers = np.array([[0.01, 0.07], [0.01, 0.07]]) + np.array([[0.0, 0.0], along]) * apart
            geometry = Geometry(centers, np.zeros((2, 2)), np.zeros(2), 0.585)
            if message:
                with pytest.raises(SolverError, match=r'psd_1 and psd_2 coincide at \(0\.01, 0\.07\) m'):
                    check_twist(geometry)
            else:
                assert check_twist(geometry) == 2
    # Beams, not centres, count; and of three any two that differ.
    zeros = np.array([[0.0, 0.0], [1e-3, 0.0], [0.0, 0.0]])
    assert check_twist(Geometry(np.zeros((3, 2)), zeros, np.zeros(3), 0.585)) == 3
    with pytest.raises(SolverError, match='psd_1 and psd_2 and psd_3 coincide'):
        check_twist(Geometry(np.zeros((3, 2)), np.zeros((3, 2)), np.zeros(3), 0.585))
