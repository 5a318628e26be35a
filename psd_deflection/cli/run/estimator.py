# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Acquire, estimate, publish on ROS 2 and record: the daemon.

Without --port it starts a simulated rig, so that you can try everything without hardware. It is at rest
and hangs the loads that are noted (`psd-deflection load`, the page, /link_tip/load); with --demo weights hang on
it in turn. Ctrl-C ends it; if it recorded, it prints the command that replays the recording.

  psd-deflection estimator --demo                            the simulated rig
  psd-deflection estimator --port /dev/ttyACM0 --record      a device, recorded
  psd-deflection estimator --params-file my_rig.yaml --monitor --no-ros
  ros2 run psd_deflection estimator --ros-args -p port:=/dev/ttyACM0

While it runs:
  ros2 topic echo /link_tip/deflection        the tip's pose, 50 a second
  ros2 service call /estimator/zero std_srvs/srv/Trigger
  ros2 service call /estimator/record std_srvs/srv/SetBool "{data: true}"
"""

import argparse
from collections.abc import Mapping, Sequence

from psd_deflection.base.errors import UsageError
from psd_deflection.cli._display import Display
from psd_deflection.cli._options import (
    DEMO,
    foxglove_option,
    given_parameters,
    over_file,
    parameter_option,
    reject_demo,
    require_ros,
)
from psd_deflection.cli._values import given_as_option
from psd_deflection.devices.registry import DEVICES, source_names
from psd_deflection.model.solvers.registry import SOLVERS, check_live
from psd_deflection.run.headless import run_headless
from psd_deflection.run.monitor.start import start_views
from psd_deflection.run.simulated_rig import simulates, started_early


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parameter_option(parser, '--port', 'port')
    parser.add_argument(
        '--source',
        help=f'protocol of the device: {", ".join(DEVICES)}, or the name of a plug-in '
        '(`psd-deflection devices --help` describes them)',
    )
    parameter_option(parser, '--baud', 'baud')
    parser.add_argument('--params-file', metavar='RIG.yaml', help='ROS 2 parameter file with the rig')
    parser.add_argument(
        '--record', nargs='?', const='', metavar='FOLDER', help='record from the start, below FOLDER (recordings/)'
    )
    parser.add_argument(
        '--solver',
        type=_live_solver,
        choices=[name for name, entry in SOLVERS.items() if not entry.instead],
        metavar='NAME',
        help='solver whose answer is published as /link_tip/deflection (default exact)',
    )
    parser.add_argument('--demo', action='store_true', help=DEMO)
    parser.add_argument('--monitor', action='store_true', help='serve the live page and print its address')
    parameter_option(parser, '--monitor-port', 'monitor_port')
    parameter_option(parser, '--monitor-address', 'monitor_address')
    foxglove_option(parser)
    parser.add_argument('--no-ros', action='store_true', help='acquire and record without ROS')
    parser.add_argument(
        '--ros-args', action='store_true', help='arguments after this go to ROS (ros2 run, ros2 launch)'
    )


def _live_solver(name: str) -> str:
    with given_as_option('solver'):
        check_live(name)
    return name


def simulates_at_once(overrides: Mapping[str, object], ros_arguments: Sequence[str] = ()) -> bool:
    """Whether a simulated rig will probably be started; ROS has not read its arguments yet."""
    reported_to_ros = any(a == '--params-file' or a.startswith(('port:=', 'source:=')) for a in ros_arguments)
    return not reported_to_ros and simulates(overrides)


def run(args: argparse.Namespace) -> int:
    """Run until Ctrl-C."""
    reject_demo(args)
    # `ros2 launch` adds others; they can be ignored.
    if args.no_ros and any(a in ('-p', '--param', '--params-file') for a in args.ros_arguments):
        raise UsageError(
            'parameters behind --ros-args are not read with --no-ros: put them into a --params-file before it'
        )
    if args.source is not None and args.source not in source_names():
        raise UsageError(f'--source {args.source}: must be one of {", ".join(source_names())}')
    overrides = over_file(args.params_file, given_parameters(args))
    display = Display()
    with display.report_recorded(), started_early(simulates_at_once(overrides, args.ros_arguments)):
        return _run(args, overrides, display)


def _run(args: argparse.Namespace, overrides: dict[str, object], display: Display) -> int:
    if args.no_ros:
        return run_headless(overrides, display.log, display.watch, start_views)
    require_ros(', or run with --no-ros to acquire and record without it')
    from psd_deflection.ros import estimator

    return estimator.run(args.ros_arguments, overrides, display.log, display.watch)
