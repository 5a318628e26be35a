# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``simulate --serve``: the simulated rig as a device on a pseudo-terminal or on the network, in real time."""

from __future__ import annotations

import argparse
import contextlib
import shlex
import sys
from collections.abc import Sequence

from psd_deflection.cli._options import in_the_world, reject
from psd_deflection.cli._program import program
from psd_deflection.cli._values import given_as_option, integer, number
from psd_deflection.devices.device import PowerUp
from psd_deflection.devices.pseudo_terminal import PORT_LINE, link_names, open_terminals
from psd_deflection.devices.registry import SIMULATED
from psd_deflection.devices.serve import Hand, HostSide, serve_all, simulated_devices, stopped_by_signals
from psd_deflection.devices.served_sockets import open_sockets
from psd_deflection.model.simulation.load_words import load_histories
from psd_deflection.model.simulation.loads import CyclicLoads
from psd_deflection.rig.config import load_rig

OF_A_DEVICE = {'device': None, 'link': None, 'skew_ppm': 0.0, 'first_seq': 0}
"""Options of a device, and what they are if they are not given."""

MAX_SKEW_PPM = 100_000.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what --serve takes besides the rig."""
    group = parser.add_argument_group('as a device (--serve)')
    group.add_argument(
        '--serve',
        nargs='?',
        const='',
        metavar='WHERE',
        help='act as a device in real time and print its port: on a pseudo-terminal, at socket://HOST:PORT (TCP; port '
        '0: any), or by datagrams to udp://HOST:PORT',
    )
    group.add_argument(
        '--device',
        choices=SIMULATED,
        metavar='NAME',
        help='kind of device: %(choices)s (default: the parameter source of the rig)',
    )
    group.add_argument(
        '--link', metavar='PATH', help='make a symbolic link to the port, so that its name stays the same'
    )
    group.add_argument(
        '--skew-ppm',
        type=number('--skew-ppm', -MAX_SKEW_PPM, MAX_SKEW_PPM),
        metavar='PPM',
        default=0.0,
        help="how much too fast the device's clock runs, 1e-6 (default 0)",
    )
    group.add_argument(
        '--first-seq',
        type=integer('--first-seq', 0, 2**32 - 1),
        metavar='N',
        default=0,
        help='sample number at power-up (default 0)',
    )


def run_device(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    rig = in_the_world(load_rig(args.params_file), args.world)
    stop = stopped_by_signals()
    name = args.device or rig.acquisition.source
    hand = None
    if args.loads:
        with given_as_option():
            hand = Hand(CyclicLoads(load_histories(args.loads, rig.converter.sample_rate_hz, '--loads')))
    devices = simulated_devices(name, rig, args.seed, PowerUp(args.skew_ppm, args.first_seq), hand)
    if args.serve:
        reject(args, {'link': None}, 'is for a pseudo-terminal: give --serve alone')
    links = link_names(args.link, len(devices))
    with contextlib.ExitStack() as stack:
        ports: Sequence[HostSide]
        with given_as_option('serve'):
            ports = stack.enter_context(open_sockets(args.serve, len(devices)) if args.serve else open_terminals(links))
        names = ','.join(port.name for port in ports)
        print(f'{PORT_LINE}{names}', flush=True)
        source = '' if name == 'serial' else f' --source {name}'
        reached = shlex.quote(','.join(link or port.name for link, port in zip(links, ports, strict=True)))
        print(
            f'a simulated rig answers there; try:  {program()} estimator --port {reached}{source}\nCtrl-C ends it',
            file=sys.stderr,
        )
        serve_all(devices, ports, stop.is_set)
    return 0
