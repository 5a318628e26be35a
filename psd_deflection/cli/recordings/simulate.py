# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulate the rig: write a recording (--out), or act as a device (--serve).

The rig file describes the rig and its known effects. --effect adds a hidden effect: the samples
contain it, but the estimates do not correct for it and the recorded parameters do not list it.
--world sets a parameter of the simulated rig alone, so that the rig file has it wrong.
A recording contains the samples, the estimates and the loads, the temperature if --temperature is
given, and the true pose with --true-pose or, with noise, --reference-noise. A .csv has no estimates.

  psd-deflection simulate --out run --loads thesis --temperature 20,24
  psd-deflection simulate --out odd.csv --effect axis_crosstalk,psd=1,xy=0.02
  psd-deflection simulate --out s.mcap --loads 'steps:0,0,0;0,-10,-5.85:2'
  psd-deflection simulate --out wired.csv --world 'psd_1.axes=[x, -y]'
  psd-deflection simulate --serve --link rig_port
  psd-deflection simulate --serve socket://127.0.0.1:4000
"""

import argparse
import contextlib
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from psd_deflection.base.errors import UsageError
from psd_deflection.base.text import plain_number
from psd_deflection.cli._options import in_the_world, recording_name, reject, world_option
from psd_deflection.cli._report import print_json, program, show
from psd_deflection.cli._values import given_as_option, integer, number, seed
from psd_deflection.devices.device import PowerUp
from psd_deflection.devices.pseudo_terminal import PORT_LINE, link_names, open_terminals
from psd_deflection.devices.registry import SIMULATED
from psd_deflection.devices.serve import Hand, HostSide, open_sockets, serve_all, simulated_devices, stopped_by_signals
from psd_deflection.model.simulation.catalogue import effects_of_rig, with_effects
from psd_deflection.model.simulation.loads import HELP, CyclicLoads, load_histories, temperature_history
from psd_deflection.recordings.formats.format import format_of_name, open_sink
from psd_deflection.recordings.replay.simulated_recording import BAG_START_NS, SimulatedRun
from psd_deflection.records import AppliedLoad, Record, ReferencePose, SampleBlock, TemperatureReading
from psd_deflection.rig.config import load_rig

OF_A_DEVICE = {'device': None, 'link': None, 'skew_ppm': 0.0, 'first_seq': 0}
"""Options of a device, and what they are if they are not given."""

MAX_SKEW_PPM = 100_000.0


def _device_arguments(parser: argparse.ArgumentParser) -> None:
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
        source += f' --params-file {shlex.quote(args.params_file)}' if args.params_file else ''
        reached = shlex.quote(','.join(link or port.name for link, port in zip(links, ports, strict=True)))
        print(
            f'a simulated rig answers there; try:  {program()} estimator --port {reached}{source}\nCtrl-C ends it',
            file=sys.stderr,
        )
        serve_all(devices, ports, stop.is_set)
    return 0


LEAST_SAMPLES = 2
"""Fewer tell no sample rate: such a CSV could not be read again."""

OF_A_RECORDING: dict[str, object] = {
    'out': None,
    'temperature': None,
    'effect': [],
    'reference': False,
    'reference_noise': None,
    'json': False,
}
"""Options of a recording and their defaults."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = HELP
    parser.add_argument('--params-file', metavar='RIG.yaml', help='the rig and its known effects')
    parser.add_argument('--seed', type=seed, default=0, help='seed of the noise (default 0)')
    world_option(parser)
    parser.add_argument(
        '--loads',
        metavar='WORDS',
        action='append',
        help='a load history, see below (default: thesis); repeatable; a device begins it again and again',
    )
    group = parser.add_argument_group('as a recording (--out)')
    group.add_argument('--out', type=recording_name(), metavar='OUT', help='X.csv, X.mcap or a bag folder (X)')
    group.add_argument(
        '--temperature', metavar='T0[,T1...]', help='°C, straight lines through these, evenly spread over the recording'
    )
    group.add_argument(
        '--effect', metavar='NAME,KEY=VALUE,...', action='append', default=[], help='add a hidden effect; repeatable'
    )
    group.add_argument(
        '--true-pose',
        '--reference',
        dest='reference',
        action='store_true',
        help='record the true pose as a reference measurement',
    )
    group.add_argument(
        '--reference-noise',
        metavar='XY,THETA',
        help='record the pose with noise of so much (1 sd: m, rad), as a camera has; 1e-5,5e-4 is that of the thesis',
    )
    group.add_argument('--json', action='store_true', help='print the summary as JSON')
    _device_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Serve or write."""
    if args.serve is not None:
        reject(args, OF_A_RECORDING, 'is for a recording (--out), not for a device (--serve)')
        return run_device(args)
    if args.out is None:
        raise UsageError('--out OUT (a recording) or --serve (a device) is needed')
    reject(args, OF_A_DEVICE, 'is for a device: give --serve and no --out')
    # With its own effects first, so that what is wrong in the file is not laid to the options.
    known = with_effects(load_rig(args.params_file), (), '')
    with given_as_option():
        rig = with_effects(in_the_world(known, args.world), args.effect, '--effect')
        rate = rig.converter.sample_rate_hz
        history = load_histories(args.loads or ['thesis'], rate, '--loads')
        if len(history) < LEAST_SAMPLES:
            raise UsageError(
                f'--loads: last {len(history)} samples at {rate:g} Hz; a recording has at least {LEAST_SAMPLES}'
            )
        temperature = (
            None if args.temperature is None else temperature_history(args.temperature, len(history), '--temperature')
        )
    noise = None if args.reference_noise is None else _reference_noise(args.reference_noise)
    reference = args.reference or noise is not None
    kinds: list[type[Record]] = [AppliedLoad]
    kinds += [TemperatureReading] * (temperature is not None) + [ReferencePose] * reference
    simulated = SimulatedRun(rig, known, history.loads, temperature, args.seed, reference, noise or (0.0, 0.0, 0.0))
    count = len(history)
    sink = open_sink(args.out, known.flat(), samples_with=kinds, psds=len(rig.psds))
    bar = tqdm(total=count, unit=' samples', delay=1.0, leave=False, disable=args.json or None, ncols=80)
    with contextlib.closing(sink), bar:
        for record in simulated.records(0 if format_of_name(args.out).is_table else BAG_START_NS):
            sink.put(record)
            if isinstance(record, SampleBlock):
                bar.update(len(record.seq))
    names = [a.label for a in effects_of_rig(rig)]
    if args.json:
        print_json({'out': args.out, 'samples': count, 'duration_s': count / rate, 'effects': names})
    else:
        show(f'{Path(args.out)}: {count} samples, {count / rate:.1f} s; effects: {", ".join(names) or "none"}')
    return 0


def _reference_noise(text: str) -> tuple[float, float, float]:
    """The value of --reference-noise, for dX, dY and theta; raises UsageError."""
    try:
        across, twist = map(plain_number, text.split(','))
    except ValueError:
        across = twist = -1.0
    if not (0.0 <= across <= 1.0 and 0.0 <= twist <= 1.0):
        raise UsageError(
            f'--reference-noise {text}: must be two numbers of at least 0 and at most 1, such as 1e-5,5e-4'
        )
    return across, across, twist
