# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""APT messages of the quad detector in Thorlabs KPA101/TQD001 position aligners; no I/O.

Theory of operation. A message is a 6-byte header; a long message adds the data that the header
announces. There is no checksum and no end mark, so a receiver that lost a byte can only look for
the next plausible header. The device answers each request for its readings once.

Reading, little-endian: submessage u16 (3), x difference int16, y difference int16, sum u16, and the
two position outputs int16. The differences are +-10 V over the int16 range; the sum is taken as 0 to
10 V over the u16 range (drivers disagree about its scale: ``docs/devices/thorlabs.md``). The device
does not divide the differences by the sum: the place on the sensor is (L/2) x / sum.

Sources: Thorlabs, "APT Communications Protocol", quad control messages 0x0870 to 0x0881 and
MGMSG_HW_REQ_INFO; two open drivers for the scales and the sign of x.
"""

import struct
from typing import NamedTuple

from psd_deflection.devices.protocol.frames import BadFrame

HOST_ADDRESS, DEVICE_ADDRESS, LONG = 0x01, 0x50, 0x80
READINGS_REQUEST = bytes((0x71, 0x08, 0x03, 0x00, DEVICE_ADDRESS, HOST_ADDRESS))
INFO_REQUEST = bytes((0x05, 0x00, 0x00, 0x00, DEVICE_ADDRESS, HOST_ADDRESS))
READINGS_REPLY, INFO_REPLY = 0x0872, 0x0006
READINGS_SUBMESSAGE = 0x03

HEADER = struct.Struct('<HHBB')
READINGS = struct.Struct('<HhhHhh')
INFO = struct.Struct('<I8sH4s60sHHH')
MAX_DATA = 255

DIFFERENCE_VOLTS = 10.0 / 32767.0
SUM_VOLTS = 10.0 / 65535.0
FULL_SCALE = 10.0
"""Volts given for a dot at the edge of the active area."""

SUM_FLOOR = 0.05
"""V. Below this sum there is too little light to divide by."""


class QuadrantReadings(NamedTuple):
    """``x``, ``y``: 10 V at the edge of the active area, 0 if ``total`` is too low; ``total`` V."""

    x: float
    y: float
    total: float


class HardwareInfo(NamedTuple):
    """The device that answered."""

    serial: int
    model: str
    firmware: str


AptMessage = QuadrantReadings | HardwareInfo | BadFrame


def readings_of(x_difference: int, y_difference: int, total: int) -> QuadrantReadings:
    """Converts raw numbers to the volts of the rig's amplifier: x 10 V / sum.

    Without light the quotient would be noise, so x and y are then 0; the low sum shows the reason.
    """
    volts = total * SUM_VOLTS
    if volts < SUM_FLOOR:
        return QuadrantReadings(0.0, 0.0, volts)
    scale = DIFFERENCE_VOLTS * FULL_SCALE / volts
    return QuadrantReadings(x_difference * scale, y_difference * scale, volts)


def encode_readings(x_difference: int, y_difference: int, total: int) -> bytes:
    """The reply of a device (for the simulated one)."""
    body = READINGS.pack(READINGS_SUBMESSAGE, x_difference, y_difference, total, x_difference, y_difference)
    return HEADER.pack(READINGS_REPLY, len(body), HOST_ADDRESS | LONG, DEVICE_ADDRESS) + body


def encode_info(serial: int, model: str) -> bytes:
    """The hardware info of a device (for the simulated one)."""
    body = INFO.pack(serial, model.encode('ascii'), 16, bytes((0, 0, 1, 0)), b'simulated', 1, 0, 1)
    return HEADER.pack(INFO_REPLY, len(body), HOST_ADDRESS | LONG, DEVICE_ADDRESS) + body


class AptDecoder:
    """Decodes messages from a stream, however it was split; skips and counts invalid bytes."""

    def __init__(self) -> None:
        self._rest = b''
        self._skipped = 0

    def feed(self, received: bytes) -> list[AptMessage]:
        """The messages that end in ``received``."""
        out: list[AptMessage] = []
        stream, at = self._rest + received, 0
        while len(stream) - at >= HEADER.size:
            kind, length, destination, origin = HEADER.unpack_from(stream, at)
            long = bool(destination & LONG)
            if destination & ~LONG != HOST_ADDRESS or origin != DEVICE_ADDRESS or (long and length > MAX_DATA):
                at += 1
                self._skipped += 1
                continue
            size = HEADER.size + (length if long else 0)
            if len(stream) - at < size:
                break
            if self._skipped:
                out.append(BadFrame('no APT header', self._skipped))
                self._skipped = 0
            body = stream[at + HEADER.size : at + size]
            message = _parse(kind, body, size)
            if message is not None:
                out.append(message)
            at += size
        self._rest = stream[at:]
        return out

    def reset(self) -> int:
        """Discard an unfinished message; returns its number of bytes."""
        size = len(self._rest) + self._skipped
        self._rest, self._skipped = b'', 0
        return size


def _parse(kind: int, body: bytes, size: int) -> AptMessage | None:
    """None for a message of no interest here."""
    if kind == READINGS_REPLY:
        if len(body) != READINGS.size:
            return BadFrame('length does not fit the message', size)
        submessage, x, y, total, _, _ = READINGS.unpack(body)
        return readings_of(x, y, total) if submessage == READINGS_SUBMESSAGE else None
    if kind == INFO_REPLY:
        if len(body) != INFO.size:
            return BadFrame('length does not fit the message', size)
        serial, model, _, firmware, _, _, _, _ = INFO.unpack(body)
        text = model.rstrip(b'\x00 ').decode('ascii', 'replace')
        return HardwareInfo(serial, text, '.'.join(str(b) for b in firmware[2::-1]))
    return None
