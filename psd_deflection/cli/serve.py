"""``simulate --serve``: the simulated rig as a device on a pseudo-terminal, in real time."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Sequence

from psd_deflection.cli._options import given_as_option, number, whole
from psd_deflection.cli._program import program
from psd_deflection.config import Rig, load_rig, rig_from_values
from psd_deflection.devices.simulated_dataq import SimulatedDataq
from psd_deflection.devices.simulated_device import LineDevice, PseudoTerminal, SimulatedDevice, serve
from psd_deflection.devices.simulated_lines import SimulatedLines
from psd_deflection.devices.simulated_thorlabs import SharedRig, SimulatedAligner
from psd_deflection.errors import ConfigError
from psd_deflection.records import FloatArray
from psd_deflection.runner.session import SIMULATED
from psd_deflection.runner.simulated_rig import PORT_LINE
from psd_deflection.simulation.loads import CyclicLoads, thesis_load_cases

DEVICES = SIMULATED
"""What can be simulated, named as the sources that read it."""

OF_A_DEVICE = {'device': None, 'link': None, 'skew_ppm': 0.0, 'first_seq': 0}
"""Options of a device, and what they are where they are not given."""

MAX_SKEW_PPM = 100_000.0

DWELL_S = 4.0
FIRST_LOAD_S = 1.0
"""Unloaded after power-up, s: long enough for a zero, short enough that whoever looks on sees it move at once."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what --serve takes besides the rig."""
    group = parser.add_argument_group('as a device (--serve)')
    group.add_argument(
        '--serve', action='store_true', help='be a device on a pseudo-terminal, in real time, and print its port'
    )
    group.add_argument(
        '--device',
        choices=DEVICES,
        help='what it speaks: our own frames (serial), a DATAQ converter, a pair of Thorlabs aligners (two ports), '
        'lines of text; default: what source: of the rig says',
    )
    group.add_argument('--link', metavar='PATH', help='a symbolic link to the port, for a name that stays')
    group.add_argument(
        '--skew-ppm',
        type=number('--skew-ppm', -MAX_SKEW_PPM, MAX_SKEW_PPM),
        metavar='PPM',
        default=0.0,
        help="how much too fast the device's clock runs, 1e-6 (default 0)",
    )
    group.add_argument(
        '--first-seq',
        type=whole('--first-seq', 0, 2**32 - 1),
        metavar='N',
        default=0,
        help='sample number at power-up (default 0)',
    )
    # How the daemon starts one: the parameters come as a line of JSON, the end of the input ends it.
    group.add_argument('--attached', action='store_true', help=argparse.SUPPRESS)


def run_device(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C, or until the daemon that started it is gone."""
    stop = threading.Event()
    rig = _attached_rig(stop) if args.attached else load_rig(args.params_file)
    for one in (signal.SIGINT, signal.SIGTERM):
        signal.signal(one, lambda *_: stop.set())
    loads = served_loads(rig.converter.sample_rate_hz)
    name = args.device or rig.acquisition.source
    if name not in DEVICES:
        raise ConfigError(f'source = {name!r}: cannot be simulated; --device takes one of {", ".join(DEVICES)}')
    devices = make_devices(name, rig, lambda _, n: loads.take(n), args)
    links = [args.link] if len(devices) == 1 or args.link is None else [f'{args.link}_{i}' for i in (1, 2)]
    with given_as_option():
        ports = [PseudoTerminal(link) for link in (links if args.link else [None] * len(devices))]
    names = ','.join(port.name for port in ports)
    try:
        print(f'{PORT_LINE}{names}', flush=True)
        if not args.attached:
            source = '' if name == 'serial' else f' --source {name}'
            reached = shlex.quote(','.join(map(str, links))) if args.link else names
            print(
                f'a simulated rig answers there; try:  {program()} estimator --port {reached}{source}\nCtrl-C ends it',
                file=sys.stderr,
            )
        serve_all(devices, ports, stop.is_set)
    finally:
        for port in ports:
            port.close()
    return 0


def served_loads(rate: float) -> CyclicLoads:
    """The thesis's load cases over and over, of which the first, unloaded, has almost gone by at power-up."""
    return CyclicLoads(thesis_load_cases(DWELL_S, rate), start=round((DWELL_S - FIRST_LOAD_S) * rate))


def make_devices(
    name: str, rig: Rig, loads: Callable[[int, int], FloatArray], args: argparse.Namespace
) -> list[LineDevice]:
    """The device, or the two of a pair."""
    options = {'seed': args.seed, 'skew_ppm': args.skew_ppm}
    if name == 'dataq':
        return [SimulatedDataq(rig, loads, **options)]
    if name == 'lines':
        return [SimulatedLines(rig, loads, first_seq=args.first_seq, **options)]
    if name == 'thorlabs':
        shared = SharedRig(rig, loads, args.seed)
        return [SimulatedAligner(shared, psd) for psd in (1, 2)]
    return [SimulatedDevice(rig, loads, first_seq=args.first_seq, **options)]


def serve_all(devices: Sequence[LineDevice], ports: Sequence[PseudoTerminal], stopped: Callable[[], bool]) -> None:
    """Serve each on its port until ``stopped()``, the first in this thread."""
    others = [
        threading.Thread(target=serve, args=(device, port, stopped), name=port.name, daemon=True)
        for device, port in zip(devices[1:], ports[1:], strict=True)
    ]
    for thread in others:
        thread.start()
    serve(devices[0], ports[0], stopped)
    for thread in others:
        thread.join()


def _attached_rig(stop: threading.Event) -> Rig:
    line = sys.stdin.buffer.readline()
    if not line:
        # The daemon that started us early has gone before it came to us.
        raise SystemExit(0)
    try:
        values = json.loads(line)
    except ValueError:
        raise ConfigError('--attached: expected the parameters as a line of JSON') from None

    def until_the_end() -> None:
        with contextlib.suppress(OSError, ValueError):
            while os.read(sys.stdin.fileno(), 4096):
                pass
        stop.set()

    threading.Thread(target=until_the_end, name='parent', daemon=True).start()
    return rig_from_values(values, 'parameters of the daemon')
