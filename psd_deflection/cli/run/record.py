# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Start or stop a recording of a running daemon, without ROS.

The daemon must serve its page (`monitor`, `estimator --monitor`, `make run`). One that you run on this
machine is found by itself. The recording is made where the daemon runs, below its parameter bag_dir; its
folder is printed.

  psd-deflection record
  psd-deflection record stop

With ROS: ros2 service call /estimator/record std_srvs/srv/SetBool "{data: true}"
"""

import argparse

from psd_deflection.cli._daemon import request, url_option


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('what', nargs='?', choices=('start', 'stop'), default='start', help='default: start')
    url_option(parser)


def run(args: argparse.Namespace) -> int:
    """Ask for it."""
    return request(args, 'api/record', {'record': args.what == 'start'})
