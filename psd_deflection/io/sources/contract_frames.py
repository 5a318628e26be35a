"""Devices that speak our own frames (``docs/protocol.md``): firmware of ours, the simulated rig.

They number their samples and have a clock, so nothing is lost unseen and times are regressed from
the device's own.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

from psd_deflection.config import Rig
from psd_deflection.errors import DeviceError
from psd_deflection.io.serial_port import SerialPort
from psd_deflection.io.sources._interface import Event, Reading, Source
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


class ContractFrames(Source):
    """``source: serial``."""

    def __init__(self, rig: Rig) -> None:
        self.name = rig.acquisition.port
        self._baud = rig.acquisition.baud
        self._port: SerialPort | None = None
        self._decoder = FrameDecoder()

    def open(self, timeout: float) -> HelloFrame:
        """Open the port and wait for a HELLO."""
        port = self._port = SerialPort(self.name, self._baud)
        try:
            port.write(_WAKE)
            decoder = FrameDecoder()
            received = frames = 0
            deadline = time.monotonic() + timeout
            while (left := deadline - time.monotonic()) > 0:
                piece = port.read(left)
                received += len(piece)
                for frame in decoder.feed(piece):
                    frames += not isinstance(frame, BadFrame)
                    if isinstance(frame, HelloFrame):
                        return frame
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

    def start(self) -> None:
        """Forget what came while the device was heard out: it is older than it would look."""
        self._decoder = FrameDecoder()
        if self._port is not None:
            self._port.discard_input()

    def reopen(self) -> HelloFrame | None:
        """Open the port; the HELLO comes among the frames, so that no sample waits for it."""
        port = SerialPort(self.name, self._baud)
        port.write(_WAKE)
        self._port, self._decoder = port, FrameDecoder()
        return None

    def read(self, timeout: float) -> Reading:
        """The frames that have come."""
        if self._port is None:
            raise DeviceError(f'{self.name}: not open')
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
