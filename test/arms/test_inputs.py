# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is believed of messages of joints, and of a robot's drivers."""

import math

import pytest

from psd_deflection.arms.inputs import KNOWN_S, LONGEST_LIST, KnownJoints, RobotWatch, joints_fault


def test_positions_are_known_for_a_while() -> None:
    known = KnownJoints()
    known.notify(1.0, ['a', 'b', 'c', 'd'], [0.1, math.nan, 1e300, -0.2])
    assert {name: joint.position for name, joint in known.measured(1.0 + KNOWN_S).items()} == {'a': 0.1, 'd': -0.2}
    assert known.measured(1.01 + KNOWN_S) == {}


@pytest.mark.parametrize(
    ('names', 'positions', 'why'),
    [
        (['a', 'other'], [1e4, math.nan], ''),
        (['a', 'b'], [], ''),
        (['a', 'b'], [0.0, -1.1e4], 'b = -11000: must be finite and at most 10000'),
        (['a', 'b'], [math.nan, 0.0], 'a = nan: must be finite and at most 10000'),
        (['a', 'b'], [0.0], '1 positions of 2 joints'),
        (['a', 'b', 'a'], [0.0] * 3, 'a joint is named twice'),
        ([str(n) for n in range(1000)], [0.0] * 1000, ''),
        ([str(n) for n in range(1001)], [0.0] * 1001, '1001 joints: must be at most 1000'),
    ],
)
def test_positions_of_joints_are_told_why_not(names: list[str], positions: list[float], why: str) -> None:
    assert joints_fault(names, positions, ('a', 'b')) == why


@pytest.mark.parametrize('period', [0.002, 0.01, 0.1, 0.3])
def test_a_speed_is_that_over_a_tenth_of_a_second(period: float) -> None:
    known, speeds = KnownJoints(), []
    for n in range(round(2.0 / period)):
        now = n * period
        # It moves at 0.2 for a second, then stands; its encoder shakes by 0.1 mrad.
        known.notify(now, ['a'], [0.2 * min(now, 1.0) + 1e-4 * (n % 2)])
        speeds.append(known.measured(now)['a'].speed)
    assert next(n for n, s in enumerate(speeds) if s == s) * period == pytest.approx(max(0.1, period), abs=3e-3)
    assert speeds[round(1.0 / period) - 1] == pytest.approx(0.2, abs=2e-3)
    assert speeds[-1] < 2e-3
    # Told again after a silence, its speed is not known.
    known.notify(10.0, ['a'], [0.2])
    assert math.isnan(known.measured(10.0)['a'].speed)


@pytest.mark.parametrize('pause', [0.0, 2.0 * KNOWN_S])
def test_flood_of_unknown_joint_names_stays_bounded(pause: float) -> None:
    known, now = KnownJoints(), 0.0
    for n in range(300):
        known.notify(now, ['shoulder'], [0.5])
        known.notify(now, [f'{n}-{k}' for k in range(997)], [0.0] * 997)
        assert len(known) <= LONGEST_LIST
        assert known.measured(now)['shoulder'].position == 0.5
        now += pause


def test_names_of_long_ago_make_room_for_new_ones() -> None:
    known = KnownJoints()
    known.notify(0.0, [f'{k}' for k in range(LONGEST_LIST)], [0.0] * LONGEST_LIST)
    known.notify(0.5 * KNOWN_S, ['late'], [0.1])
    assert 'late' not in known.measured(0.5 * KNOWN_S)
    known.notify(1.5 * KNOWN_S, ['late'], [0.1])
    assert list(known.measured(1.5 * KNOWN_S)) == ['late']
    assert len(known) == 1


def test_driver_run_state_persists_until_next_report() -> None:
    robot = RobotWatch()
    assert robot.fault(1e9) == ''
    robot.runs(False)
    assert robot.fault(1e6) == 'the robot does not run'
    robot.runs(True)
    assert robot.fault(2e6) == ''


def test_a_robot_that_is_scaled_to_no_speed_does_not_run() -> None:
    robot = RobotWatch()
    for scaling, fault in ((100.0, ''), (0.5, ''), (0.0, 'its speed scaling is 0'), (math.nan, 'scaling is nan')):
        robot.scaled(1.0, scaling)
        assert fault in robot.fault(1.1)
        assert bool(robot.fault(1.1)) == bool(fault)


def test_what_came_again_and_again_is_missed() -> None:
    robot = RobotWatch()
    robot.scaled(1.0, 1.0)
    robot.controlled(1.4)
    assert (robot.fault(1.45), robot.fault(1.6)) == ('', 'the robot does not run: its speed scaling comes no more')
    robot.scaled(2.0, 1.0)
    assert robot.fault(2.1) == 'the robot does not run: its state of the controller comes no more'
