# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Offsets of an arm's joints that put the deflected end effector back on its rigid pose: a ROS node.

It reads /end_effector/deflection (of `chain`) and /joint_states, and takes the kinematics from --urdf, or without it
from the topic /robot_description. By itself it runs dry: it publishes what it would do on /compensator/proposed. With
--drive it publishes /compensator/offsets, which your controller adds to its commands. They are zero until they are
enabled. They hold their last value within a tenth of a second if the deflection is stale, jumps or cannot be trusted.
Each option is a ROS parameter, too.

  psd-deflection compensator --urdf config/two_links.urdf --tip tool --axes x,z
  psd-deflection compensator --urdf arm.urdf --tip tool0 --drive
  ros2 run psd_deflection compensator --ros-args -p tip:=tool0 -p drive:=true
  ros2 service call /compensator/enable std_srvs/srv/SetBool "{data: true}"

docs/compensation.md describes it.
"""

import argparse

from psd_deflection.arms.compensation.arm import NO_TIP, read_arm
from psd_deflection.arms.compensation.settings import SETTINGS
from psd_deflection.base.errors import ConfigError
from psd_deflection.cli._display import Display
from psd_deflection.cli._options import of_options, require_ros, section_options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    section_options(parser, SETTINGS)
    parser.add_argument('--ros-args', action='store_true', help='arguments after this go to ROS')


def run(args: argparse.Namespace) -> int:
    """Run until Ctrl-C; then the offsets go back to zero."""
    settings = of_options(args, SETTINGS)
    if not args.ros_arguments:
        # Before ROS is started; else ROS may have parameters that change it.
        if settings.urdf:
            read_arm(settings.urdf, settings.tip, settings.base)
        elif not settings.tip:
            raise ConfigError(NO_TIP)
    require_ros()
    from psd_deflection.ros.compensator import run_compensator

    return run_compensator(args.ros_arguments, settings, Display().log)
