# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Message field dicts to CDR (XCDR1, little-endian) and back, by coders made from the message definitions; headers and
numbers in one step."""

import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from operator import itemgetter
from typing import Any

from msg_adapters import MESSAGE_TYPES
from msg_adapters.message_type import Constant, MessageType

Encoder = Callable[[Mapping[str, Any]], bytes]
_Writer = Callable[[bytearray, Any], None]
_Reader = Callable[[bytes, int, str], tuple[Any, int]]
"""Reads a value: from the bytes behind the encapsulation, an offset and the byte order (< or >); gives the value and
the offset behind it."""

_ENCAPSULATION = b'\x00\x01\x00\x00'
LITTLE = b'\x00\x01'
FRAME_AT = 12
"""Offset of a header's frame: behind the encapsulation and the stamp."""
_STAMP = struct.Struct('<iI')
_U32 = struct.Struct('<I')
_U32_BIG = struct.Struct('>I')
_FLOAT64 = re.compile(r'float64(?:\[(\d+)\])?')
_ARRAY = re.compile(r'(.+)\[(\d*)\]')
_FORMATS = {
    'bool': '?', 'byte': 'B', 'char': 'B', 'int8': 'b', 'uint8': 'B', 'int16': 'h', 'uint16': 'H',
    'int32': 'i', 'uint32': 'I', 'int64': 'q', 'uint64': 'Q', 'float32': 'f', 'float64': 'd',
}  # fmt: skip


@cache
def _encoder(type_name: str) -> Encoder:
    return encoder_of(MESSAGE_TYPES[type_name])


def encoder_of(message: MessageType) -> Encoder:
    """An encoder from message fields to CDR."""
    fields = _number_fields(message)
    if fields is not None:
        return _packer(fields)
    write = _writer(message, '')

    def encode(values: Mapping[str, Any]) -> bytes:
        # Alignment counts from behind the encapsulation.
        out = bytearray()
        write(out, values)
        return _ENCAPSULATION + out

    return encode


def _writer(message: MessageType, kind: str) -> _Writer:
    """A function that appends a ``kind`` (a type or an array of one) to bytes; '' is the message itself."""
    array = _ARRAY.fullmatch(kind)
    if array is not None:
        return _array_writer(_writer(message, array[1]), array[1], array[2])
    if kind == 'string':
        return _write_text
    if kind in _FORMATS:
        pack = struct.Struct(f'<{_FORMATS[kind]}')
        size = pack.size

        def write_number(out: bytearray, value: Any) -> None:
            if len(out) % size:
                out += bytes(-len(out) % size)
            out += pack.pack(value)

        return write_number
    fields = [(name, _writer(message, inner)) for inner, name in message.members(kind)]
    if not fields:
        raise KeyError(f'{message.name}: {kind} is not defined')

    def write_fields(out: bytearray, value: Any) -> None:
        for name, write in fields:
            write(out, value[name])

    return write_fields


def _write_size(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % 4) + _U32.pack(size)


def _write_text(out: bytearray, value: str) -> None:
    text = value.encode() + b'\0'
    _write_size(out, len(text))
    out += text


def _array_writer(write_one: _Writer, kind: str, length: str) -> _Writer:
    """``length``: number of elements of a fixed array, else ''."""
    # The last constant array, where it began and its bytes: one object, because several threads encode.
    last: tuple[object, int, bytes] = (None, 0, b'')

    def write(out: bytearray, values: Any) -> None:
        nonlocal last
        known, place, written = last
        at = len(out)
        if values is known and at % 8 == place:
            out += written
            return
        write_all(out, values)
        if isinstance(values, Constant):
            last = values, at % 8, bytes(out[at:])

    def write_all(out: bytearray, values: Any) -> None:
        if not length:
            _write_size(out, len(values))
        elif len(values) != int(length):
            raise ValueError(f'{len(values)} values in an array of {length}')
        if kind in ('uint8', 'byte'):
            out += bytes(values)
            return
        for value in values:
            write_one(out, value)

    return write


def _number_fields(message: MessageType) -> list[tuple[tuple[str, ...], int]] | None:
    """Access path of each float64, if a message consists of a header and float64 numbers; else None."""
    (first, _), *rest = message.members()
    if first != 'std_msgs/Header' or not all(_only_numbers(message, kind) for kind, _ in rest):
        return None
    return [part for kind, name in rest for part in _numbers(message, kind, (name,))]


def _only_numbers(message: MessageType, kind: str) -> bool:
    inside = message.members(kind)
    return bool(_FLOAT64.fullmatch(kind)) or (bool(inside) and all(_only_numbers(message, k) for k, _ in inside))


def _numbers(message: MessageType, kind: str, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], int]]:
    """Access path of each float64 of a ``kind``, and how many are there: 0 for a single number."""
    array = _FLOAT64.fullmatch(kind)
    if array is not None:
        yield path, int(array[1] or 0)
        return
    for inner, name in message.members(kind):
        yield from _numbers(message, inner, (*path, name))


def _packer(fields: list[tuple[tuple[str, ...], int]]) -> Encoder:
    """An encoder for messages that consist of a header and float64 ``fields``."""
    # Single numbers that are neighbours in one part of the message are read together.
    together: list[tuple[tuple[str, ...], list[str]]] = []
    for path, size in fields:
        if size:
            together.append((path, []))
        elif together and together[-1][1] and together[-1][0] == path[:-1]:
            together[-1][1].append(path[-1])
        else:
            together.append((path[:-1], [path[-1]]))
    takers = [(path, _taker(names)) for path, names in together]
    numbers = sum(max(size, 1) for _, size in fields)

    @cache
    def layout(size: int) -> struct.Struct:
        # Numbers are at multiples of 8, counted from behind the encapsulation.
        return struct.Struct(f'<4siII{size}s{-(12 + size) % 8}x{numbers}d')

    def encode(message: Mapping[str, Any]) -> bytes:
        values: list[float] = []
        for path, take in takers:
            part: Any = message
            for name in path:
                part = part[name]
            values += take(part)
        header = message['header']
        stamp, frame = header['stamp'], header['frame_id'].encode()
        # Including the terminating zero.
        size = len(frame) + 1
        return layout(size).pack(_ENCAPSULATION, stamp['sec'], stamp['nanosec'], size, frame, *values)

    return encode


def _taker(names: list[str]) -> Callable[[Any], Iterable[float]]:
    """The numbers of a part: its fields of these names, or all elements if it is an array."""
    if not names:
        return iter
    return itemgetter(*names) if len(names) > 1 else lambda part: (part[names[0]],)


def _reader(message: MessageType, kind: str) -> _Reader:
    """A function that reads a ``kind`` (a type or an array of one) from behind the encapsulation; '' is the message."""
    array = _ARRAY.fullmatch(kind)
    if array is not None:
        return _array_reader(message, array[1], array[2])
    if kind == 'string':
        return _read_text
    if kind in _FORMATS:
        numbers = _numbers_reader(kind)

        def read_number(body: bytes, at: int, order: str) -> tuple[Any, int]:
            (value,), at = numbers(body, at, order, 1)
            return value, at

        return read_number
    fields = [(name, _reader(message, inner)) for inner, name in message.members(kind)]
    if not fields:
        raise KeyError(f'{message.name}: {kind} is not defined')

    def read_fields(body: bytes, at: int, order: str) -> tuple[Any, int]:
        values = {}
        for name, read in fields:
            values[name], at = read(body, at, order)
        return values, at

    return read_fields


def _numbers_reader(kind: str) -> Callable[[bytes, int, str, int], tuple[tuple[Any, ...], int]]:
    form = _FORMATS[kind]
    size = struct.calcsize(f'<{form}')

    def read_numbers(body: bytes, at: int, order: str, count: int) -> tuple[tuple[Any, ...], int]:
        if not count:
            return (), at
        at += -at % size
        return struct.unpack_from(f'{order}{count}{form}', body, at), at + count * size

    return read_numbers


def _read_size(body: bytes, at: int, order: str) -> tuple[int, int]:
    at += -at % 4
    (size,) = (_U32 if order == '<' else _U32_BIG).unpack_from(body, at)
    return size, at + 4


def _read_bytes(body: bytes, at: int, size: int) -> tuple[bytes, int]:
    if size > len(body) - at:
        raise ValueError(f'{size} bytes at byte {at} of {len(body)}')
    return body[at : at + size], at + size


def _read_text(body: bytes, at: int, order: str) -> tuple[str, int]:
    size, at = _read_size(body, at, order)
    # With its terminating zero; some write no byte for an empty text.
    encoded, at = _read_bytes(body, at, size)
    return encoded[:-1].decode(), at


def _array_reader(message: MessageType, kind: str, length: str) -> _Reader:
    """``length``: number of elements of a fixed array, else ''."""
    numbers = _numbers_reader(kind) if kind in _FORMATS else None
    read_one = None if numbers is not None else _reader(message, kind)

    def read(body: bytes, at: int, order: str) -> tuple[Any, int]:
        count, at = (int(length), at) if length else _read_size(body, at, order)
        if kind in ('uint8', 'byte'):
            return _read_bytes(body, at, count)
        if count > len(body) - at:
            raise ValueError(f'{count} elements at byte {at} of {len(body)}')
        if numbers is not None:
            values, at = numbers(body, at, order, count)
            return list(values), at
        elements = []
        for _ in range(count):
            element, at = read_one(body, at, order)  # type: ignore[misc]
            elements.append(element)
        return elements, at

    return read


@cache
def _decoder(type_name: str) -> _Reader:
    return _reader(MESSAGE_TYPES[type_name], '')


@cache
def _doubles(type_name: str) -> struct.Struct:
    fields = _number_fields(MESSAGE_TYPES[type_name])
    if fields is None:
        raise TypeError(f'{type_name} is more than a header and numbers')
    return struct.Struct(f'<{sum(max(size, 1) for _, size in fields)}d')


def encode(type_name: str, fields: Mapping[str, Any]) -> bytes:
    """CDR of one message, encapsulation header included. Raises KeyError for a type that is not ours."""
    return _encoder(type_name)(fields)


def prepare(type_names: Iterable[str]) -> None:
    """Make the encoders now, so that the first message of a stream does not wait for them."""
    for type_name in type_names:
        _encoder(type_name)


def decode(type_name: str, cdr: bytes) -> dict[str, Any]:
    """The fields of one message, nested dicts and lists; ``uint8[]`` as bytes.

    Raises ValueError if the bytes are not a message of that type.
    """
    read = _decoder(type_name)
    if len(cdr) < len(_ENCAPSULATION):
        raise ValueError(f'not a {type_name} ({len(cdr)} bytes)')
    try:
        fields, _ = read(cdr[len(_ENCAPSULATION) :], 0, '<' if cdr[1] & 1 else '>')
    except (struct.error, ValueError) as error:
        raise ValueError(f'not a {type_name} ({error})') from None
    decoded: dict[str, Any] = fields
    return decoded


def numbers(type_name: str, cdr: bytes) -> tuple[int, tuple[float, ...]]:
    """(stamp in ns, all numbers) of a message of a header and float64 numbers, in the order of its definition.

    Takes a tenth of the time of :func:`decode`. Raises ValueError if the message is too short or big-endian.
    """
    if cdr[:2] != LITTLE:
        raise ValueError('is not little-endian CDR')
    try:
        (length,) = _U32.unpack_from(cdr, FRAME_AT)
        # Alignment counts from behind the encapsulation.
        at = 4 + (12 + length + 7) // 8 * 8
        return header_stamp_ns(cdr), _doubles(type_name).unpack_from(cdr, at)
    except struct.error:
        raise ValueError('is shorter than its type') from None


def header_stamp_ns(cdr: bytes) -> int:
    """The stamp of a little-endian message that begins with a header, ns. Raises struct.error if it is too short."""
    sec, nanosec = _STAMP.unpack_from(cdr, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


def u32(cdr: bytes, at: int) -> int:
    """The uint32 at the offset ``at``, in the message's byte order. Raises struct.error behind the end."""
    (value,) = (_U32 if cdr[:2] == LITTLE else _U32_BIG).unpack_from(cdr, at)
    return int(value)


def after_text(cdr: bytes, at: int) -> int:
    """Offset of a number of four bytes that follows the text at the offset ``at``. Raises struct.error."""
    return at + 4 + (u32(cdr, at) + 3) // 4 * 4
