# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Note a known load that acts on the tip from now on: forces FX, FY in N and the torque TZ in N m.

The running daemon writes it into its recording as a message on /link_tip/load, where `discover` reads it.
It holds from the start of this command until the next one; a recording that begins later starts with it.
The load acts at the tip's centroid, in the axes of link_tip_rest. The daemon must serve its page
(`monitor`, `estimator --monitor`, `make run`); one that you run on this machine is found by itself.

  psd-deflection load 0 -10 0           10 N downwards, if Y points up
  psd-deflection load --add 0 -10 0     10 N more than before
  psd-deflection load 0 0 0             nothing hangs there any more
  psd-deflection load 0 -10 0 --ago 3.4   it has hung for 3.4 s already
  psd-deflection load 0 -10 0 --ago step  it hangs since the link moved last

With ROS: ros2 topic pub --once /link_tip/load geometry_msgs/msg/WrenchStamped
          "{header: auto, wrench: {force: {y: -10.0}}}"
"""

import argparse

from psd_deflection.cli._daemon import request, url_option
from psd_deflection.cli._values import need_finite, number, plain
from psd_deflection.run.monitor.served import MAX_AGO_S, SINCE_STEP


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    for name, unit in (('FX', 'N'), ('FY', 'N'), ('TZ', 'N m')):
        parser.add_argument(name.lower(), metavar=name, type=plain(name), help=unit)
    parser.add_argument('--add', action='store_true', help='this load acts beside the one that was noted last')
    parser.add_argument(
        '--ago',
        metavar='SECONDS',
        type=_ago,
        default=0.0,
        help=f'for how long it has hung already, or {SINCE_STEP}: since the last step of the dots',
    )
    url_option(parser)


def _ago(text: str) -> float | str:
    return text if text == SINCE_STEP else number('--ago', 0.0, MAX_AGO_S)(text)


def run(args: argparse.Namespace) -> int:
    """Tell the daemon."""
    need_finite('FX FY TZ:', (args.fx, args.fy, args.tz))
    body = {'fx': args.fx, 'fy': args.fy, 'tz': args.tz, 'add': args.add, 'ago': args.ago}
    return request(args, 'api/load', body, timed=True)
