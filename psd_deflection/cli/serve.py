"""``simulate --serve``: the simulated rig as a device on a pseudo-terminal, in real time."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import threading

from psd_deflection.config import Rig, load_rig, rig_from_values
from psd_deflection.errors import ConfigError
from psd_deflection.io.simulated_device import PseudoTerminal, SimulatedDevice, serve
from psd_deflection.runner.simulated_rig import PORT_LINE
from psd_deflection.simulation.loads import CyclicLoads, thesis_load_cases


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what --serve takes besides the rig."""
    group = parser.add_argument_group('as a device (--serve)')
    group.add_argument(
        '--serve', action='store_true', help='be a device on a pseudo-terminal, in real time, and print its port'
    )
    group.add_argument('--link', metavar='PATH', help='a symbolic link to the port, for a name that stays')
    group.add_argument('--skew-ppm', type=float, default=0.0, help="how much too fast the device's clock runs")
    group.add_argument('--first-seq', type=int, default=0, help='sample number at power-up')
    # How the daemon starts one: the parameters come as a line of JSON, the end of the input ends it.
    group.add_argument('--attached', action='store_true', help=argparse.SUPPRESS)


def run_device(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C, or until the daemon that started it is gone."""
    stop = threading.Event()
    rig = _attached_rig(stop) if args.attached else load_rig(args.params_file)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    loads = CyclicLoads(thesis_load_cases(rate=rig.converter.sample_rate_hz))
    device = SimulatedDevice(
        rig, lambda _, n: loads.take(n), seed=args.seed, skew_ppm=args.skew_ppm, first_seq=args.first_seq
    )
    port = PseudoTerminal(args.link)
    try:
        print(f'{PORT_LINE}{port.name}', flush=True)
        if not args.attached:
            print(
                f'a simulated rig answers there; try:  psd-deflection estimator --port {port.name}\nCtrl-C ends it',
                file=sys.stderr,
            )
        serve(device, port, stop.is_set)
    finally:
        port.close()
    return 0


def _attached_rig(stop: threading.Event) -> Rig:
    line = sys.stdin.buffer.readline()
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
