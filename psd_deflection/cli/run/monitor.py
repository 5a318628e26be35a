# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Serve a web page: both detectors, deflection and twist, spectrum, rates, losses, clock and health.

Without REC it acquires, without ROS, from --port or from a simulated rig of its own, which hangs the loads
that are noted; with --demo weights hang on it in turn. With REC (a bag folder, an .mcap or a .csv) it plays that
recording. Only this machine can open the page, unless
--monitor-address is given. Its buttons (zero, record, load, mark) work for users of this machine. If the network can
reach the page, they are off; with --control they work for those who have the printed address with its
token. Ctrl-C ends it.

  psd-deflection monitor                          the simulated rig, at rest
  psd-deflection monitor --demo                   the same with weights in turn
  psd-deflection monitor --port /dev/ttyACM0      a device
  psd-deflection monitor recordings/psd_20260101_120000 --speed 2 --loop

The node serves the same page: estimator --monitor, or the parameter monitor:=true.
"""

import argparse
import math
import signal
import threading
from collections.abc import Iterator

from psd_deflection.base.errors import UsageError
from psd_deflection.base.log import INFO
from psd_deflection.base.text import plain_number
from psd_deflection.cli._display import Display
from psd_deflection.cli._options import (
    DEMO,
    foxglove_option,
    given_parameters,
    namespace_option,
    over_file,
    parameter_option,
    reject,
    reject_demo,
    span_options,
)
from psd_deflection.cli._report import warn
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import open_for_replay, part_of, replayed, warnings_about_rig
from psd_deflection.recordings.spans import FULL
from psd_deflection.records import Record
from psd_deflection.rig.config import replace_values
from psd_deflection.rig.declarations import MONITOR
from psd_deflection.run.headless import run_headless
from psd_deflection.run.monitor.feed import Feed
from psd_deflection.run.monitor.served import need_server
from psd_deflection.run.monitor.shown_recording import ShownRecording
from psd_deflection.run.monitor.start import foxglove, start_views
from psd_deflection.run.simulated_rig import simulates, started_early


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.set_defaults(monitor=True)
    parser.add_argument('recording', nargs='?', metavar='REC', help='a bag folder, an .mcap or a .csv to play')
    parser.add_argument('--params-file', metavar='RIG.yaml', help='ROS 2 parameter file with the rig')
    page = parser.add_argument_group('the page')
    parameter_option(page, '--monitor-port', 'monitor_port', '--http-port')
    parameter_option(page, '--monitor-address', 'monitor_address', '--address')
    control = page.add_mutually_exclusive_group()
    control.add_argument(
        '--control',
        dest='monitor_control',
        action='store_const',
        const='on',
        help='let the buttons work although the network can reach the page, with the printed token',
    )
    control.add_argument(
        '--no-control', dest='monitor_control', action='store_const', const='off', help='switch the buttons off'
    )
    foxglove_option(page)
    live = parser.add_argument_group('the rig (without REC)')
    parameter_option(live, '--port', 'port')
    parameter_option(live, '--baud', 'baud')
    live.add_argument('--demo', action='store_true', help=DEMO)
    live.add_argument(
        '--record', nargs='?', const='', metavar='FOLDER', help='record from the start, below FOLDER (recordings/)'
    )
    play = parser.add_argument_group('a recording (with REC)')
    namespace_option(play)
    span_options(play)
    play.add_argument(
        '--speed', type=plain_number, default=1, metavar='X', help='times as fast as recorded (default 1)'
    )
    play.add_argument('--loop', action='store_true', help='start again at the end')


def _check(args: argparse.Namespace) -> None:
    if not math.isfinite(args.speed) or args.speed <= 0.0:
        raise UsageError(f'--speed {args.speed:g}: must be above 0')
    reject_demo(args)
    if args.recording is None:
        if args.span != FULL:
            raise UsageError('--from and --to are for a recording: give REC')
        reject(args, {'speed': 1.0, 'loop': False, 'namespace': None}, 'is for a recording: give REC')
    for name in ('port', 'baud', 'record', 'demo'):
        if args.recording is not None and getattr(args, name) not in (None, False):
            raise UsageError(f'--{name} is for a rig; {args.recording} is played')


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    _check(args)
    overrides = given_parameters(args)
    need_server()
    if args.recording is not None:
        return _play(args, overrides)
    values = over_file(args.params_file, overrides)
    display = Display()
    with display.report_recorded(), started_early(simulates(values)):
        return run_headless(values, display.log, display.watch, start_views)


def _play(args: argparse.Namespace, overrides: dict[str, object]) -> int:
    from psd_deflection.run.monitor.server import MonitorServer

    opened, rig = open_for_replay(args.recording, args.params_file, args.namespace)
    part = part_of(opened, args.span)
    shown_part = opened if part is None else part
    if args.params_file is None:
        # Where the page was served when it was recorded says nothing of today.
        rig = replace_values(rig, {p.name: p.default for p in MONITOR.parameters.values()})
    rig = replace_values(rig, overrides, 'command line')
    for warning in warnings_about_rig(opened, args.params_file):
        warn(warning)

    def open_steps() -> tuple[Pipeline, Iterator[list[Record]]]:
        recording = open_recording(args.recording, block_size=rig.estimator.block_size, namespace=args.namespace)
        pipeline = Pipeline(rig)
        return pipeline, replayed(recording, pipeline, part=part)

    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    display = Display()
    beside = foxglove().FoxgloveServer(rig, display.log) if rig.monitor.foxglove else None
    feed = Feed() if beside is None else foxglove().FeedBeside(beside, rig)
    server: MonitorServer | None = None

    def log(text: str, level: int = INFO, /) -> None:
        display.log(text, level)
        if server is not None:
            server.notify(text, level)

    def find_span() -> tuple[int, int]:
        first = last = None
        for block in shown_part.blocks():
            first, last = first or block, block
        return (int(first.t_ns[0]), int(last.t_ns[-1])) if first is not None and last is not None else (0, 0)

    shown = ShownRecording(
        str(args.recording),
        open_steps,
        feed,
        log,
        speed=args.speed,
        loop=args.loop,
        inputs=[*shown_part.loads(), *shown_part.references(), *shown_part.marks()],
        find_span=find_span,
    )
    server = MonitorServer(shown, feed, rig.monitor, display.log)
    server.start()
    if beside is not None:
        display.log(beside.words())
    try:
        shown.start()
        while not stop.wait(0.1) and shown.failed is None:
            pass
    finally:
        shown.close()
        server.close()
        if beside is not None:
            beside.close()
    if shown.failed is not None:
        raise shown.failed
    return 0
