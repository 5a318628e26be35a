# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Devices that speak our own frames (``docs/protocol.md``): firmware of ours, the simulated rig.

They number their samples and have a clock. So every loss is detected, and times are regressed from the
device's own clock.
"""

from __future__ import annotations

import glob
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from serial.tools import list_ports

from psd_deflection import __version__
from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.device import (
    OUTPUT_LIMIT,
    PROTOCOL_BITS,
    Answer,
    Device,
    PowerUp,
    Probe,
    converter_parameters,
    described,
    psds_of,
)
from psd_deflection.devices.port import network_address
from psd_deflection.devices.port_source import PortSource
from psd_deflection.devices.protocol.frames import (
    PROTOCOL_VERSION,
    BadFrame,
    FrameDecoder,
    HelloFrame,
    HelloRequestFrame,
    PingFrame,
    PongFrame,
    SampleFrame,
    StartFrame,
    StatusFrame,
    StopFrame,
    encode,
)
from psd_deflection.devices.source import REOPEN_S, Event, Received
from psd_deflection.devices.udp_port import Datagrams, Validator
from psd_deflection.records import FLAG_DEVICE_DROPPED, FLAG_OVER_RANGE, MOST_PSDS, channel_names
from psd_deflection.rig.config import Rig

if TYPE_CHECKING:
    from psd_deflection.devices.rig_feed import RigFeed


MAX_PORTS = 64


def is_pattern(port: str) -> bool:
    """Whether ``port`` is a pattern, which may match several ports."""
    # [::1] is no pattern.
    return network_address(port) is None and glob.has_magic(port)


def matching(pattern: str) -> list[str]:
    """The ports that match the pattern now."""
    return sorted(glob.glob(pattern))[:MAX_PORTS]  # noqa: PTH207 - the pattern is a whole path


def candidate_ports(port: str, wanted_serial: str) -> list[str]:
    """Other ports where the device may have come back, the likeliest first.

    A port whose USB descriptor has ``wanted_serial`` goes first. A port of the network is one place.

    ``port`` may be a pattern (``/dev/ttyACM*``). Otherwise every USB serial port of the machine is a candidate,
    besides the named port. A device is recognised by the serial number that it reports, never by the port's name.
    """
    if network_address(port) is not None:
        return []
    if is_pattern(port):
        return matching(port)
    ports = [p for p in list_ports.comports() if p.vid is not None and p.device != port]
    ports.sort(key=lambda p: (p.serial_number != wanted_serial, p.device))
    return [p.device for p in ports[:MAX_PORTS]]


# The zero byte ends any frame that the device has received in part.
_QUESTION = b'\x00' + encode(HelloRequestFrame())
_WAKE = _QUESTION + encode(StartFrame())

SCAN_S = 0.25
"""How long to listen on a port that may not be the device's: the device answers within milliseconds."""


class ContractFrames(PortSource):
    """``source: serial``."""

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig.acquisition.port)
        self._wanted = rig.acquisition.serial_number
        self._given = rig.acquisition.port
        self._baud = rig.acquisition.baud
        self._psds = len(rig.psds)
        self.datagrams = Datagrams(self._validator)
        self._decoder = FrameDecoder(self._psds)
        self._early: list[Event] = []  # Bound: what comes before START is answered, in 2 s.
        self._next_candidate = 0

    def _validator(self) -> Validator:
        """Whether a sender of datagrams speaks our frames."""
        decoder = FrameDecoder(self._psds)
        return lambda piece: any(not isinstance(frame, BadFrame) for frame in decoder.feed(piece))

    def open(self, timeout: float) -> HelloFrame:
        """Open the port and wait for a HELLO; of a pattern, the first port on which the device answers."""
        if not is_pattern(self._given):
            return self._open(self._given, timeout)
        ports = matching(self._given)
        if not ports:
            raise DeviceError(
                f'{self._given}: no port of such a name is there; `psd-deflection devices` lists those that are'
            )
        rejections = []
        for name in ports:
            try:
                return self._open(name, timeout / len(ports))
            except DeviceError as error:
                rejections.append(str(error))
        raise DeviceError('; '.join(rejections))

    def _open(self, name: str, timeout: float) -> HelloFrame:
        """Open ``name`` and wait for its HELLO; the first read returns the frames that came before it."""
        self.name = name
        port = self.open_port(self._baud)
        self._early = []
        try:
            port.write(_WAKE)
            decoder = self._decoder = FrameDecoder(self._psds)
            received = frames = 0
            deadline = time.monotonic() + timeout
            while (remaining := deadline - time.monotonic()) > 0:
                piece = port.read(remaining)
                received += len(piece)
                hello: HelloFrame | None = None
                for frame in decoder.feed(piece):
                    frames += not isinstance(frame, BadFrame)
                    self._early.append(frame)
                    if isinstance(frame, HelloFrame):
                        hello = frame
                if hello is not None:
                    self._check_serial(hello)
                    return hello
        except BaseException:
            self.close()
            raise
        self.close()
        if frames:
            raise DeviceError(f'{self.name}: samples come but no HELLO in {timeout:g} s; does the firmware send it?')
        if received:
            raise DeviceError(
                f'{self.name}: {received} bytes but no frame in {timeout:g} s; {self._is_speed_right(self._baud)}, '
                'and is this the PSD device? (`psd-deflection devices` tells what answers)'
            )
        raise DeviceError(f'{self.name}: no frame in {timeout:g} s; is the device powered and this its port?')

    def _check_serial(self, hello: HelloFrame) -> None:
        serial = str(hello.info.get('serial', ''))
        if self._wanted and serial != self._wanted:
            raise DeviceError(
                f'{self.name}: another device answers there, serial number {serial!r} and not {self._wanted!r}'
            )
        self._wanted = serial

    def start(self) -> None:
        """Discard the samples that came before the HELLO: they are older than their time of reading."""
        self._decoder = FrameDecoder(self._psds)
        self._early = []
        if self._port is not None:
            self._port.discard_input()

    def reopen(self) -> HelloFrame | None:
        """Try the port that the device had, then one other port where it may be now; a different one each time."""
        name = self.name
        try:
            return self._open(name, REOPEN_S)
        except DeviceError:
            candidates = [c for c in candidate_ports(self._given, self._wanted) if c != name]
            if not candidates:
                raise
            self._next_candidate = (self._next_candidate + 1) % len(candidates)
            try:
                return self._open(candidates[self._next_candidate], SCAN_S)
            except DeviceError:
                # Not our device: keep trying its previous port first.
                self.name = name
                raise

    def read(self, timeout: float) -> Received:
        """Return the frames that have arrived."""
        port = self._opened()
        if self._early:
            events, self._early = self._early, []
            return Received(events, time.monotonic_ns(), 1)
        received = port.read(timeout)
        now = time.monotonic_ns()
        if not received:
            return Received(self._notices(), now, 0)
        return Received([*self._notices(), *self._decoder.feed(received)], now, len(received))

    def ping(self, cookie: int) -> bool:
        """Send PING."""
        if self._port is None:
            return False
        self._port.write(encode(PingFrame(cookie)))
        return True

    def wake(self) -> None:
        """Ask again for a HELLO and for samples."""
        if self._port is not None:
            self._port.write(_WAKE)

    def describe(self) -> Mapping[str, str]:
        """Port, its state, and line speed."""
        return {
            **self._describe_port('binary frames', self._baud),
            'sample numbers': 'of the device',
            'sample times': 'of the device',
        }


class SimulatedFrames:
    """A device that speaks our frames. If the host does not read, it drops samples, counts them (STATUS) and
    marks the next one (flags, bit 1), like firmware with a full buffer.

    ``lose``: numbers of samples to lose on the wire, for demonstrations and golden recordings.
    """

    def __init__(
        self,
        feed: RigFeed,
        power_up: PowerUp | None = None,
        *,
        serial: str = 'SIM-0001',
        lose: frozenset[int] = frozenset(),
    ) -> None:
        skew_ppm, self._first_seq = power_up or PowerUp()
        self._feed = feed
        self._rate = feed.rig.converter.sample_rate_hz
        self._bits = feed.rig.converter.bits
        self._period_device_us = 1e6 / self._rate
        self._period_host_ns = 1e9 / self._rate / (1.0 + skew_ppm * 1e-6)
        self._lose = lose
        self._decoder = FrameDecoder()
        self._streaming = True
        self._overruns = 0
        self._dropped = False
        self.hello = HelloFrame(
            PROTOCOL_VERSION,
            {
                'serial': serial,
                'firmware': f'psd_deflection simulated rig {__version__}',
                'sample_rate_hz': self._rate,
                'channels': list(channel_names(len(feed.rig.psds))),
                'volts_per_count': feed.rig.converter.volts_per_count,
                **described(feed.rig),
            },
        )

    def greeting(self) -> bytes:
        """Bytes sent when a host opens the port: the end of a frame that was sent in part, and HELLO."""
        return b'\x00' + encode(self.hello)

    @property
    def taken(self) -> int:
        """Samples taken since power-up."""
        return self._feed.taken

    def due_in_ns(self, since_power_up_ns: int) -> int:
        """Host nanoseconds until the next sample; 0 or less: it is due."""
        return int(self._feed.taken * self._period_host_ns) - since_power_up_ns

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        """Replies to the host's frames; other bytes are ignored."""
        replies = b''
        for frame in self._decoder.feed(received):
            match frame:
                case HelloRequestFrame():
                    replies += encode(self.hello)
                case PingFrame(cookie):
                    # The clock of the samples, which started with the first sample.
                    elapsed = (self._first_seq + since_power_up_ns / self._period_host_ns) * self._period_device_us
                    replies += encode(PongFrame(cookie, int(elapsed)))
                case StartFrame():
                    self._streaming = True
                case StopFrame():
                    self._streaming = False
                case _:
                    pass
        return replies

    def take(self, since_power_up_ns: int, room: int = OUTPUT_LIMIT) -> bytes:
        """Take every sample that is due; return the frames to send, at most about ``room`` bytes.

        If no room is left, a sample is taken and dropped.
        """
        out = bytearray()
        top, wide = 2 ** (self._bits - 1) - 1, self._bits > PROTOCOL_BITS
        while self.due_in_ns(since_power_up_ns) <= 0:
            number = self._feed.taken
            row = self._feed.next()
            seq = (self._first_seq + number) % (1 << 32)
            if len(out) >= room:
                self._overruns += 1
                self._dropped = True
            elif self._streaming and number not in self._lose:
                over = max(row) == top or min(row) == -top - 1
                flags = (FLAG_OVER_RANGE if over else 0) | (FLAG_DEVICE_DROPPED if self._dropped else 0)
                self._dropped = False
                t_us = round((self._first_seq + number) * self._period_device_us)
                out += encode(SampleFrame(flags, seq, t_us, tuple(row)), wide=wide)
            if number % round(self._rate) == 0 and len(out) < room:
                out += encode(self.hello) + encode(StatusFrame(self._overruns, 2150))
        return bytes(out)


class FramesProbe:
    """Recognises a HELLO. ``baud``: the speed at which it listens, suggested as a parameter."""

    def __init__(self, baud: int) -> None:
        self.promising = False
        self._baud = baud
        self._decoder = FrameDecoder()

    def feed(self, piece: bytes) -> Answer | None:
        """What the HELLO says."""
        for frame in self._decoder.feed(piece):
            if isinstance(frame, HelloFrame):
                info = frame.info
                who = f'PSD device {info.get("serial", "?")}, firmware {info.get("firmware", "?")}'
                psds = psds_of(info)
                who += '' if psds == 2 else f', {psds} PSDs'
                return Answer(f'{who}, protocol {frame.version}', {'baud': self._baud, **converter_parameters(info)})
            self.promising = self.promising or isinstance(frame, SampleFrame)
        return None


def _simulate(feed: RigFeed, power_up: PowerUp) -> Sequence[SimulatedFrames]:
    return [SimulatedFrames(feed, power_up)]


DEVICE = Device(
    'serial',
    'our own frames: firmware of ours, the simulated rig',
    ContractFrames,
    _simulate,
    Probe(FramesProbe, _QUESTION, baud=921_600),
    MOST_PSDS,
)
