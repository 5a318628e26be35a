"""Offsets of an arm's joints that put the deflected end effector back on its rigid pose: a ROS node.

It reads /end_effector/deflection (of `chain`) and /joint_states, and takes the kinematics from ARM.urdf. By itself
it runs dry: it publishes what it would do on /compensator/proposed. With --drive it publishes /compensator/offsets,
which your controller adds to its commands. They are zero until they are enabled. They hold their last value within
a tenth of a second if the deflection is stale, jumps or cannot be trusted.

  psd-deflection compensator config/two_links.urdf --tip tool --axes x,z
  psd-deflection compensator arm.urdf --tip tool0 --drive --max-offset 0.01
  ros2 run psd_deflection compensator arm.urdf --tip tool0 --drive
  ros2 service call /compensator/enable std_srvs/srv/SetBool "{data: true}"

docs/compensation.md describes it.
"""

from __future__ import annotations

import argparse
import importlib.util

from psd_deflection.arms.compensation.arm import read_arm
from psd_deflection.arms.compensation.compensator import CompensatorSettings
from psd_deflection.base.errors import ConfigError
from psd_deflection.cli._display import Display
from psd_deflection.cli._options import given_as_option, number

_NUMBERS = {
    'max-offset': ('largest offset of a joint, rad or m', 1e-9, 10.0),
    'max-rate': ('largest rate of an offset, rad/s or m/s', 1e-9, 10.0),
    'time-constant': ('lag of the offsets behind the deflection, s', 1e-3, 100.0),
    'damping': ('damping of the least squares, m', 1e-9, 10.0),
    'stale': ('age of a deflection from which on the offsets hold, s', 1e-3, 10.0),
    'max-sd': ('standard deviation above which a deflection is not followed, m or rad', 1e-12, 10.0),
    'jump': ('change between two deflections above which they are not followed, m or rad', 1e-9, 10.0),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    default = CompensatorSettings()
    parser.add_argument('urdf', metavar='ARM.urdf', help='kinematics of the arm')
    parser.add_argument('--tip', metavar='LINK', required=True, help='link of the end effector')
    parser.add_argument('--base', metavar='LINK', default='', help='link from which on joints count (the root)')
    parser.add_argument(
        '--axes',
        metavar='X,Y',
        default=','.join(default.axes),
        help="axes of the end effector's rigid pose that are corrected, of x,y,z,rx,ry,rz (default x,y,z)",
    )
    parser.add_argument('--drive', action='store_true', help='publish offsets for a controller (default: proposals)')
    for name, (what, least, most) in _NUMBERS.items():
        value = getattr(default, name.replace('-', '_'))
        parser.add_argument(
            f'--{name}',
            type=number(f'--{name}', least, most),
            default=value,
            metavar='VALUE',
            help=f'{what} (default {value:g})',
        )
    parser.add_argument('--ros-args', action='store_true', help='arguments after this go to ROS')


def run(args: argparse.Namespace) -> int:
    """Run until Ctrl-C; then the offsets go back to zero."""
    with given_as_option('axes'):
        settings = CompensatorSettings(
            tuple(args.axes.split(',')),
            **{name.replace('-', '_'): getattr(args, name.replace('-', '_')) for name in _NUMBERS},
        )
    arm = read_arm(args.urdf, args.tip, args.base)
    if importlib.util.find_spec('rclpy') is None:
        raise ConfigError("rclpy is not installed: source your ROS 2, or `pip install 'psd_deflection[ros]'`")
    from psd_deflection.ros.compensator import run_compensator

    return run_compensator(args.ros_arguments, arm, settings, Display().say, args.drive)
