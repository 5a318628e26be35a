"""Which port has what on it: asks politely in every language we read, and listens.

Nothing is started, stopped or set: only questions are asked that each of these devices answers from
where it stands (an Arduino starts anew all the same, whenever its port is opened). A port that another
program has open is left alone.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from serial.tools import list_ports

from psd_deflection.devices.serial_port import SerialPort
from psd_deflection.errors import DeviceError
from psd_deflection.protocol.apt import INFO_REQUEST, AptDecoder, HardwareInfo
from psd_deflection.protocol.dataq import MODELS, command, find_reply
from psd_deflection.protocol.frames import FrameDecoder, HelloFrame, HelloRequestFrame, SampleFrame, encode
from psd_deflection.protocol.text_lines import Description, Line, LineDecoder, positive

FRAMES_BAUD = 921_600
COMMON_BAUD = 115_200
ANSWER_S = 0.4
ONCE_A_SECOND_S = 1.3
"""HELLO and the description of text lines come once a second."""
BOOT_S = 3.5
"""An Arduino starts anew when its port is opened."""

BY_ID = Path('/dev/serial/by-id')


@dataclass(slots=True)
class Port:
    """A port. ``source``: the name for ``source:``, '' where nothing that we know answers.

    ``answer``: what answered, or why nothing could. ``suggested``: parameters for it.
    ``asked``: False where the port is missing, in use or cannot be opened.
    """

    port: str
    description: str = ''
    usb_serial: str = ''
    source: str = ''
    answer: str = 'nothing that we know answers'
    suggested: dict[str, Any] = field(default_factory=dict)
    asked: bool = True


class _Ear:
    """Hears every language at once; ``found`` is the first that made sense."""

    def __init__(self, port: Port, baud: int) -> None:
        self.port = port
        self.baud = baud
        self.received = b''
        self.bytes = 0
        self._frames, self._lines, self._apt = FrameDecoder(), LineDecoder(), AptDecoder()
        self.promising = False

    def hear(self, piece: bytes) -> bool:
        """Whether it is known now what is there."""
        self.bytes += len(piece)
        self.received = (self.received + piece)[-4096:]
        for frame in self._frames.feed(piece):
            if isinstance(frame, HelloFrame):
                self._ours(frame)
                return True
            self.promising = self.promising or isinstance(frame, SampleFrame)
        for item in self._lines.feed(piece):
            if isinstance(item, Description) and 'sample_rate_hz' in item.info:
                self._text(item.info)
                return True
            self.promising = self.promising or isinstance(item, Line)
        for message in self._apt.feed(piece):
            if isinstance(message, HardwareInfo):
                self._aligner(message)
                return True
        return self._converter()

    def _ours(self, hello: HelloFrame) -> None:
        info = hello.info
        self.port.source = 'serial'
        self.port.answer = (
            f'PSD device {info.get("serial", "?")}, firmware {info.get("firmware", "?")}, protocol {hello.version}'
        )
        self._suggest('serial', info, self.baud)

    def _text(self, info: dict[str, object]) -> None:
        self.port.source = 'lines'
        self.port.answer = f'text lines, {info.get("serial", "no serial number")}'
        self._suggest('lines', info, self.baud)

    def _suggest(self, source: str, info: dict[str, object], baud: int) -> None:
        out: dict[str, Any] = {'source': source, 'port': stable_name(self.port.port), 'baud': baud}
        rate, volts = positive(info.get('sample_rate_hz')), positive(info.get('volts_per_count'))
        if rate is not None:
            out['converter.sample_rate_hz'] = rate
        if volts is not None:
            out['converter.full_scale'] = round(volts * 32768, 6)
        self.port.suggested = out

    def _aligner(self, info: HardwareInfo) -> None:
        self.port.source = 'thorlabs'
        self.port.answer = f'Thorlabs {info.model} {info.serial}, firmware {info.firmware}'
        self.port.suggested = {'source': 'thorlabs', 'port': stable_name(self.port.port)}

    def _converter(self) -> bool:
        if find_reply(self.received, 'info 0') is None:
            return False
        model = find_reply(self.received, 'info 1')
        if model is None:
            return False
        known = MODELS.get(model)
        self.port.answer = f'DATAQ DI-{model}'
        if known is None or known.analog < 6 or not known.counter:
            self.port.answer += ': six analog inputs and a counter are needed (DI-1110, DI-2108, DI-4108)'
            return True
        self.port.source = 'dataq'
        self.port.suggested = {
            'source': 'dataq',
            'port': stable_name(self.port.port),
            'converter.bits': 16,
            'converter.full_scale': 10.0,
        }
        return True


def stable_name(port: str) -> str:
    """The name of the port that stays when it is plugged in anew, where there is one."""
    try:
        return next((str(p) for p in sorted(BY_ID.iterdir()) if p.resolve() == Path(port).resolve()), port)
    except OSError:
        return port


def serial_ports() -> list[Port]:
    """The machine's serial ports with something on them, as far as the system knows."""
    found = []
    for p in sorted(list_ports.comports(), key=lambda p: p.device):
        if p.hwid == 'n/a':
            # The fixed ports of a PC's chip set, mostly without a plug.
            continue
        found.append(Port(p.device, p.description or '', p.serial_number or ''))
    return found


def identify(port: Port) -> Port:
    """Fill in what answers on it; takes up to about five seconds."""
    try:
        ear = _ask(port, COMMON_BAUD)
        if not port.source and ear.bytes and not ear.promising and not port.suggested:
            # Something talks, but not at this speed.
            _ask(port, FRAMES_BAUD)
    except DeviceError as error:
        port.answer = str(error).removeprefix(f'{port.port}: ')
        port.asked = False
    return port


def _ask(port: Port, baud: int) -> _Ear:
    line = SerialPort(port.port, baud)
    ear = _Ear(port, baud)
    try:
        # The aligner first: it has no way to find out that it was spoken to in another language.
        questions = (
            (INFO_REQUEST, ANSWER_S),
            (b'\x00' + encode(HelloRequestFrame()), ANSWER_S),
            # The carriage return ends what a converter took for the beginning of a command.
            (b'\r' + command('info 0') + command('info 1'), ANSWER_S),
        )
        for question, wait in questions:
            line.write(question)
            if _listen(line, ear, wait):
                return ear
        _listen(line, ear, ONCE_A_SECOND_S if ear.bytes else BOOT_S)
        if not port.source and ear.promising:
            port.answer = 'samples come, but the device does not say what it is'
        elif not port.source and ear.bytes:
            port.answer = f'{ear.bytes} bytes that we cannot read at {baud} baud'
    finally:
        line.close()
    return ear


def _listen(line: SerialPort, ear: _Ear, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0:
        if ear.hear(line.read(left)):
            return True
    return False


def survey(names: Sequence[str] = ()) -> list[Port]:
    """Every port with what answers on it, or only those named (a pseudo-terminal is in no list)."""
    ports = [Port(name) for name in names] or serial_ports()
    if not ports:
        return []
    with ThreadPoolExecutor(max_workers=len(ports)) as pool:
        return list(pool.map(identify, ports))
