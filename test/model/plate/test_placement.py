# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Sensor placement: condition numbers, gains, spreads in closed form and by the matrix, and the search."""

import math

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.plate import placement
from psd_deflection.model.plate.linear import condition_number, design_matrix
from psd_deflection.model.plate.placement import Room
from psd_deflection.model.plate.plate import plate_points
from psd_deflection.records import FloatArray

THESIS = np.array([[0.0, 0.070], [-0.100, 0.0]])
SIGMA = 2e-6
MICRO_MILLIDEGREE = np.array([1e6, 1e6, math.degrees(1e3)])


@pytest.mark.parametrize(
    ('centers', 'expected', 'cond'),
    [
        (THESIS, (1.63, 1.83, 1.33), 2.45),
        (placement.opposite(0.061), (1.41, 1.41, 1.33), 1.64),
        (placement.opposite(0.100), (1.41, 1.41, 0.81), 1.00),
    ],
)
def test_spreads_of_the_placements_compared(
    centers: FloatArray, expected: tuple[float, float, float], cond: float
) -> None:
    closed = np.array(placement.deviations_of_pair(centers, SIGMA))
    assert closed * MICRO_MILLIDEGREE == pytest.approx(expected, abs=5e-3)
    design = design_matrix(centers)
    by_matrix = SIGMA * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    assert closed == pytest.approx(by_matrix, rel=1e-12)
    assert condition_number(design_matrix(centers), 0.1).two == pytest.approx(cond, abs=5e-3)


def test_three_sensors_see_tilt_only_when_staggered() -> None:
    ring = placement.ring(3, 0.100)
    tilted = np.array([0.0, 0.0, 0.0, math.radians(0.3), math.radians(0.1)])
    mdeg = math.degrees(1e3)
    coplanar = placement.pose_deviations(tilted, ring, np.zeros(3), SIGMA)
    assert coplanar[3:] * mdeg == pytest.approx([178.0, 234.0], abs=0.5)
    staggered = placement.pose_deviations(tilted, ring, np.array([0.100, -0.050, -0.050]), SIGMA)
    assert staggered[3:] * mdeg == pytest.approx([0.93, 1.32], abs=5e-3)
    at_rest = placement.pose_deviations(np.zeros(5), ring, np.zeros(3), SIGMA)
    assert np.isfinite(at_rest).tolist() == [True, True, True, False, False]
    # Two leave a direction unseen.
    tilted = np.array([0.001, 0.002, 0.01, 0.004, 0.003])
    assert not np.any(np.isfinite(placement.pose_deviations(tilted, THESIS, np.array([0.05, -0.05]), SIGMA)))


@pytest.mark.parametrize(
    ('room', 'expected'),
    [(Room(0.100), 1.0), (Room(0.100, keep_out=0.030), 1.0), (Room(0.080, box=(-0.2, -0.2, 0.2, 0.2)), 1.25)],
)
def test_a_round_room_wants_its_sensors_opposite(room: Room, expected: float) -> None:
    pair = placement.best_pair(room)
    assert pair[0] == pytest.approx(-pair[1], abs=1e-9)
    assert np.hypot(*pair.T) == pytest.approx(room.radius, rel=1e-9)
    assert condition_number(design_matrix(pair), 0.1).two == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize('radius', [0.030, 0.100])
def test_each_rim_has_candidates_all_around(radius: float) -> None:
    points = Room(0.100, keep_out=0.030).candidates()
    angles = np.sort(np.arctan2(*points[np.abs(np.hypot(*points.T) - radius) < 1e-9].T))
    assert np.diff(angles, append=angles[0] + 2.0 * math.pi) == pytest.approx(2.0 * math.pi / (8 * 24))


def test_the_search_beats_every_pair_of_a_finer_grid() -> None:
    # A corner only: base line and midpoint pull in different directions.
    room = Room(0.100, keep_out=0.030, box=(0.0, 0.0, 0.080, 0.090))
    pair = placement.best_pair(room)
    assert np.all(room.holds(pair))
    grid = np.stack(np.meshgrid(np.linspace(0.0, 0.080, 41), np.linspace(0.0, 0.090, 46)), axis=-1).reshape(-1, 2)
    grid = grid[room.holds(grid)]
    first, second = grid[:, None], grid[None, ::3]
    base_square = np.sum((first - second) ** 2, axis=-1)
    base_square[base_square == 0.0] = 1e-12
    # var dX + var dY + (0.1 m)^2 var theta for sigma = 1, written out.
    costs = 1.0 + 2.0 / base_square * (np.sum(((first + second) / 2.0) ** 2, axis=-1) + 0.1**2)
    best = float(placement.cost(np.array(placement.deviations_of_pair(pair, 1.0))))
    assert best <= math.sqrt(float(np.min(costs)))
    assert best == pytest.approx(math.sqrt(float(np.min(costs))), rel=0.02)


def test_the_search_finds_what_lies_between_its_candidates() -> None:
    """In what is right of x = 11 mm: as far apart as the rim allows, with the middle as near as the edge allows."""
    pair = placement.best_pair(Room(0.100, box=(0.011, -0.2, 0.2, 0.2)))
    y = math.sqrt(0.100**2 - 0.011**2)
    assert pair == pytest.approx(np.array([[0.011, y], [0.011, -y]]), abs=1e-8)


@pytest.mark.parametrize(
    ('radius', 'keep_out', 'box', 'message'),
    [
        (0.0, 0.0, None, '^radius = '),
        (math.nan, 0.0, None, '^radius = '),
        (0.1, 0.2, None, '^keep_out = '),
        (0.1, -0.1, None, '^keep_out = '),
        (0.1, 0.0, (0.1, 0.0, 0.0, 0.1), '^box = '),
        (0.1, 0.0, (0.0, 0.1, 0.1, 0.0), '^box = '),
        (0.1, 0.0, (0.1, 0.0, 0.1, 0.1), '^box = '),
        (0.1, 0.0, (0.0, 0.1, 0.1, 0.1), '^box = '),
        (math.inf, 0.0, None, '^radius = '),
    ],
)
def test_an_impossible_room_is_rejected(
    radius: float, keep_out: float, box: tuple[float, float, float, float] | None, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        Room(radius, keep_out, box)


def test_a_room_too_small_for_two_is_rejected() -> None:
    with pytest.raises(ConfigError, match='no room'):
        placement.best_pair(Room(0.1, box=(0.2, 0.2, 0.3, 0.3)))


def test_one_place_is_no_room_for_two_and_two_are() -> None:
    """A corner that touches the rim; a corner and one point of the rim."""
    with pytest.raises(ConfigError, match='no room'):
        placement.best_pair(Room(0.1, box=(0.06, 0.08, 0.2, 0.2)))
    room = Room(0.1, box=(0.0999, 0.001, 0.2, 0.2))
    assert len(room.candidates()) == 2
    pair = placement.best_pair(room)
    assert room.holds(pair).all()
    assert pair == pytest.approx(np.array([[0.0999, math.sqrt(0.1**2 - 0.0999**2)], [0.0999, 0.001]]), abs=1e-8)


def test_ring_starts_above_unless_azimuth_is_given() -> None:
    assert placement.opposite(0.1) == pytest.approx(np.array([[0.0, 0.1], [0.0, -0.1]]))
    assert placement.opposite(0.1, 0.3) == pytest.approx(0.1 * np.array([[c, s] for c, s in _at(0.3, 0.3 + math.pi)]))
    sixty = math.sqrt(0.75)
    assert placement.ring(3, 0.1) == pytest.approx(0.1 * np.array([[0.0, 1.0], [-sixty, -0.5], [sixty, -0.5]]))
    assert placement.ring(4, 0.1, 0.3) == pytest.approx(
        0.1 * np.array(_at(*(0.3 + quarter * math.pi / 2.0 for quarter in range(4))))
    )


def _at(*angles: float) -> list[tuple[float, float]]:
    return [(math.cos(a), math.sin(a)) for a in angles]


def test_placement_deviations_are_dense_least_squares() -> None:
    centers, heights = placement.ring(3, 0.1), np.array([0.1, -0.05, -0.05])
    pose = np.array([1e-3, -2e-3, 0.02, 0.03, -0.04])
    step = 1e-6
    columns = [
        (plate_points(pose + e, centers, heights) - plate_points(pose - e, centers, heights)).ravel() / (2.0 * step)
        for e in step * np.eye(5)
    ]
    jacobian = np.stack(columns, axis=1)
    want = SIGMA * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    assert placement.pose_deviations(pose, centers, heights, SIGMA) == pytest.approx(want, rel=1e-5)
    flat = np.array([1e-3, -2e-3, 0.02])

    def tied(x: FloatArray) -> FloatArray:
        five = np.array([*x[:3], -x[3] * x[1] / 0.585, x[3] * x[0] / 0.585])
        return plate_points(five, centers, heights).ravel()

    x = np.array([*flat, 1.5])
    jacobian = np.stack([(tied(x + e) - tied(x - e)) / (2.0 * step) for e in step * np.eye(4)], axis=1)
    want = SIGMA * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    got = placement.slope_ratio_deviations(flat, 1.5, 0.585, centers, heights, SIGMA)
    assert got == pytest.approx(want, rel=1e-5)
