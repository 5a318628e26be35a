# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Encodes and decodes the serial frames of protocol version 1 (``docs/protocol.md``).

Theory of operation. A frame on the wire is ``COBS(type u8 | body | crc32 u32) 00``, little-endian,
at most 512 bytes encoded, CRC-32 (zlib's) over type and body. COBS leaves no zero byte inside, so a
zero byte always ends a frame. A receiver that joins late or receives garbage resynchronises at the
next zero byte. The decoder accepts bytes however they were split and returns values. Malformed
frames become a :class:`BadFrame` with the reason, never an exception, because input from outside
may contain anything.
"""

import json
import struct
import zlib
from collections.abc import Mapping
from enum import IntEnum, StrEnum
from typing import NamedTuple

from psd_deflection.devices.protocol.words import device_words
from psd_deflection.records import MOST_PSDS

_MOST = 254
"""Bytes behind one code."""
_CODES = [bytes((n + 1,)) for n in range(_MOST + 1)]
"""By the number of bytes behind it."""


def cobs_encode(payload: bytes) -> bytes:
    """``payload`` without zeros: one byte longer, and one more for each 254 bytes without a zero.

    Source: S. Cheshire, M. Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions on
    Networking 7 (2), 1999. A code byte n stands before n - 1 bytes that are not zero; behind them
    belongs a zero, unless n is 255 or nothing follows.
    """
    parts = payload.split(b'\0')
    if len(payload) >= _MOST:
        last = len(parts) - 1
        parts = [
            block
            for n, part in enumerate(parts)
            for block in [part[at : at + _MOST] for at in range(0, len(part) + 1, _MOST)]
            if block or n < last or not part
        ]
    return b''.join([_CODES[len(part)] + part for part in parts])


def cobs_decode(encoded: bytes) -> bytes:
    """What was encoded, without the zero that ends the frame. Raises ValueError if ``encoded`` is not COBS."""
    if 0 in encoded:
        raise ValueError('not COBS: a zero inside')
    out = bytearray(encoded)
    at, size = 0, len(out)
    if size <= _MOST:
        # In their place: each code becomes the zero that belongs before the next code.
        while at < size:
            code = out[at]
            out[at] = 0
            at += code
        plain = bytes(out[1:])
    else:
        blocks = []
        while at < size:
            code = encoded[at]
            blocks.append(encoded[at + 1 : at + code] + (b'' if code > _MOST or at + code >= size else b'\0'))
            at += code
        plain = b''.join(blocks)
    if at != size:
        raise ValueError('not COBS: a code points behind the end')
    return plain


PROTOCOL_VERSION = 1
MAX_ENCODED = 512
"""Longest encoded frame, without the closing zero."""

NO_TEMPERATURE = 32767
"""STATUS temperature of a device that has no thermometer."""


class FrameType(IntEnum):
    """First byte of a frame."""

    SAMPLE = 0x01
    STATUS = 0x02
    WIDE_SAMPLE = 0x03
    HELLO = 0x10
    HELLO_REQUEST = 0x11
    PING = 0x12
    PONG = 0x13
    START = 0x14
    STOP = 0x15


class BadReason(StrEnum):
    """Why the bytes between two zero bytes are not a valid frame."""

    COBS = 'not COBS'
    TOO_SHORT = 'shorter than type and CRC'
    TOO_LONG = 'longer than 512 bytes'
    CRC = 'CRC differs'
    LENGTH = 'length does not fit the type'
    BODY = 'body does not fit the type'
    UNKNOWN_TYPE = 'unknown type'


class SampleFrame(NamedTuple):
    """SAMPLE and WIDE SAMPLE: ``counts`` are x1 y1 sum1 x2 y2 sum2 ...; ``t_device_us`` microseconds of device time."""

    flags: int
    seq: int
    t_device_us: int
    counts: tuple[int, ...]


class StatusFrame(NamedTuple):
    """STATUS: samples the device dropped since power-up; temperature in 0.01 degrees C, or None."""

    overruns: int
    temperature_centi: int | None


class HelloFrame(NamedTuple):
    """HELLO: protocol version, and the device's description of itself (empty for another version).

    ``info`` of a decoded frame holds printable texts and finite numbers only (``devices.protocol.words``).
    """

    version: int
    info: dict[str, object]


class HelloRequestFrame(NamedTuple):
    """HELLO?: the host asks for a HELLO."""


class PingFrame(NamedTuple):
    """PING: the host asks the device for its time."""

    cookie: int


class PongFrame(NamedTuple):
    """PONG: the device's time when it saw the PING with this cookie."""

    cookie: int
    t_device_us: int


class StartFrame(NamedTuple):
    """START: stream samples."""


class StopFrame(NamedTuple):
    """STOP: stop streaming samples."""


class BadFrame(NamedTuple):
    """Bytes that are not a valid frame: ``size`` encoded bytes before the closing zero.

    ``reason``: a :class:`BadReason` here; other protocols have their own reasons.
    """

    reason: str
    size: int


GoodFrame = SampleFrame | StatusFrame | HelloFrame | HelloRequestFrame | PingFrame | PongFrame | StartFrame | StopFrame
Frame = GoodFrame | BadFrame

_EMPTY: dict[int, GoodFrame] = {
    FrameType.HELLO_REQUEST: HelloRequestFrame(),
    FrameType.START: StartFrame(),
    FrameType.STOP: StopFrame(),
}
MAX_DEVICE_US = 1 << 53
"""285 years: a later device time is not plausible and would overflow the host's nanoseconds."""

_SAMPLES = {
    kind: {n: struct.Struct(f'<BBIQ{3 * n}{of}') for n in range(2, MOST_PSDS + 1)}
    for kind, of in ((FrameType.SAMPLE, 'h'), (FrameType.WIDE_SAMPLE, 'i'))
}
"""By the number of PSDs."""
_STATUS = struct.Struct('<BIh')
_PING = struct.Struct('<BQ')
_PONG = struct.Struct('<BQQ')
_CRC = struct.Struct('<I')
_RESIDUE = 0x2144DF1C
"""CRC-32 of anything with its own CRC-32 behind it, little-endian."""


def _seal(payload: bytes) -> bytes:
    return cobs_encode(payload + _CRC.pack(zlib.crc32(payload))) + b'\x00'


def encode(frame: GoodFrame, *, wide: bool = False) -> bytes:
    """The bytes of one frame, closing zero included. ``wide``: a sample goes as WIDE SAMPLE, with 32 bits a count.

    Raises ValueError if a field does not fit or a HELLO is longer than 512 bytes encoded.
    """
    try:
        match frame:
            case SampleFrame(flags, seq, t_device_us, counts):
                kind = FrameType.WIDE_SAMPLE if wide else FrameType.SAMPLE
                layout = _SAMPLES[kind].get(len(counts) // 3)
                if layout is None:
                    raise ValueError(f'{len(counts)} counts: a sample has three of each of 2 to {MOST_PSDS} PSDs')
                return _seal(layout.pack(kind, flags, seq, t_device_us, *counts))
            case StatusFrame(overruns, temperature):
                value = NO_TEMPERATURE if temperature is None else temperature
                return _seal(_STATUS.pack(FrameType.STATUS, overruns, value))
            case HelloFrame(version, info):
                body = json.dumps(info, separators=(',', ':')).encode()
                sealed = _seal(bytes((FrameType.HELLO, version)) + body)
                if len(sealed) > MAX_ENCODED + 1:
                    raise ValueError(f'HELLO is {len(sealed) - 1} bytes encoded, at most {MAX_ENCODED}')
                return sealed
            case HelloRequestFrame():
                return _seal(bytes((FrameType.HELLO_REQUEST,)))
            case PingFrame(cookie):
                return _seal(_PING.pack(FrameType.PING, cookie))
            case PongFrame(cookie, t_device_us):
                return _seal(_PONG.pack(FrameType.PONG, cookie, t_device_us))
            case StartFrame():
                return _seal(bytes((FrameType.START,)))
            case StopFrame():
                return _seal(bytes((FrameType.STOP,)))
    except struct.error as error:
        raise ValueError(f'{frame!r}: {error}') from None


def _parse(payload: bytes, size: int, samples: Mapping[int, struct.Struct]) -> Frame:
    """``payload``: type, body and CRC, COBS decoded; ``size``: encoded size; ``samples``: layouts by the type."""
    if len(payload) < 5:
        return BadFrame(BadReason.TOO_SHORT, size)
    if zlib.crc32(payload) != _RESIDUE:
        return BadFrame(BadReason.CRC, size)
    kind = payload[0]
    layout = samples.get(kind)
    if layout is not None:
        if len(payload) != layout.size + _CRC.size:
            return BadFrame(BadReason.LENGTH, size)
        fields = layout.unpack_from(payload)
        if fields[3] > MAX_DEVICE_US:
            return BadFrame(BadReason.BODY, size)
        return SampleFrame(fields[1], fields[2], fields[3], fields[4:])
    body = payload[: -_CRC.size]
    if kind == FrameType.STATUS:
        if len(body) != _STATUS.size:
            return BadFrame(BadReason.LENGTH, size)
        _, overruns, temperature = _STATUS.unpack(body)
        return StatusFrame(overruns, None if temperature == NO_TEMPERATURE else temperature)
    if kind == FrameType.HELLO:
        return _parse_hello(body, size)
    if kind == FrameType.PONG:
        return PongFrame(*_PONG.unpack(body)[1:]) if len(body) == _PONG.size else BadFrame(BadReason.LENGTH, size)
    if kind == FrameType.PING:
        return PingFrame(*_PING.unpack(body)[1:]) if len(body) == _PING.size else BadFrame(BadReason.LENGTH, size)
    empty = _EMPTY.get(kind)
    if empty is None:
        return BadFrame(BadReason.UNKNOWN_TYPE, size)
    return empty if len(body) == 1 else BadFrame(BadReason.LENGTH, size)


def _parse_hello(body: bytes, size: int) -> Frame:
    if len(body) < 2:
        return BadFrame(BadReason.LENGTH, size)
    version = body[1]
    if version != PROTOCOL_VERSION:
        # The body of another version is unknown; report the version only.
        return HelloFrame(version, {})
    try:
        info = json.loads(body[2:].decode('utf-8'))
    except (ValueError, RecursionError):
        return BadFrame(BadReason.BODY, size)
    if not isinstance(info, dict):
        return BadFrame(BadReason.BODY, size)
    return HelloFrame(version, device_words(info))


class FrameDecoder:
    """Cuts a stream at its zeros; holds at most one unfinished frame of ``MAX_ENCODED`` bytes.

    The result does not depend on how the stream was split. The bytes before the first zero may be
    the end of a frame that began before the port was opened. If they are not a valid frame, they
    are ignored without a :class:`BadFrame`. ``psds``: PSDs that a sample has; one with others is a BadFrame.
    """

    def __init__(self, psds: int = 2) -> None:
        self._samples = {int(kind): layouts[psds] for kind, layouts in _SAMPLES.items()}
        self._rest = b''
        self._dropped = 0
        self._in_step = False

    def feed(self, received: bytes) -> list[Frame]:
        """The frames that end in ``received``, in order."""
        pieces = received.split(b'\x00')
        self._keep(pieces[0])
        if len(pieces) == 1:
            return []
        frames: list[Frame] = []
        if self._rest or self._dropped:
            first = self._decoded(self._rest) if self._rest else BadFrame(BadReason.TOO_LONG, self._dropped)
            if self._in_step or not isinstance(first, BadFrame):
                frames.append(first)
        frames += [self._decoded(piece) for piece in pieces[1:-1] if piece]
        self._rest, self._dropped, self._in_step = b'', 0, True
        self._keep(pieces[-1])
        return frames

    def _keep(self, more: bytes) -> None:
        if self._dropped:
            self._dropped += len(more)
            return
        self._rest = self._rest + more if self._rest else more
        if len(self._rest) > MAX_ENCODED:
            self._dropped, self._rest = len(self._rest), b''

    def _decoded(self, encoded: bytes) -> Frame:
        """What the bytes between two zeros are."""
        size = len(encoded)
        if size > MAX_ENCODED:
            return BadFrame(BadReason.TOO_LONG, size)
        try:
            payload = cobs_decode(encoded)
        except ValueError:
            return BadFrame(BadReason.COBS, size)
        return _parse(payload, size, self._samples)
