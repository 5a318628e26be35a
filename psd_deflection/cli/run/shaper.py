# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Shapes joint trajectories, so that a motion does not ring the link: a ROS node.

It reads trajectories on /shaper/trajectory and publishes them on /shaper/shaped, to which you remap your controller's
topic. Begin and end are those that were given; the motion takes longer by a fraction of a period of the link. The mode
comes from the rig file that `identify` wrote, or from --frequency and --damping-ratio. With --urdf a trajectory beyond
the limits of the joints is rejected; `--urdf robot_description` takes them from that topic. Each option is a ROS
parameter, too. With --action it does the same for goals of FollowJointTrajectory, as MoveIt sends them.

  psd-deflection shaper --params-file modes/rig.yaml
  psd-deflection shaper --frequency 14 --damping-ratio 0.02 --shaper ei
  ros2 run psd_deflection shaper --params-file modes/rig.yaml --urdf arm.urdf

docs/shaping.md describes it.
"""

import argparse

from psd_deflection.arms.compensation.settings import SHAPING, trajectory_shaper
from psd_deflection.cli._display import Display
from psd_deflection.cli._options import of_options, require_ros, section_options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    section_options(parser, SHAPING)
    parser.add_argument('--ros-args', action='store_true', help='arguments after this go to ROS')


def run(args: argparse.Namespace) -> int:
    """Run until Ctrl-C."""
    settings = of_options(args, SHAPING)
    if not args.ros_arguments:
        # Before ROS is started; else ROS may have parameters that change it.
        trajectory_shaper(settings)
    require_ros()
    from psd_deflection.ros.shaper import run_shaper

    return run_shaper(args.ros_arguments, settings, Display().log)
