# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Several links in series, each with its own rig: the deflection of the end effector, in one process.

CHAIN.yaml names each link with its rig file, port, mount and joint (docs/chains.md). A link without a port is a
simulated rig. The end effector is composed at each block of the first link, and published as
/end_effector/deflection; each link's topics are below its name: /upper/link_tip/deflection. If a link has no estimate,
the end effector has none.

  psd-deflection chain config/two_links.yaml --no-ros
  psd-deflection chain config/two_links.yaml --no-ros --json --count 3
  psd-deflection chain config/two_links.yaml --no-ros --out end.csv --record
  ros2 run psd_deflection chain my_arm.yaml
  ros2 run psd_deflection chain --ros-args -p chain:=my_arm.yaml -p record:=true
"""

import argparse
import contextlib
import queue
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from psd_deflection.arms.chains.chain import SLOPES
from psd_deflection.arms.chains.chain_file import NO_CHAIN, read_chain
from psd_deflection.base.axes import SHOWN, SHOWN_UNITS
from psd_deflection.base.errors import ConfigError, RecordingError, UsageError
from psd_deflection.base.files import creating
from psd_deflection.cli._display import Display
from psd_deflection.cli._options import need_folder, require_ros
from psd_deflection.cli._report import print_json
from psd_deflection.cli._values import integer
from psd_deflection.rig.parameters import Value
from psd_deflection.run.chain import ChainSession, Composed
from psd_deflection.run.headless import run_until_signal

AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')
COLUMNS = ('t', *AXES, *(f'sd_{axis}' for axis in AXES), 'missing')
"""Of the CSV: s; m and rad; why a line has no numbers."""

_ALONG, _ABOUT = (SHOWN[0], SHOWN_UNITS[0]), (SHOWN[2], SHOWN_UNITS[2])
_SHOWN = tuple((axis, *shown) for axis, shown in zip(AXES, 3 * [_ALONG] + 3 * [_ABOUT], strict=True))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'chain', metavar='CHAIN.yaml', nargs='?', default='', help='the links (with ROS also the parameter chain)'
    )
    parser.add_argument(
        '--record',
        nargs='?',
        const='',
        metavar='FOLDER',
        help='record each link from the start, below FOLDER/LINK (recordings/)',
    )
    parser.add_argument('--slopes', choices=SLOPES, help='where the tilts of the tips come from (docs/chains.md)')
    parser.add_argument('--out', metavar='X.csv', help="write the end effector's deflection; needs --no-ros")
    parser.add_argument('--json', action='store_true', help='print one JSON object a block; needs --no-ros')
    parser.add_argument('--count', type=integer('--count', 1), metavar='N', help='end after N blocks; needs --no-ros')
    parser.add_argument('--no-ros', action='store_true', help='acquire, compose and record without ROS')
    parser.add_argument('--ros-args', action='store_true', help='arguments after this go to ROS')


def run(args: argparse.Namespace) -> int:
    """Run until Ctrl-C, or for ``--count`` blocks."""
    if not args.no_ros and (args.out or args.json or args.count):
        raise UsageError('--out, --json and --count need --no-ros')
    given: dict[str, Value] = {}
    if args.record is not None:
        given = {'record': True, **({'bag_dir': args.record} if args.record else {})}
    display = Display()
    if args.no_ros or not args.ros_arguments:
        # Before ROS is started; else ROS may have parameters that change it.
        if not args.chain:
            raise ConfigError(NO_CHAIN)
        file = read_chain(args.chain, given, args.slopes)
    if args.no_ros:
        with display.report_recorded(), _written(args.out) as stream:
            teller = _Teller(args, display, stream)
            return run_until_signal(lambda: ChainSession(file, display.log), teller.watch, teller.listen)
    require_ros(', or run with --no-ros')
    from psd_deflection.ros.chain import run_chain

    with display.report_recorded():
        teller = _Teller(args, display, None)
        return run_chain(args.ros_arguments, args.chain, given, args.slopes, display.log, teller.watch)


@contextlib.contextmanager
def _written(out: str | None) -> Iterator[TextIO | None]:
    """The CSV to write, with its head; None if none is wanted."""
    if out is None:
        yield None
        return
    path = Path(out)
    if path.suffix.lower() != '.csv':
        raise UsageError(f'--out {out}: the name must end in .csv')
    need_folder(path)
    with creating(out):
        stream = path.open('x', encoding='utf-8')
    try:
        with stream:
            stream.write(','.join(COLUMNS) + '\n')
            yield stream
    except OSError as error:
        raise RecordingError(f'--out {out}: cannot be written ({error.strerror or error})') from None


class _Teller:
    """Shows, prints and writes what is composed, in the main thread."""

    def __init__(self, args: argparse.Namespace, display: Display, stream: TextIO | None) -> None:
        self._display, self._stream, self._json = display, stream, args.json
        self._remaining: int | None = args.count
        self._queue: queue.SimpleQueue[Composed] = queue.SimpleQueue()

    def listen(self, chain: ChainSession) -> None:
        """Hear of every composed deflection."""
        if self._json or self._stream is not None or self._remaining is not None:
            chain.listeners.append(self._queue.put)

    def watch(self, chain: ChainSession) -> bool:
        """What came since the last time; True if it was enough."""
        for session in chain.sessions:
            self._display.note_recorded(session)
        while self._remaining != 0:
            try:
                composed = self._queue.get_nowait()
            except queue.Empty:
                break
            self._remaining = None if self._remaining is None else self._remaining - 1
            if self._stream is not None:
                self._stream.write(csv_line(composed) + '\n')
            if self._json:
                print_json(as_json(composed))
        if self._json:
            # Whoever reads this through a pipe waits for it.
            sys.stdout.flush()
        else:
            self._display.show(chain.composed, lambda rate: live_line(chain, rate))
        return self._remaining == 0


def csv_line(composed: Composed) -> str:
    """One line of the CSV; nine decimals of a second, and every digit of the rest."""
    end = composed.end
    numbers = [''] * 12 if end is None else [repr(float(v)) for v in (*end.vector, *end.deviations)]
    seconds, rest = divmod(composed.t_ns, 1_000_000_000)
    return ','.join([f'{seconds}.{rest:09d}', *numbers, '"' + composed.why.replace('"', "'") + '"'])


def as_json(composed: Composed) -> dict[str, object]:
    """One block for programs: s, m and rad."""
    end = composed.end
    if end is None:
        return {'t': composed.t_ns / 1e9, 'deflection': None, 'missing': composed.why}
    return {
        't': composed.t_ns / 1e9,
        'deflection': dict(zip(AXES, end.vector.tolist(), strict=True)),
        'covariance': end.covariance.tolist(),
        'pose': {'position': end.deflected.position.tolist(), 'quaternion': end.deflected.quaternion.tolist()},
    }


def live_line(chain: ChainSession, rate: float) -> str:
    """Rate, deflection in um and mdeg with its standard deviations, or which link is missing; how often one was."""
    head = f'{rate:4.0f} composed/s' if rate == rate else '   ? composed/s'
    last, silent = chain.last, chain.silent()
    if silent or last is None or last.end is None:
        body = f'no end effector: {silent or (last.why if last is not None else "not yet")}'
    else:
        values = zip(_SHOWN, last.end.vector, last.end.deviations, strict=True)
        body = '  '.join(f'{name} {v * scale:+.1f} ± {sd * scale:.1f} {unit}' for (name, scale, unit), v, sd in values)
    missing = ', '.join(f'{name} missing {count}' for name, count in chain.missing.items() if count)
    lost = sum(session.acquisition.counters.lost for session in chain.sessions)
    return f'{head}  {body}  lost {lost}{", " if missing else ""}{missing}'
