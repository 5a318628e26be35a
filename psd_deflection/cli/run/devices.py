# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""List the serial ports, find out which device is on each, and print parameters for it.

Without PORT it tries every port that the system lists; a pseudo-terminal or a port of the network
(socket://HOST:PORT, rfc2217://HOST:PORT, udp://HOST:PORT) must be named. A port that
another program has open is listed but not tried. Exit status 5: a port that you named is missing, in
use or cannot be opened.

  psd-deflection devices
  psd-deflection devices /dev/ttyACM0 --json
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict

from psd_deflection.base.errors import DeviceError
from psd_deflection.cli._progress import stage
from psd_deflection.cli._report import print_json, show, show_text
from psd_deflection.cli._values import given_as_option
from psd_deflection.devices.device import Device
from psd_deflection.devices.registry import known_devices
from psd_deflection.devices.survey import Port, suggestions, survey


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    devices, _ = known_devices()
    parser.epilog = epilog(devices)
    parser.add_argument('ports', nargs='*', metavar='PORT', help='only these, e.g. /dev/ttyACM0 or /dev/pts/3')
    parser.add_argument('--json', action='store_true', help='print the result as JSON')


def run(args: argparse.Namespace) -> int:
    """Print the survey; the exit status is 0 unless a named port could not be asked."""
    devices, rejections = known_devices()
    for rejection in rejections:
        show(f'psd-deflection devices: not asked for: {rejection}', aside=True)
    with stage('asking; a port that stays silent takes some seconds', quiet=args.json), given_as_option():
        ports = survey(devices, args.ports)
    if args.json:
        print_json({'ports': [asdict(p) for p in ports], 'suggested': suggestions(devices, ports)}, indent=2)
        _reject_unasked(args.ports, ports)
        return 0
    if not ports:
        show('no serial ports; is the device plugged in? (a pseudo-terminal has to be named)')
        return 0
    for port in ports:
        if args.ports and not port.asked:
            continue
        about = f' ({port.description})' if port.description and port.description != 'n/a' else ''
        # What stands in a USB descriptor is the device's word as well.
        show(f'{port.port}{about}', f'  {port.answer}')
    for suggested in suggestions(devices, ports):
        show('')
        show_text(parameter_lines(suggested))
    _reject_unasked(args.ports, ports)
    return 0


def _reject_unasked(named: list[str], ports: list[Port]) -> None:
    unasked = [p for p in ports if not p.asked]
    if named and unasked:
        raise DeviceError('; '.join(f'{p.port}: {p.answer}' for p in unasked))


def epilog(devices: Sequence[Device]) -> str:
    """A description of each name that ``source:`` accepts."""
    width = max(len(device.name) for device in devices)
    lines = []
    for device in devices:
        remark = '' if device.probe is not None else ' (cannot be recognised)'
        lines.append(f'  {device.name:{width}}  {device.help}{remark}')
    return '\n'.join(['values of the parameter source:', *lines])


def parameter_lines(values: dict[str, object]) -> str:
    """A ROS 2 parameter file of these values, to be merged with that of the rig."""
    lines = ['/**:', '  ros__parameters:']
    section = ''
    for name, value in values.items():
        head, _, tail = name.rpartition('.')
        if head and head != section:
            lines.append(f'    {head}:')
        section = head
        lines.append(f'    {"  " if head else ""}{tail}: {json.dumps(value)}')
    return '\n'.join(lines)
