# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The option ``--url`` of the commands that speak to a running daemon, and their requests."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING

from psd_deflection.base.errors import DaemonError
from psd_deflection.cli._report import show
from psd_deflection.cli._values import given_as_option

if TYPE_CHECKING:
    from psd_deflection.run.monitor.client import Daemon


def url_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--url``."""
    parser.add_argument(
        '--url',
        metavar='URL',
        help="address of the daemon's page, as it was printed (default: the one that you run on this machine, "
        'else http://127.0.0.1:8790/)',
    )


def request(args: argparse.Namespace, path: str, body: Mapping[str, object], *, timed: bool = False) -> int:
    """Ask the daemon of ``args`` for something, and print its answer. Raises DaemonError.

    ``timed``: it is of the time at which the command was started.
    """
    from psd_deflection.run.monitor.client import ask

    show(ask(daemon_of(args), path, body, timed=timed))
    return 0


def daemon_of(args: argparse.Namespace) -> Daemon:
    """The daemon that ``--url`` names, else the one of this user. Raises DaemonError, UsageError."""
    from psd_deflection.run.monitor.client import find_daemon

    with given_as_option('url'):
        try:
            return find_daemon(args.url)
        except DaemonError as error:
            raise DaemonError(f'{error} as --url') from None
