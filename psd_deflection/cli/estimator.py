"""Acquire, estimate, publish on ROS 2 and record: the daemon.

Without --port it starts a simulated rig of its own and says so, so that everything can be tried
without hardware. Ctrl-C ends it and says how to replay what was recorded.

  psd-deflection estimator                                   the simulated rig
  psd-deflection estimator --port /dev/ttyACM0 --record      a device, recorded
  psd-deflection estimator --params-file my_rig.yaml --monitor --no-ros
  ros2 run psd_deflection estimator --ros-args -p port:=/dev/ttyACM0

While it runs:
  ros2 topic echo /link_tip/deflection        the tip's pose, 50 a second
  ros2 service call /estimator/zero std_srvs/srv/Trigger
  ros2 service call /estimator/record std_srvs/srv/SetBool "{data: true}"
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import math
import shlex
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from psd_deflection.cli._options import given_as_option, given_parameters, parameter_option
from psd_deflection.cli._program import program
from psd_deflection.config import Rig, read_parameter_file, rig_from_values
from psd_deflection.devices.registry import source_names
from psd_deflection.errors import ConfigError, UsageError
from psd_deflection.monitor.start import start_monitor
from psd_deflection.runner.realtime import Watchdog, settle
from psd_deflection.runner.session import SIMULATED, Session
from psd_deflection.runner.signals import Signals, StopRequestedError
from psd_deflection.runner.simulated_rig import started_early
from psd_deflection.solvers.registry import SOLVERS, check_live

REFRESH_S = 0.25
PLAIN_REFRESH_S = 5.0
PLAIN_REFRESH_LATER_S = 60.0
LOOK_S = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parameter_option(parser, '--port', 'port')
    parser.add_argument(
        '--source', help='what the device speaks: serial (our own frames), dataq, thorlabs, lines, replay'
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
    parser.add_argument('--monitor', action='store_true', help='serve the live page and print its address')
    parser.add_argument('--no-ros', action='store_true', help='acquire and record without ROS')
    parser.add_argument('--ros-args', action='store_true', help='what follows is for ROS (ros2 run, ros2 launch)')


def _live_solver(name: str) -> str:
    with given_as_option('solver'):
        check_live(name)
    return name


def overrides_of(args: argparse.Namespace) -> dict[str, object]:
    """The parameters that the arguments give; the file's values below the single ones."""
    values = given_parameters(args)
    if args.source is not None and args.source not in source_names():
        raise UsageError(f'--source {args.source}: must be one of {", ".join(source_names())}')
    with given_as_option():
        rig_from_values(values, 'command line')
    if args.params_file:
        values = {**read_parameter_file(args.params_file), **values}
        # Refuse it here, where the file's name is known.
        rig_from_values(values, args.params_file)
    return values


def simulates(overrides: Mapping[str, object], ros_arguments: Sequence[str] = ()) -> bool:
    """Whether a simulated rig will be started, as far as can be told before ROS has read its arguments."""
    told_to_ros = any(a == '--params-file' or a.startswith(('port:=', 'source:=')) for a in ros_arguments)
    return not told_to_ros and not overrides.get('port') and overrides.get('source', 'serial') in SIMULATED


class Display:
    """One live line on a terminal; lines elsewhere, soon one a minute. Its methods may be called by any thread."""

    def __init__(self) -> None:
        self._live = sys.stderr.isatty()
        self._wait = REFRESH_S if self._live else PLAIN_REFRESH_S
        self._lock = threading.Lock()
        self._last = 0.0
        self._shown = False
        self._samples = 0

    def say(self, text: str) -> None:
        """A message of its own line, above the live one."""
        with self._lock:
            self._put(text + '\n', shown=False)

    def update(self, session: Session) -> None:
        """Show where things stand, when it is time to."""
        now = time.monotonic()
        passed = now - self._last
        if passed < self._wait:
            return
        if self._last and not self._live:
            # A journal is read for what changed; each change says so itself.
            self._wait = min(2.0 * self._wait, PLAIN_REFRESH_LATER_S)
        samples = session.acquisition.counters.samples
        rate = (samples - self._samples) / passed if self._last else math.nan
        if samples < self._samples:
            # Another session, which counts from nought.
            rate = math.nan
        self._last, self._samples = now, samples
        text = live_line(session, rate)
        with self._lock:
            self._put(text + ('' if self._live else '\n'), shown=self._live)

    def _put(self, text: str, shown: bool) -> None:
        clear = '\r\x1b[K' if self._shown else ''
        self._shown = shown
        # The terminal may be gone, and whoever speaks here reads or records: that goes on unheard.
        with contextlib.suppress(OSError, ValueError):
            print(clear + text, end='', file=sys.stderr, flush=True)


def live_line(session: Session, rate: float) -> str:
    """Rate, dX, dY in um, theta in mdeg with their standard deviations, losses."""
    counters = session.acquisition.counters
    estimate, spots = session.pipeline.last_estimate, session.pipeline.last_spots
    head = f'{rate:6.0f} samples/s' if rate == rate else '     ? samples/s'
    dropped = counters.queue_dropped + session.recorder.dropped
    tail = f'lost {counters.lost + dropped}, bad frames {counters.bad}'
    if session.recorder.folder is not None:
        tail += '  ● rec'
    if rate == 0.0:
        # An old estimate beside a device that sends nothing would look like a new one.
        body = 'no samples: the device is away' if session.acquisition.away else 'no samples come'
    elif estimate is not None:
        sd = [math.sqrt(v) for v in estimate.variances]
        mdeg = 1e3 * 180.0 / math.pi
        body = (
            f'ΔX {estimate.dx * 1e6:+9.2f} ± {sd[0] * 1e6:.2f} µm  '
            f'ΔY {estimate.dy * 1e6:+9.2f} ± {sd[1] * 1e6:.2f} µm  '
            f'θ {estimate.theta * mdeg:+9.2f} ± {sd[2] * mdeg:.2f} mdeg'
        )
    else:
        body = f'no estimate: {spots.reason}' if spots is not None and spots.reason else 'no estimate yet'
    return f'{head}  {body}  {tail}'


def run(args: argparse.Namespace) -> int:
    """Run until Ctrl-C."""
    # Others are added by `ros2 launch`, and nothing is lost with them.
    if args.no_ros and any(a in ('-p', '--param', '--params-file') for a in args.ros_arguments):
        raise UsageError(
            'parameters behind --ros-args are not read with --no-ros: put them into a --params-file before it'
        )
    overrides = overrides_of(args)
    display = Display()
    recorded: list[Path] = []

    def watch(session: Session) -> None:
        folder = session.recorder.folder
        if folder is not None and folder not in recorded:
            recorded.append(folder)
        display.update(session)

    with started_early(simulates(overrides, args.ros_arguments)):
        status = _run(args, overrides, display, watch)
    for folder in (f for f in recorded if f.is_dir()):
        display.say(f'recorded {folder}\n  replay it:  {program()} replay {shlex.quote(str(folder))} --compare')
    return status


def _run(
    args: argparse.Namespace, overrides: dict[str, object], display: Display, watch: Callable[[Session], None]
) -> int:
    if args.no_ros:
        return run_without_ros(overrides, display, watch)
    if importlib.util.find_spec('rclpy') is None:
        raise ConfigError(
            "rclpy is not installed: source your ROS 2, or `pip install 'psd_deflection[ros]'`, "
            'or run with --no-ros to acquire and record without it'
        )
    from psd_deflection.ros import estimator

    return estimator.run(args.ros_arguments, overrides, display.say, watch)


def run_without_ros(overrides: dict[str, object], display: Display, watch: Callable[[Session], None]) -> int:
    """Run a session, and its live page where the parameters say so, until SIGINT or SIGTERM."""
    signals = Signals()
    try:
        return _run_until(signals, rig_from_values(overrides, 'command line'), display, watch)
    except StopRequestedError:
        return 0
    finally:
        signals.restore()


def _run_until(signals: Signals, rig: Rig, display: Display, watch: Callable[[Session], None]) -> int:
    session = signals.interruptible(lambda: Session(rig, display.say))
    watchdog = Watchdog()
    monitor = None
    try:
        settle()
        monitor = start_monitor(session, display.say)
        session.start()
        watchdog.ready()
        while not signals.stop and session.processing.alive:
            time.sleep(LOOK_S)
            if session.responsive():
                watchdog.alive()
            watch(session)
    finally:
        watchdog.stopping()
        if monitor is not None:
            monitor.close()
        session.close()
    if session.failed is not None:
        raise session.failed
    return 0
