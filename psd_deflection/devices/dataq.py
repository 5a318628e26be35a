# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""DATAQ DI-1110, DI-2108 and DI-4108 in CDC mode: no numbers, no times, no framing. A marker channel detects torn
scans, nothing the loss of whole ones; times are scan counts regressed on the host's clock."""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from psd_deflection import __version__
from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.devices.device import OUTPUT_LIMIT, Answer, Device, PowerUp, Probe
from psd_deflection.devices.port_source import PortSource, reject_datagrams
from psd_deflection.devices.protocol.dataq import (
    ANALOG,
    CLOCK_HZ,
    COUNTER,
    MODELS,
    STRIDE,
    VOLTS_PER_COUNT,
    Model,
    Rate,
    ScanDecoder,
    command,
    find_reply,
    plan_rate,
    scan_list,
)
from psd_deflection.devices.protocol.frames import PROTOCOL_VERSION, BadFrame, HelloFrame
from psd_deflection.devices.source import Clock, Event, PortClosedError, Received, Sample
from psd_deflection.records import CHANNELS, FLAG_OVER_RANGE
from psd_deflection.rig.config import Rig

if TYPE_CHECKING:
    from psd_deflection.devices.rig_feed import RigFeed

BAUD = 115_200
REPLY_S = 0.5
STOP_S = 2.5
"""Some models need a second for ``stop`` and ``encode``."""

TRIAL_SCANS = (250, 250, 500, 1000)
"""Numbers of scans over which the rate is measured before the first sample. If a measurement
disagrees with the set rate, the next number is tried: a busy host may have read late."""

TRIAL_TOLERANCE = 0.1
RAILS = (-32768, 32767)

FITTING = 'DI-1110, DI-2108, DI-4108'
IDLE_NS = 100_000_000


class Dataq(PortSource):
    """``source: dataq``: inputs 1 to 6 are x1 y1 sum1 x2 y2 sum2, +-10 V; nothing on the counter input."""

    clock = Clock.COUNTED
    numbered = False

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig.acquisition.port)
        reject_datagrams('dataq', self.name)
        self._wanted = rig.converter.sample_rate_hz
        if abs(rig.converter.volts_per_count - VOLTS_PER_COUNT) > 1e-3 * VOLTS_PER_COUNT:
            raise ConfigError(
                'source = dataq: reads 16 bits over ±10 V; set converter.bits = 16 and converter.full_scale = 10.0'
            )
        self._decoder = ScanDecoder()
        self._count = 0
        self._rate = Rate(0, 1, self._wanted)
        self._model = ''
        self._measured = 0.0

    def open(self, timeout: float) -> HelloFrame:
        """Stop a running scan, identify the device, set up the scan list, and measure the actual rate."""
        self.open_port(BAUD)
        try:
            return self._configure(timeout)
        except BaseException:
            self.close()
            raise

    def _configure(self, timeout: float) -> HelloFrame:
        if self._ask('stop', max(timeout, STOP_S)) is None:
            raise DeviceError(
                f'{self.name}: no answer to "stop"; is it a DATAQ device, and in CDC mode '
                '(its LED blinks yellow after the button was held while plugging in)?'
            )
        self._model = self._ask('info 1', REPLY_S) or ''
        model = MODELS.get(self._model)
        if model is None:
            raise DeviceError(f'{self.name}: a DATAQ model {self._model!r}; known are {", ".join(MODELS)}')
        if not _measures(model):
            raise DeviceError(
                f'{self.name}: the DI-{self._model} has {model.analog} analog inputs and '
                f'{"a" if model.counter else "no"} counter; six and a counter are needed ({FITTING})'
            )
        firmware, serial = self._ask('info 2', REPLY_S), self._ask('info 6', REPLY_S)
        self._must('encode 0', STOP_S)
        self._must('ps 0', REPLY_S)
        for line in scan_list(range(ANALOG)):
            self._must(line, REPLY_S)
        self._settle_rate(model)
        return HelloFrame(
            PROTOCOL_VERSION,
            {
                'serial': serial or '',
                'firmware': f'DATAQ DI-{self._model} {firmware or ""}'.strip(),
                'sample_rate_hz': self._rate.hz,
                'channels': list(CHANNELS),
                'volts_per_count': VOLTS_PER_COUNT,
                'sample_numbers': 'counted by the host',
            },
        )

    def _settle_rate(self, model: Model) -> None:
        """Set the rate and verify it; some devices take the number as conversions a second."""
        per_channel = False
        self._set_rate(model, per_channel)
        for scans in TRIAL_SCANS:
            self._measured = self._trial(scans)
            if abs(self._measured / self._rate.hz - 1.0) <= TRIAL_TOLERANCE:
                return
            if not per_channel and abs(self._measured * (ANALOG + 1) / self._rate.hz - 1.0) < TRIAL_TOLERANCE:
                per_channel = True
                self._set_rate(model, per_channel)
        raise DeviceError(
            f'{self.name}: does {self._measured:.1f} scans/s where {self._rate.hz:.1f} were set; '
            'is the counter input free, and does the host keep up?'
        )

    def _set_rate(self, model: Model, per_channel: bool) -> None:
        rate = plan_rate(self._wanted, model, per_channel)
        if rate is None:
            raise DeviceError(
                f'{self.name}: the DI-{self._model} cannot do {self._wanted:g} scans/s of {ANALOG + 1} channels; '
                'set converter.sample_rate_hz to 1000'
            )
        self._rate = rate
        if model.decimates:
            self._must(f'dec {rate.dec}', REPLY_S)
        self._must(f'srate {rate.srate}', REPLY_S)

    def _trial(self, scans: int) -> float:
        """Measure scans per second from the arrival of so many scans; stop the device afterwards."""
        port = self._opened()
        port.discard_input()
        port.write(command('reset 1') + command('start'))
        received = 0
        first = last = 0
        deadline = time.monotonic_ns() + round((5.0 * (ANALOG + 1) * scans / self._rate.hz + 1.0) * 1e9)
        counted_from = 0
        while received - counted_from < scans * STRIDE and time.monotonic_ns() < deadline:
            piece = port.read(0.1)
            if not piece:
                continue
            last = time.monotonic_ns()
            received += len(piece)
            if first == 0:
                # Time runs from the end of the first piece, which may have been buffered.
                first, counted_from = last, received
        self._ask('stop', STOP_S)
        return (received - counted_from) / STRIDE / ((last - first) * 1e-9) if last > first else 0.0

    def _ask(self, text: str, timeout: float) -> str | None:
        """The reply to a command ('' for its bare echo), or None."""
        port = self._opened()
        port.discard_input()
        port.write(command(text))
        received = b''
        deadline = time.monotonic() + timeout
        while (remaining := deadline - time.monotonic()) > 0:
            received = (received + port.read(remaining))[-4096:]
            reply = find_reply(received, text)
            if reply is not None:
                return reply
        return None

    def _must(self, text: str, timeout: float) -> None:
        if self._ask(text, timeout) is None:
            raise DeviceError(f'{self.name}: the DI-{self._model} did not confirm {text!r}; unplug it and try again')

    def start(self) -> None:
        """Start scanning; scans are numbered from 0. ``start`` is not echoed: only scans follow."""
        port = self._opened()
        self._must('reset 1', REPLY_S)
        port.discard_input()
        self._decoder, self._count = ScanDecoder(), 0
        port.write(command('start'))

    def read(self, timeout: float) -> Received:
        """Return the scans that have arrived."""
        received = self._opened().read(timeout)
        now = time.monotonic_ns()
        events: list[Event] = []
        period_us = 1e6 / self._rate.hz
        for scan in self._decoder.feed(received) if received else ():
            if isinstance(scan, BadFrame):
                events.append(scan)
                continue
            over = max(scan) == RAILS[1] or min(scan) == RAILS[0]
            events.append(
                Sample(FLAG_OVER_RANGE if over else 0, self._count % 2**32, round(self._count * period_us), scan)
            )
            self._count += 1
        return Received(events, now, len(received))

    def reopen(self) -> HelloFrame | None:
        """Configure the device again: it forgets its scan list when it is unplugged."""
        hello = self.open(REPLY_S)
        self.start()
        return hello

    def wake(self) -> None:
        """Raise PortClosedError: a silent device was stopped or forgot its scan list and must be configured again."""
        raise PortClosedError(f'{self.name}: no scans come')

    def close(self) -> None:
        """Stop the device and give the port back."""
        if self._port is not None:
            with contextlib.suppress(DeviceError):
                self._port.write(command('stop'))
        super().close()

    def describe(self) -> Mapping[str, str]:
        """Model, set and measured rates, and the losses that cannot be detected."""
        return {
            'source': f'DATAQ DI-{self._model or "?"} on {self.name}',
            'scan rate set (1/s)': f'{self._rate.hz:.3f}',
            'scan rate at start (1/s)': f'{self._measured:.1f}',
            'sample numbers': 'counted by the host; torn scans are seen, lost whole scans are not',
            'sample times': 'counted scans, regressed on the host clock',
        }


def _measures(model: Model) -> bool:
    return model.analog >= ANALOG and model.counter


class SimulatedDataq:
    """A DI-2108 or a similar model. ``per_channel``: takes srate as conversions a second, as some models do.

    It sends nothing before ``start``, echoes commands while it does not scan, and does not echo
    ``start``. Inputs after the sixth read zero.
    """

    def __init__(
        self,
        feed: RigFeed,
        power_up: PowerUp | None = None,
        *,
        model: str = '2108',
        per_channel: bool = False,
        serial: str = '5D2A0001',
    ) -> None:
        self._feed = feed
        self._fast = 1.0 + (power_up or PowerUp()).skew_ppm * 1e-6
        self._info = {'0': 'DATAQ', '1': model, '2': f'SIM {__version__}', '6': serial, '9': str(CLOCK_HZ)}
        self._per_channel = per_channel
        self._list: dict[int, int] = {0: 0}
        self._srate, self._dec = 6000, 1
        self._scanning = False
        self._started_ns = 0
        self._sent = 0
        self._line = b''

    def greeting(self) -> bytes:
        """Nothing: the device only answers commands."""
        return b''

    def due_in_ns(self, since_power_up_ns: int) -> int:
        """Host nanoseconds until the next scan."""
        if not self._scanning:
            return IDLE_NS
        return self._started_ns + int(self._sent * self._period_ns()) - since_power_up_ns

    def _period_ns(self) -> float:
        ticks = self._srate * self._dec * (len(self._list) if self._per_channel else 1)
        return ticks * 1e9 / CLOCK_HZ / self._fast

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        """Replies to whole command lines."""
        *lines, self._line = (self._line + received)[-4096:].split(b'\r')
        replies = b''
        for line in lines:
            replies += self._obey(line.decode('ascii', 'replace').strip(), since_power_up_ns)
        return replies

    def _obey(self, text: str, now: int) -> bytes:
        scanning = self._scanning
        words = text.split()
        answer = text
        match words:
            case ['stop']:
                # It echoes even while it scans.
                self._scanning = scanning = False
            case ['start', *_]:
                self._scanning, self._started_ns, self._sent = True, now, 0
                return b''
            case ['info', number]:
                answer = f'{text} {self._info.get(number, "0")}'
            case ['slist', position, word] if position.isdigit() and word.isdigit():
                if position == '0':
                    self._list = {}  # Bound: the simulated device: its 11 channels.
                self._list[int(position)] = int(word)
            case ['srate', number] if number.isdigit() and int(number) > 0:
                self._srate = int(number)
            case ['dec', number] if number.isdigit() and int(number) > 0:
                self._dec = int(number)
            case _:
                pass
        # Replies come padded with a zero now and then.
        return b'' if scanning or not text else answer.encode('ascii', 'replace') + b'\r\x00'

    def take(self, since_power_up_ns: int, room: int = OUTPUT_LIMIT) -> bytes:
        """The scans that are due. If no room is left they are lost without a report, as on the real devices."""
        out = bytearray()
        while self._scanning and self.due_in_ns(since_power_up_ns) <= 0:
            row = self._feed.next()
            self._sent += 1
            if len(out) < room:
                words = [self._list[p] & 15 for p in sorted(self._list)]
                values = [-32768 if w == COUNTER else row[w] if w < ANALOG else 0 for w in words]
                out += struct.pack(f'<{len(values)}h', *values)
        return bytes(out)


class DataqProbe:
    """Recognises the replies to ``info 0`` and ``info 1``."""

    promising = False

    def __init__(self, baud: int) -> None:
        self._received = b''

    def feed(self, piece: bytes) -> Answer | None:
        """Which model answers."""
        self._received = (self._received + piece)[-4096:]
        name = find_reply(self._received, 'info 1')
        if find_reply(self._received, 'info 0') is None or name is None:
            return None
        model = MODELS.get(name)
        if model is None or not _measures(model):
            return Answer(f'DATAQ DI-{name}: six analog inputs and a counter are needed ({FITTING})', usable=False)
        return Answer(f'DATAQ DI-{name}', {'converter.bits': 16, 'converter.full_scale': 10.0})


def _simulate(feed: RigFeed, power_up: PowerUp) -> Sequence[SimulatedDataq]:
    return [SimulatedDataq(feed, power_up)]


DEVICE = Device(
    'dataq',
    'a DATAQ DI-1110, DI-2108 or DI-4108',
    Dataq,
    _simulate,
    # The carriage return ends bytes that the converter took for the start of a command.
    Probe(DataqProbe, b'\r' + command('info 0') + command('info 1')),
)
