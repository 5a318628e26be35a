# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Devices that send one line of text per sample, such as an Arduino: numbered and timed by the device. Without the
checksum a corrupted digit goes unnoticed; 115200 baud carry about 250 lines a second."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from psd_deflection import __version__
from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.device import (
    OUTPUT_LIMIT,
    Answer,
    Device,
    PowerUp,
    Probe,
    converter_parameters,
    described,
    psds_of,
)
from psd_deflection.devices.port_source import PortSource
from psd_deflection.devices.protocol.frames import PROTOCOL_VERSION, BadFrame, HelloFrame
from psd_deflection.devices.protocol.text_lines import (
    ELECTRODES,
    MAX_VOLTS,
    READINGS,
    Description,
    Line,
    LineDecoder,
    TimeExtender,
    positive,
    with_check,
)
from psd_deflection.devices.source import Event, Received, Sample
from psd_deflection.devices.udp_port import Datagrams, Validator
from psd_deflection.model.detector import VoltsToDots
from psd_deflection.records import FLAG_OVER_RANGE, MOST_PSDS, channel_names
from psd_deflection.rig.config import Rig

if TYPE_CHECKING:
    from psd_deflection.devices.rig_feed import RigFeed

BOOT_S = 4.0
"""An Arduino restarts when its port is opened, and its boot loader takes two seconds."""


def _validator() -> Validator:
    """Whether a sender of datagrams speaks text lines."""
    decoder = LineDecoder()
    return lambda piece: any(not isinstance(item, BadFrame) for item in decoder.feed(piece))


class TextLines(PortSource):
    """``source: lines``."""

    # A line without a check that was put together of two datagrams may be of two lines, and nobody would see it.
    datagrams = Datagrams(_validator, end=b'\n')

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig.acquisition.port)
        self._rig = rig
        self._baud = rig.acquisition.baud
        self._electrodes: VoltsToDots | None = None
        self._scale: float | None = None
        self._decoder = LineDecoder()
        self._time = TimeExtender()
        self.volts = True
        self._top = 2 ** (rig.converter.bits - 1) - 1
        self._bits = rig.converter.bits
        self._psds = len(rig.psds)

    def open(self, timeout: float) -> HelloFrame:
        """Open the port and wait for the line that describes the device."""
        port = self.open_port(self._baud)
        timeout = max(timeout, BOOT_S)
        lines = received = 0
        try:
            decoder = LineDecoder()
            deadline = time.monotonic() + timeout
            while (remaining := deadline - time.monotonic()) > 0:
                piece = port.read(remaining)
                received += len(piece)
                for item in decoder.feed(piece):
                    lines += isinstance(item, Line)
                    if isinstance(item, Description) and 'sample_rate_hz' in item.info:
                        self._describe(item.info)
                        return self._hello(item.info)
        except BaseException:
            self.close()
            raise
        self.close()
        if lines:
            why = 'samples come but no line that describes them: # {"sample_rate_hz": 200}'
        elif received:
            why = f'{received} bytes but no line of ours; {self._is_speed_right(self._baud)}?'
        else:
            why = 'nothing comes; does the sketch run, and is this its port?'
        raise DeviceError(f'{self.name}: {why} (waited {timeout:g} s)')

    def start(self) -> None:
        """Discard the lines that came before the description."""
        self._decoder = LineDecoder()
        if self._port is not None:
            self._port.discard_input()

    def read(self, timeout: float) -> Received:
        """Return the lines that have arrived."""
        received = self._opened().read(timeout)
        now = time.monotonic_ns()
        events: list[Event] = [*self._notices()]
        for item in self._decoder.feed(received) if received else ():
            if isinstance(item, Line):
                events.append(self._sample(item))
            elif isinstance(item, BadFrame):
                events.append(item)
            elif 'sample_rate_hz' in item.info:
                events.append(self._hello(item.info))
        return Received(events, now, len(received))

    def _hello(self, info: Mapping[str, object]) -> HelloFrame:
        """What the line that describes the device says."""
        psds = psds_of(info)
        fields: dict[str, object] = {
            'serial': str(info.get('serial', ''))[:64],
            'firmware': 'text lines',
            'channels': list(channel_names(self._psds if psds == self._psds else 2)),
            'volts_per_count': None,
        }
        # Only what is known is kept: the line is a stranger's and goes into recordings.
        known = ['firmware', 'sample_rate_hz', 'channels', 'bits', 'psds']
        if self._electrodes is None:
            # Otherwise what we hand on is volts.
            known.append('volts_per_count')
        return HelloFrame(PROTOCOL_VERSION, fields | {k: v for k, v in info.items() if k in known})

    def _describe(self, info: Mapping[str, object]) -> None:
        """What the first description says of the readings; it holds as long as the port is open."""
        self._scale = positive(info.get('volts_per_count'))
        electrodes = info.get('electrodes') is True
        self.volts = self._scale is None or electrodes
        self._electrodes = VoltsToDots.from_rig(self._rig) if electrodes else None

    def _sample(self, line: Line) -> Event:
        readings = line.readings
        wanted = self._psds * (READINGS if self._electrodes is None else ELECTRODES)
        if len(readings) != wanted:
            return BadFrame(f'{len(readings)} readings where the description says {wanted}', 0)
        if self._electrodes is not None:
            return self._of_electrodes(line, self._electrodes)
        if self.volts:
            if max(map(abs, readings)) > MAX_VOLTS:
                return BadFrame('a reading is out of all bounds', 0)
            return Sample(0, line.seq, self._time.extend(line), readings)
        top = self._top
        if not all(r.is_integer() and -top - 1 <= r <= top for r in readings):
            return BadFrame(f'counts are whole numbers of {self._bits} bits', 0)
        counts = tuple(int(r) for r in readings)
        return Sample(self._flags(readings), line.seq, self._time.extend(line), counts)

    def _of_electrodes(self, line: Line, calibration: VoltsToDots) -> Event:
        electrodes = np.array([line.readings]) * (self._scale or 1.0)
        if np.abs(electrodes).max() > MAX_VOLTS:
            return BadFrame('a reading is out of all bounds', 0)
        volts = tuple(calibration.volts_of_electrodes(electrodes)[0].tolist())
        return Sample(self._flags(line.readings) if self._scale else 0, line.seq, self._time.extend(line), volts)

    def _flags(self, counts: tuple[float, ...]) -> int:
        return FLAG_OVER_RANGE if max(counts) >= self._top or min(counts) <= -self._top - 1 else 0

    def describe(self) -> Mapping[str, str]:
        """Port, its state, and line speed."""
        return {
            **self._describe_port('text lines', self._baud),
            'sample numbers': 'of the device',
            'sample times': 'of the device',
        }


class SimulatedLines:
    """Sends from power-up, with checks; describes itself at power-up and once a second."""

    def __init__(self, feed: RigFeed, power_up: PowerUp | None = None) -> None:
        skew_ppm, self._first_seq = power_up or PowerUp()
        self._feed = feed
        self._rate = feed.rig.converter.sample_rate_hz
        self._period_host_ns = 1e9 / self._rate / (1.0 + skew_ppm * 1e-6)
        self._description = {
            'serial': 'SIM-LINES-1',
            'firmware': f'psd_deflection simulated lines {__version__}',
            'sample_rate_hz': self._rate,
            'volts_per_count': feed.rig.converter.volts_per_count,
            **described(feed.rig),
        }

    def greeting(self) -> bytes:
        """The end of a line that was sent in part, and the description."""
        return b'\n# ' + json.dumps(self._description).encode() + b'\n'

    def due_in_ns(self, since_power_up_ns: int) -> int:
        """Host nanoseconds until the next sample."""
        return int(self._feed.taken * self._period_host_ns) - since_power_up_ns

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        """It does not listen."""
        return b''

    def take(self, since_power_up_ns: int, room: int = OUTPUT_LIMIT) -> bytes:
        """The lines that are due. If no room is left they are lost; the sample numbers show the gap."""
        out = bytearray()
        while self.due_in_ns(since_power_up_ns) <= 0:
            number = self._feed.taken
            row = self._feed.next()
            if len(out) >= room:
                continue
            if number % round(self._rate) == 0:
                out += self.greeting()
            t_us = round((self._first_seq + number) * 1e6 / self._rate) % 2**32
            out += with_check(','.join(map(str, ((self._first_seq + number) % 2**32, t_us, *row))))
        return bytes(out)


class LinesProbe:
    """Recognises a line that describes the device. ``baud``: the speed at which it listens, to be suggested."""

    def __init__(self, baud: int) -> None:
        self.promising = False
        self._baud = baud
        self._decoder = LineDecoder()

    def feed(self, piece: bytes) -> Answer | None:
        """The device's answer from its description."""
        for item in self._decoder.feed(piece):
            if isinstance(item, Description) and 'sample_rate_hz' in item.info:
                psds = psds_of(item.info)
                who = f'text lines, {item.info.get("serial", "no serial number")}'
                return Answer(
                    who if psds == 2 else f'{who}, {psds} PSDs', {'baud': self._baud, **converter_parameters(item.info)}
                )
            self.promising = self.promising or isinstance(item, Line)
        return None


def _simulate(feed: RigFeed, power_up: PowerUp) -> Sequence[SimulatedLines]:
    return [SimulatedLines(feed, power_up)]


DEVICE = Device(
    'lines', 'a line of text a sample, as an Arduino sends it', TextLines, _simulate, Probe(LinesProbe), MOST_PSDS
)
