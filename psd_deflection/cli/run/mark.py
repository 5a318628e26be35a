# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mark this moment: "bumped it here". The running daemon records it as a message on /link_tip/mark.

The time is that at which the command was started. `info` lists the marks of a recording, plots show
them, and they bound a part of it (--from 'mark:bumped the table'). The daemon must serve its page
(`monitor`, `estimator --monitor`, `make run`); one that you run on this machine is found by itself.

  psd-deflection mark bumped the table

With ROS: ros2 topic pub --once /link_tip/mark std_msgs/msg/String "{data: bumped the table}"
"""

import argparse

from psd_deflection.cli._daemon import request, url_option


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    words = 'what happened, in at most 200 characters'
    parser.add_argument('text', metavar='TEXT', nargs='+', help=words)
    url_option(parser)


def run(args: argparse.Namespace) -> int:
    """Tell the daemon."""
    return request(args, 'api/mark', {'text': ' '.join(args.text)}, timed=True)
