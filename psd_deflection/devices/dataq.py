"""DATAQ DI-1110, DI-2108 and DI-4108 in CDC mode: converters with a command line, no framing.

What is lost against our own frames, and said in ``describe``: the device numbers no samples and
tells no time. A torn scan is found by the marker channel (``protocol.dataq``) and counted; the loss
of whole scans cannot be seen. Times are the count of scans, regressed on the host's clock.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

from psd_deflection.config import Rig
from psd_deflection.devices.serial_port import PortClosedError, SerialPort
from psd_deflection.devices.source import Clock, Event, Reading, Sample, Source
from psd_deflection.errors import ConfigError, DeviceError
from psd_deflection.protocol.dataq import (
    ANALOG,
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
from psd_deflection.protocol.frames import PROTOCOL_VERSION, BadFrame, HelloFrame
from psd_deflection.records import CHANNELS, FLAG_OVER_RANGE

BAUD = 115_200
REPLY_S = 0.5
STOP_S = 2.5
"""``stop`` and ``encode`` hold some models up for a second."""

TRIAL_SCANS = (250, 250, 500, 1000)
"""Scans over which the rate is measured before the first sample is given; the next where the one before
does not agree with what was set: a busy host may have been late to read."""

TRIAL_TOLERANCE = 0.1
RAILS = (-32768, 32767)


class Dataq(Source):
    """``source: dataq``: inputs 1 to 6 are x1 y1 sum1 x2 y2 sum2, +-10 V; nothing on the counter input."""

    clock = Clock.COUNTED
    numbered = False

    def __init__(self, rig: Rig) -> None:
        self.name = rig.acquisition.port
        self._wanted = rig.converter.sample_rate_hz
        if abs(rig.converter.volts_per_count - VOLTS_PER_COUNT) > 1e-3 * VOLTS_PER_COUNT:
            raise ConfigError(
                'source = dataq: reads 16 bits over +-10 V; set converter.bits = 16 and converter.full_scale = 10.0'
            )
        self._port: SerialPort | None = None
        self._decoder = ScanDecoder()
        self._count = 0
        self._rate = Rate(0, 1, self._wanted)
        self._model = ''
        self._measured = 0.0

    def open(self, timeout: float) -> HelloFrame:
        """Stop whatever runs, identify the device, lay out the scan, and measure what rate it does."""
        self._port = SerialPort(self.name, BAUD)
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
        if model.analog < ANALOG or not model.counter:
            raise DeviceError(
                f'{self.name}: the DI-{self._model} has {model.analog} analog inputs and '
                f'{"a" if model.counter else "no"} counter; six and a counter are needed (DI-1110, DI-2108, DI-4108)'
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
        """Set the rate, and see that it is done; some devices take the number as conversions a second."""
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
        """Scans a second as they come, by arrival over so many; the device is stopped again."""
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
                # The clock starts with the end of the first piece, which may have waited.
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
        while (left := deadline - time.monotonic()) > 0:
            received = (received + port.read(left))[-4096:]
            reply = find_reply(received, text)
            if reply is not None:
                return reply
        return None

    def _must(self, text: str, timeout: float) -> None:
        if self._ask(text, timeout) is None:
            raise DeviceError(f'{self.name}: the DI-{self._model} did not confirm {text!r}; unplug it and try again')

    def _opened(self) -> SerialPort:
        if self._port is None:
            raise DeviceError(f'{self.name}: not open')
        return self._port

    def start(self) -> None:
        """Start scanning; scans are numbered from 0. ``start`` is not echoed: all that follows is scans."""
        port = self._opened()
        self._must('reset 1', REPLY_S)
        port.discard_input()
        self._decoder, self._count = ScanDecoder(), 0
        port.write(command('start'))

    def read(self, timeout: float) -> Reading:
        """The scans that have come."""
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
        return Reading(events, now, len(received))

    def reopen(self) -> HelloFrame | None:
        """Configure it anew: a DATAQ device forgets its scan list when it is unplugged."""
        hello = self.open(REPLY_S)
        self.start()
        return hello

    def wake(self) -> None:
        """Silence means that it was stopped or has forgotten its scan list: it is to be configured anew."""
        raise PortClosedError(f'{self.name}: no scans come')

    def give_up(self) -> None:
        """Wait for the device no longer."""
        port = self._port
        if port is not None:
            port.give_up()

    def close(self) -> None:
        """Stop the device and give the port back."""
        if self._port is not None:
            try:
                self._port.write(command('stop'))
            except DeviceError:
                pass
            finally:
                self._port.close()
                self._port = None

    def describe(self) -> Mapping[str, str]:
        """Model, rates set and measured, and what cannot be seen."""
        return {
            'source': f'DATAQ DI-{self._model or "?"} on {self.name}',
            'scan rate set (1/s)': f'{self._rate.hz:.3f}',
            'scan rate at start (1/s)': f'{self._measured:.1f}',
            'sample numbers': 'counted by the host; torn scans are seen, lost whole scans are not',
            'sample times': 'counted scans, regressed on the host clock',
        }
