"""Devices that send a line of text a sample (``protocol.text_lines``): a quick Arduino.

They number their samples and tell their time, so losses are seen and times are the device's own.
What is lost against our own frames: a line without a check takes a digit that the wire changed for
true, the device cannot be asked anything, and 115200 baud carry about 250 lines a second.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

from psd_deflection.config import Rig
from psd_deflection.devices.serial_port import SerialPort
from psd_deflection.devices.source import Event, Reading, Sample, Source
from psd_deflection.errors import DeviceError
from psd_deflection.protocol.frames import PROTOCOL_VERSION, BadFrame, HelloFrame
from psd_deflection.protocol.text_lines import (
    MAX_VOLTS,
    Description,
    Line,
    LineDecoder,
    TimeExtender,
    positive,
)
from psd_deflection.records import CHANNELS, FLAG_OVER_RANGE

BOOT_S = 4.0
"""An Arduino starts anew when its port is opened, and its boot loader takes two seconds."""


class TextLines(Source):
    """``source: lines``."""

    def __init__(self, rig: Rig) -> None:
        self.name = rig.acquisition.port
        self._baud = rig.acquisition.baud
        self._port: SerialPort | None = None
        self._decoder = LineDecoder()
        self._time = TimeExtender()
        self._counts = False
        self._serial = ''

    def open(self, timeout: float) -> HelloFrame:
        """Open the port and wait for the line that describes the device."""
        port = self._port = SerialPort(self.name, self._baud)
        timeout = max(timeout, BOOT_S)
        lines = received = 0
        try:
            decoder = LineDecoder()
            deadline = time.monotonic() + timeout
            while (left := deadline - time.monotonic()) > 0:
                piece = port.read(left)
                received += len(piece)
                for item in decoder.feed(piece):
                    lines += isinstance(item, Line)
                    if isinstance(item, Description) and 'sample_rate_hz' in item.info:
                        return self._hello(item.info)
        except BaseException:
            self.close()
            raise
        self.close()
        if lines:
            why = 'samples come but no line that describes them: # {"sample_rate_hz": 200}'
        elif received:
            why = f'{received} bytes but no line of ours; is the baud rate ({self._baud}) right?'
        else:
            why = 'nothing comes; does the sketch run, and is this its port?'
        raise DeviceError(f'{self.name}: {why} (waited {timeout:g} s)')

    def _hello(self, info: dict[str, object]) -> HelloFrame:
        self._counts = positive(info.get('volts_per_count')) is not None
        self._serial = str(info.get('serial', ''))[:64]
        own: dict[str, object] = {
            'serial': self._serial,
            'firmware': 'text lines',
            'channels': list(CHANNELS),
            'volts_per_count': None,
        }
        # Only what is known is kept: the line is a stranger's and goes into recordings.
        known = ('firmware', 'sample_rate_hz', 'channels', 'volts_per_count')
        return HelloFrame(PROTOCOL_VERSION, own | {k: v for k, v in info.items() if k in known})

    def start(self) -> None:
        """Forget what came while the device was heard out."""
        self._decoder = LineDecoder()
        if self._port is not None:
            self._port.discard_input()

    def read(self, timeout: float) -> Reading:
        """The lines that have come."""
        if self._port is None:
            raise DeviceError(f'{self.name}: not open')
        received = self._port.read(timeout)
        now = time.monotonic_ns()
        events: list[Event] = []
        for item in self._decoder.feed(received) if received else ():
            if isinstance(item, Line):
                events.append(self._sample(item))
            elif isinstance(item, BadFrame):
                events.append(item)
        return Reading(events, now, len(received))

    def _sample(self, line: Line) -> Event:
        if not self._counts:
            if max(map(abs, line.readings)) > MAX_VOLTS:
                return BadFrame('a reading is out of all bounds', 0)
            return Sample(0, line.seq, self._time.extend(line), line.readings)
        if not all(r.is_integer() and -32768 <= r <= 32767 for r in line.readings):
            return BadFrame('counts are whole numbers of 16 bits', 0)
        counts = tuple(int(r) for r in line.readings)
        over = max(counts) == 32767 or min(counts) == -32768
        return Sample(FLAG_OVER_RANGE if over else 0, line.seq, self._time.extend(line), counts)

    def give_up(self) -> None:
        """Wait for the device no longer."""
        port = self._port
        if port is not None:
            port.give_up()

    def close(self) -> None:
        """Give the port back."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def describe(self) -> Mapping[str, str]:
        """Port and line speed."""
        return {
            'source': f'text lines on {self.name}, {self._baud} baud',
            'sample numbers': 'of the device',
            'sample times': 'of the device',
        }
