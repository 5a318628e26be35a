# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Finds which device is on which port: sends the question of every device that has a probe, and listens. Nothing is
started or set; a port that another program has open is left alone."""

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from serial.tools import list_ports

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.device import Answer, Device, Probe
from psd_deflection.devices.port import OpenPort, has_baud
from psd_deflection.devices.ports import open_port

COMMON_BAUD = 115_200
ANSWER_S = 0.4
ONCE_A_SECOND_S = 1.3
"""HELLO and the description of text lines come once a second."""
BOOT_S = 3.5
"""An Arduino restarts when its port is opened."""

PSEUDO_TERMINALS = Path('/dev/pts')
BY_ID = Path('/dev/serial/by-id')


@dataclass(slots=True)
class Port:
    """A port. ``source``: the name for ``source:``, '' if no known device answers.

    ``answer``: the device that answered, or why none could. ``suggested``: parameters for it.
    ``asked``: False if the port is missing, in use or cannot be opened.
    """

    port: str
    description: str = ''
    source: str = ''
    answer: str = 'nothing that we know answers'
    suggested: dict[str, Any] = field(default_factory=dict)
    asked: bool = True


class _ProtocolProbes:
    """Listens for all protocols at once on ``port``; takes the first valid answer."""

    def __init__(self, port: Port, baud: int, probes: Sequence[tuple[str, Probe]]) -> None:
        self.bytes = 0
        self.answered = False
        self._port = port
        self._probes = [(name, probe.listen(baud)) for name, probe in probes]

    @property
    def promising(self) -> bool:
        """Whether samples of a known device have come."""
        return any(probe.promising for _, probe in self._probes)

    def feed(self, piece: bytes) -> bool:
        """Whether the device is now known."""
        self.bytes += len(piece)
        for name, probe in self._probes:
            answer = probe.feed(piece)
            if answer is not None:
                self._note(name, answer)
                return True
        return False

    def _note(self, name: str, answer: Answer) -> None:
        self.answered = True
        self._port.answer = answer.text
        if answer.usable:
            self._port.source = name
            suggested = {'source': name, 'port': stable_name(self._port.port), **answer.parameters}
            # A pseudo-terminal answers at any speed, so none is known.
            if not has_baud(self._port.port) or Path(self._port.port).resolve().parent == PSEUDO_TERMINALS:
                suggested.pop('baud', None)
            self._port.suggested = suggested


def stable_name(port: str) -> str:
    """A name of the port that does not change when the device is plugged in again; ``port`` if there is none."""
    try:
        return next((str(p) for p in sorted(BY_ID.iterdir()) if p.resolve() == Path(port).resolve()), port)
    except OSError:
        return port


def serial_ports() -> list[Port]:
    """The machine's serial ports that have a device on them, as far as the system knows."""
    ports = []
    for p in sorted(list_ports.comports(), key=lambda p: p.device):
        if p.hwid == 'n/a':
            # The built-in ports of a PC, mostly without a connector.
            continue
        ports.append(Port(p.device, p.description or ''))
    return ports


def identify(port: Port, devices: Sequence[Device]) -> Port:
    """Fill in which of ``devices`` answers on ``port``; takes up to about five seconds per line speed.

    Raises ConfigError if it is no name of a port.
    """
    probes = [(d.name, d.probe) for d in devices if d.probe is not None]
    # A stable sort: the others keep their order.
    probes.sort(key=lambda named: not named[1].first)
    speeds = list(dict.fromkeys([COMMON_BAUD, *(probe.baud for _, probe in probes)]))
    if not has_baud(port.port):
        # Whichever it is, it is set at the other end.
        speeds = speeds[:1]
    try:
        for baud in speeds:
            probing = _ask(port, baud, probes)
            if probing.answered or probing.promising or not probing.bytes:
                break
            # A device sends, but not at this speed.
    except DeviceError as error:
        port.answer = str(error).removeprefix(f'{port.port}: ')
        port.asked = False
    return port


def _ask(port: Port, baud: int, probes: Sequence[tuple[str, Probe]]) -> _ProtocolProbes:
    line = open_port(port.port, baud)
    probing = _ProtocolProbes(port, baud, probes)
    try:
        for _, probe in probes:
            if probe.question:
                line.write(probe.question)
                if _listen(line, probing, ANSWER_S):
                    return probing
        if _listen(line, probing, ONCE_A_SECOND_S if probing.bytes else BOOT_S):
            return probing
        if probing.promising:
            port.answer = 'samples come, but the device does not say what it is'
        elif probing.bytes:
            speed = f' at {baud} baud' if has_baud(port.port) else ''
            port.answer = f'{probing.bytes} bytes that we cannot read{speed}'
    finally:
        line.close()
    return probing


def _listen(line: OpenPort, probing: _ProtocolProbes, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while (remaining := deadline - time.monotonic()) > 0:
        if probing.feed(line.read(remaining)):
            return True
    return False


def survey(devices: Sequence[Device], names: Sequence[str] = ()) -> list[Port]:
    """Every port, or only the named ones, with the one of ``devices`` that answers.

    Pseudo-terminals and ports of the network must be named, since the system does not list them.
    Raises ConfigError for what is no name of a port.
    """
    ports = [Port(name) for name in names] or serial_ports()
    if not ports:
        return []
    with ThreadPoolExecutor(max_workers=len(ports)) as pool:
        return list(pool.map(lambda port: identify(port, devices), ports))


def suggestions(devices: Sequence[Device], ports: Sequence[Port]) -> list[dict[str, Any]]:
    """One parameter set per device; if a device needs several ports, they are joined in order."""
    single = {d.name for d in devices if d.probe is not None and d.probe.ports == 1}
    out: list[dict[str, Any]] = [p.suggested for p in ports if p.source in single]
    for device in devices:
        if device.probe is None or device.probe.ports == 1:
            continue
        suggested = [p.suggested for p in ports if p.source == device.name]
        n = device.probe.ports
        for first in range(0, len(suggested) - n + 1, n):
            names = ','.join(s['port'] for s in suggested[first : first + n])
            out.append({**suggested[first], 'port': names, **device.probe.together})
    return out
