"""Make a running daemon take the present dots as the unloaded ones, without ROS.

The daemon must serve its page (`monitor`, `estimator --monitor`, `make run`). One that you run on this
machine is found by itself. It refuses if no good block came lately.

  psd-deflection zero
  psd-deflection zero --url http://rig:8790/#token=...

With ROS: ros2 service call /estimator/zero std_srvs/srv/Trigger
"""

from __future__ import annotations

import argparse

from psd_deflection.cli._daemon import request, url_option


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    url_option(parser)


def run(args: argparse.Namespace) -> int:
    """Ask for it."""
    return request(args, 'api/zero', {})
