# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Offsets of an arm's joints that put the deflected end effector back on its rigid pose: a ROS node.

It reads /end_effector/deflection (of `chain`) and /joint_states, and takes the kinematics from ARM.urdf, or without it
from the topic /robot_description. By itself it runs dry: it publishes what it would do on /compensator/proposed. With
--drive it publishes /compensator/offsets, which your controller adds to its commands. They are zero until they are
enabled. They hold their last value within a tenth of a second if the deflection is stale, jumps or cannot be trusted.

  psd-deflection compensator config/two_links.urdf --tip tool --axes x,z
  psd-deflection compensator arm.urdf --tip tool0 --drive --max-offset 0.01
  ros2 run psd_deflection compensator --tip tool0 --drive
  ros2 service call /compensator/enable std_srvs/srv/SetBool "{data: true}"

docs/compensation.md describes it.
"""

from __future__ import annotations

import argparse

from psd_deflection.arms.compensation.arm import read_arm
from psd_deflection.arms.compensation.settings import SETTINGS
from psd_deflection.cli._display import Display
from psd_deflection.cli._options import of_options, section_options
from psd_deflection.cli.run._ros import require_ros


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'urdf', metavar='ARM.urdf', nargs='?', help='kinematics of the arm (default: the topic robot_description)'
    )
    parser.add_argument('--tip', metavar='LINK', required=True, help='link of the end effector')
    parser.add_argument('--base', metavar='LINK', default='', help='link from which on joints count (the root)')
    parser.add_argument('--drive', action='store_true', help='publish offsets for a controller (default: proposals)')
    section_options(parser, SETTINGS)
    parser.add_argument('--ros-args', action='store_true', help='arguments after this go to ROS')


def run(args: argparse.Namespace) -> int:
    """Run until Ctrl-C; then the offsets go back to zero."""
    settings = of_options(args, SETTINGS)
    arm = None if args.urdf is None else read_arm(args.urdf, args.tip, args.base)
    require_ros()
    from psd_deflection.ros.compensator import DescribedArm, run_compensator

    robot = arm or DescribedArm(args.tip, args.base)
    return run_compensator(args.ros_arguments, robot, settings, Display().log, args.drive)
