# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Print what a running daemon measures, one line a block, without ROS. Ctrl-C ends it.

The daemon must serve its page (`monitor`, `estimator --monitor`, `make run`). One that you run on this
machine is found by itself. A block without an estimate is a line that says why. The numbers behind the
plus-minus sign are standard deviations.

  psd-deflection echo
  psd-deflection echo --count 1
  psd-deflection echo --json --count 100

With ROS: ros2 topic echo /link_tip/deflection
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys
from collections.abc import Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Any

from psd_deflection.base.axes import MDEG
from psd_deflection.base.errors import DaemonError
from psd_deflection.cli._daemon import daemon_of, url_option
from psd_deflection.cli._report import print_json, show
from psd_deflection.cli._values import integer
from psd_deflection.run.monitor.served import need_server

if TYPE_CHECKING:
    from psd_deflection.run.monitor.client import Daemon

SHOWN = (('dx', 'ΔX', 1e6, 'µm'), ('dy', 'ΔY', 1e6, 'µm'), ('theta', 'θ', MDEG, 'mdeg'))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('--count', type=integer('--count', 1), metavar='N', help='end after N blocks')
    parser.add_argument(
        '--json',
        action='store_true',
        help='for programs: one JSON object a line, in s, m, rad and V, null without an estimate',
    )
    url_option(parser)


def run(args: argparse.Namespace) -> int:
    """Print until Ctrl-C, or ``--count`` lines."""
    need_server()
    daemon = daemon_of(args)
    with contextlib.ExitStack() as stack:
        if args.count is None:
            stack.enter_context(contextlib.suppress(KeyboardInterrupt))
        asyncio.run(_echo(daemon, args.count, args.json))
    return 0


async def _echo(daemon: Daemon, count: int | None, as_json: bool) -> None:
    from psd_deflection.run.monitor.client import messages

    reported = messages(daemon)
    try:
        hello = (await anext(reported)).get('hello')
        remaining = count
        async for message in reported:
            for values in message.get('rows', ()):
                try:
                    row = dict(zip(hello['columns'], values, strict=True))  # type: ignore[index]
                    row['status'] = hello['statuses'][row['status']]  # type: ignore[index]
                    line = line_of(row)
                except (TypeError, KeyError, IndexError, ValueError):
                    raise DaemonError(f'{daemon.url}: no page of this version of the program is there') from None
                if as_json:
                    print_json(row)
                else:
                    show(line)
                # Whoever reads this through a pipe waits for it.
                sys.stdout.flush()
                remaining = None if remaining is None else remaining - 1
                if remaining == 0:
                    return
    finally:
        await reported.aclose()


def line_of(row: Mapping[str, Any]) -> str:
    """One block for a person: time, pose in µm and mdeg with standard deviations, or why there is none."""
    t = row['t']
    # Times of a CSV may count from its own zero.
    clock = f'{t:12.3f} s' if t < 1e9 else datetime.fromtimestamp(t).strftime('%H:%M:%S.%f')[:-3]
    lost = f'  lost {row["lost"]}' if row['lost'] else ''
    if row['dx'] is None:
        return f'{clock}  no estimate: {row["status"]}{lost}'
    pose = '  '.join(
        f'{label} {row[name] * scale:+9.2f} ± {row[f"sd_{name}"] * scale:.2f} {unit}'
        for name, label, scale, unit in SHOWN
    )
    return f'{clock}  {pose}{lost}'
