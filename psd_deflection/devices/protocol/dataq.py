# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Commands, replies and scans of DATAQ DI-1100/1110/2108/4108 converters; no I/O.

Theory of operation. Commands are ASCII and end with a carriage return. While the device is not
scanning, it echoes each with its answer (except ``start``). A scan is the scan list's channels in
order, each a little-endian int16 over the channel's range, without framing, number or time. So one
lost byte would shift everything after it unnoticed. As a marker, the counter channel is the last in
the list. With nothing wired to its input and reset to zero it reads the constant 0x8000 (offset
binary), which an analog channel shows only at its negative rail. If the marker is not in its place,
the decoder has lost the scan boundary. It then looks for the offset at which three scans in a row
end with the marker.

The loss of whole scans cannot be detected, because the device does not number them.

Sources: DATAQ Instruments, "Data Acquisition Instrument Command Protocol"; the vendor's public
example programs for the DI-1110 (counter offset) and drivers of others (reply padding with zeros;
``stop`` and ``encode`` take about a second on a DI-4108).
"""

import math
import struct
from collections.abc import Sequence
from typing import NamedTuple

from psd_deflection.devices.protocol.frames import BadFrame

CLOCK_HZ = 60_000_000
"""Scan rate = CLOCK_HZ / (srate * dec), counted in scans or in conversions: devices differ, see ``plan_rate``."""

VOLTS_PER_COUNT = 10.0 / 32768.0
"""On the +-10 V range (code 0 of the scan list word, the only one all models have)."""

COUNTER = 10
"""Function code of the counter channel in a scan list word (bits 3..0)."""

MARKER = b'\x00\x80'
"""The counter at zero."""

ANALOG = 6
SCAN = struct.Struct('<6h')
STRIDE = SCAN.size + len(MARKER)
LOOK = 4 * STRIDE
"""Bytes needed to find the scan boundary: three whole scans from any offset."""


class Model(NamedTuple):
    """``analog`` inputs; ``counter``: has a counter for the marker; ``decimates``: knows ``dec``; least ``srate``."""

    analog: int
    counter: bool
    decimates: bool
    srate_min: int


MODELS: dict[str, Model] = {
    '1100': Model(4, False, False, 1500),
    '1110': Model(8, True, False, 375),
    '1120': Model(4, True, False, 375),
    '2108': Model(8, True, True, 375),
    '4108': Model(8, True, True, 375),
}
"""By the answer to ``info 1``. The least ``srate`` gives the highest rate of the data sheet."""

SRATE_MAX = 65_535
DEC_MAX = 512


class Rate(NamedTuple):
    """``srate`` and ``dec`` to send, and the resulting scans per second."""

    srate: int
    dec: int
    hz: float


def plan_rate(wanted_hz: float, model: Model, per_channel: bool) -> Rate | None:
    """The setting nearest to ``wanted_hz`` scans a second; None if the model cannot do it.

    ``per_channel``: CLOCK_HZ / (srate * dec) counts conversions per second, not scans. The vendor's
    documents disagree on this for devices with one clock and eight inputs, so the source measures
    it.
    """
    ticks = CLOCK_HZ / wanted_hz / (ANALOG + 1 if per_channel else 1)
    dec = math.ceil(ticks / SRATE_MAX)
    if dec > (DEC_MAX if model.decimates else 1):
        return None
    srate = round(ticks / dec)
    if not model.srate_min <= srate <= SRATE_MAX:
        return None
    hz = CLOCK_HZ / (srate * dec)
    return Rate(srate, dec, hz / (ANALOG + 1) if per_channel else hz)


def command(text: str) -> bytes:
    """One command as bytes."""
    return text.encode('ascii') + b'\r'


def scan_list(inputs: Sequence[int]) -> list[str]:
    """The commands that lay out one scan: the six inputs (0-based) on +-10 V, then the marker."""
    words = [*inputs, COUNTER]
    return [f'slist {position} {word}' for position, word in enumerate(words)]


def find_reply(received: bytes, asked: str) -> str | None:
    """The text after the echo of ``asked`` in ``received``: '' for a bare echo, None if there is no echo yet.

    A reply ends with a carriage return, and zeros may pad it. Scans that were still in transit may
    come before the echo.
    """
    complete, _, _ = received.rpartition(b'\r')
    for line in reversed(complete.replace(b'\x00', b'').split(b'\r')):
        text = line.decode('ascii', 'replace').strip()
        at = text.rfind(asked)
        if at >= 0:
            rest = text[at + len(asked) :]
            if not rest or rest.startswith(' '):
                return rest.strip()
    return None


class ScanDecoder:
    """Cuts the stream into scans by the marker; the result does not depend on how the stream was split."""

    def __init__(self) -> None:
        self._rest = b''
        self._in_step = True

    def feed(self, received: bytes) -> list[tuple[int, ...] | BadFrame]:
        """Scans (x1, y1, sum1, x2, y2, sum2 counts), and a BadFrame for bytes that belong to no scan."""
        stream = self._rest + received
        out: list[tuple[int, ...] | BadFrame] = []
        at, end = 0, len(stream)
        while True:
            if self._in_step:
                if end - at < STRIDE:
                    break
                if stream[at + SCAN.size : at + STRIDE] == MARKER:
                    out.append(SCAN.unpack_from(stream, at))
                    at += STRIDE
                    continue
            if end - at < LOOK:
                break
            skip = _step(stream, at)
            self._in_step = skip is not None
            skip = STRIDE if skip is None else skip
            out.append(BadFrame('out of step with the marker', skip))
            at += skip
        self._rest = stream[at:]
        return out


def _step(stream: bytes, at: int) -> int | None:
    """Number of bytes to skip until three scans in a row end with the marker."""
    for skip in range(1, STRIDE + 1):
        first = at + skip + SCAN.size
        if all(stream[first + k * STRIDE : first + k * STRIDE + 2] == MARKER for k in range(3)):
            return skip
    return None
