"""Devices that speak our own frames (``docs/protocol.md``): firmware of ours, the simulated rig.

They number their samples and have a clock, so nothing is lost unseen and times are regressed from
the device's own.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

from psd_deflection.config import Rig
from psd_deflection.devices.finding import candidates, is_pattern, matching
from psd_deflection.devices.serial_port import SerialPort
from psd_deflection.devices.source import REOPEN_S, Event, Reading, Source
from psd_deflection.errors import DeviceError
from psd_deflection.protocol.frames import (
    BadFrame,
    FrameDecoder,
    HelloFrame,
    HelloRequestFrame,
    PingFrame,
    StartFrame,
    encode,
)

# The zero ends whatever the device may have heard half of.
_WAKE = b'\x00' + encode(HelloRequestFrame()) + encode(StartFrame())
_NOTHING: list[Event] = []

SCAN_S = 0.25
"""How long a port is heard out on which the device may be or not: it answers within milliseconds."""


class ContractFrames(Source):
    """``source: serial``."""

    def __init__(self, rig: Rig) -> None:
        self.name = rig.acquisition.port
        self._wanted = rig.acquisition.serial_number
        self._given = rig.acquisition.port
        self._baud = rig.acquisition.baud
        self._port: SerialPort | None = None
        self._decoder = FrameDecoder()
        self._early: list[Event] = []
        self._next_candidate = 0

    def open(self, timeout: float) -> HelloFrame:
        """Open the port and wait for a HELLO; of a pattern, the first port on which the device answers."""
        if not is_pattern(self._given):
            return self._open(self._given, timeout)
        ports = matching(self._given)
        if not ports:
            raise DeviceError(
                f'{self._given}: no port of such a name is there; `psd-deflection devices` lists those that are'
            )
        refusals = []
        for name in ports:
            try:
                return self._open(name, timeout / len(ports))
            except DeviceError as error:
                refusals.append(str(error))
        raise DeviceError('; '.join(refusals))

    def _open(self, name: str, timeout: float) -> HelloFrame:
        """Open ``name`` and hear it out; what comes before its HELLO is the first that is read."""
        self.name = name
        port = self._port = SerialPort(name, self._baud)
        self._early = []
        try:
            port.write(_WAKE)
            decoder = self._decoder = FrameDecoder()
            received = frames = 0
            deadline = time.monotonic() + timeout
            while (left := deadline - time.monotonic()) > 0:
                piece = port.read(left)
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
                f'{self.name}: {received} bytes but no frame in {timeout:g} s; is the baud rate '
                f'({self._baud}) right, and is this the PSD device? (`psd-deflection devices` tells what answers)'
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
        """Forget what came while the device was heard out: it is older than it would look."""
        self._decoder = FrameDecoder()
        self._early = []
        if self._port is not None:
            self._port.discard_input()

    def reopen(self) -> HelloFrame | None:
        """Try the port that it had, then one of those on which it may be now; another each time."""
        name = self.name
        try:
            return self._open(name, REOPEN_S)
        except DeviceError:
            others = [c for c in candidates(self._given, self._wanted) if c != name]
            if not others:
                raise
            self._next_candidate = (self._next_candidate + 1) % len(others)
            try:
                return self._open(others[self._next_candidate], SCAN_S)
            except DeviceError:
                # Not ours: the port that it had stays the one to ask first.
                self.name = name
                raise

    def read(self, timeout: float) -> Reading:
        """The frames that have come."""
        if self._port is None:
            raise DeviceError(f'{self.name}: not open')
        if self._early:
            events, self._early = self._early, []
            return Reading(events, time.monotonic_ns(), 1)
        received = self._port.read(timeout)
        now = time.monotonic_ns()
        if not received:
            return Reading(_NOTHING, now, 0)
        frames: list[Event] = self._decoder.feed(received)  # type: ignore[assignment]
        return Reading(frames, now, len(received))

    def ping(self, cookie: int) -> bool:
        """Send PING."""
        if self._port is None:
            return False
        self._port.write(encode(PingFrame(cookie)))
        return True

    def wake(self) -> None:
        """Ask for a HELLO and for samples once more."""
        if self._port is not None:
            self._port.write(_WAKE)

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
            'source': f'contract frames on {self.name}, {self._baud} baud',
            'sample numbers': 'of the device',
            'sample times': 'of the device',
        }
