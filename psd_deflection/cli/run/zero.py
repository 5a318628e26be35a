# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Make a running daemon take the present dots as the unloaded ones, without ROS.

The daemon must serve its page (`monitor`, `estimator --monitor`, `make run`). One that you run on this
machine is found by itself. It rejects if no good block came lately. While the link moves no zero is taken;
the command waits until it rests, 10 s at most.

  psd-deflection zero
  psd-deflection zero --wait 0
  psd-deflection zero --url http://rig:8790/#token=...

With ROS: ros2 service call /estimator/zero std_srvs/srv/Trigger
"""

import argparse
import time

from psd_deflection.base.errors import DaemonError
from psd_deflection.cli._daemon import request, url_option
from psd_deflection.cli._values import number

ASK_AGAIN_S = 0.25
MOVES = 'the link moves'
"""In a rejection that is over when the link rests."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        '--wait',
        type=number('--wait', 0.0, 3600.0),
        default=10.0,
        metavar='S',
        help='wait so long for a link that moves, s (default 10; 0: not at all)',
    )
    url_option(parser)


def run(args: argparse.Namespace) -> int:
    """Ask for it, again while the link moves."""
    end = time.monotonic() + args.wait
    timed = True
    while True:
        try:
            return request(args, 'api/zero', {}, timed=timed)
        except DaemonError as error:
            if MOVES not in str(error) or time.monotonic() >= end:
                raise
        timed = False
        time.sleep(ASK_AGAIN_S)
