"""Simulate the rig: as a device on a pseudo-terminal (--serve)."""

from __future__ import annotations

import argparse

from psd_deflection.cli import serve


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('--params-file', metavar='RIG.yaml', help='ROS 2 parameter file with the rig')
    parser.add_argument('--seed', type=int, default=0, help='seed of the noise')
    serve.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Serve."""
    return serve.run_device(args)
