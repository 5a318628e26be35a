# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is believed of a robot's drivers."""

from __future__ import annotations

import math

from psd_deflection.arms.compensation.robot import RobotWatch


def test_a_robot_of_which_nothing_is_reported_runs() -> None:
    assert RobotWatch().fault(1e9) == ''


def test_driver_run_state_persists_until_next_report() -> None:
    robot = RobotWatch()
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
    assert robot.fault(1.45) == ''
    assert robot.fault(1.6) == 'the robot does not run: its speed scaling comes no more'
    robot.scaled(2.0, 1.0)
    assert robot.fault(2.1) == 'the robot does not run: its state of the controller comes no more'
