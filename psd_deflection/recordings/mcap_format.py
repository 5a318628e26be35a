# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file: those that describe it and its messages, as values and as bytes.

The format: https://mcap.dev/spec. A record is ``opcode u8 | length u64 | content``, little-endian. Every
length inside a record is compared with the record before it is used.
"""

import struct
from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

MAX_CHUNK_BYTES = 256 * 2**20
"""Bound of one chunk, uncompressed, and of one record outside of any; writers make chunks of 1 to 4 MiB."""

MAX_DESCRIPTION_BYTES = 16 * 2**20
"""Bound of one schema, channel or metadata record."""

MAX_FIELDS = 64
"""Fields of a point; ours has at most ten."""

MAX_WARNINGS = 100

_RECORDS = 10_000
_BYTES_A_RECORD = 4
_UNPACKED_BYTES = 64 * 2**20
_UNPACKED_EACH = 100
_OUTSIDE = 6
"""A record outside of any chunk counts as so many; a message or an index of one takes 31 bytes at least."""

_DESCRIPTION = 4
_BYTES_OF_TEXT = 100
"""A schema, channel or metadata record counts as so many more, and one more for each of so many bytes."""


class DamagedError(Exception):
    """The bytes contradict themselves, or ask for more than is allowed."""


class SpentError(Exception):
    """The file unpacks to more than a file of its size may."""


class Allowance:
    """Of one pass over a file of ``size`` bytes. ``records``: how many may still come; the reader of a chunk counts
    them down.

    A few bytes of a compressed chunk can stand for millions of records. So one pass over a file gets an
    allowance in proportion to the file's size, far above what any writer needs (ours takes 86 bytes a record, and
    2.6 bytes unpacked for each in the file). What lies beyond it is left out with a warning.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.records = _RECORDS + size // _BYTES_A_RECORD
        self._most = self._remaining = _UNPACKED_BYTES + _UNPACKED_EACH * size

    def may_unpack(self, size: int) -> None:
        """Raise DamagedError if no chunk may declare ``size`` bytes, SpentError if the file may not unpack to more."""
        if size > MAX_CHUNK_BYTES:
            raise DamagedError(f'it declares {size} bytes, more than {MAX_CHUNK_BYTES}')
        if size > self._remaining:
            most = f'{self._most} bytes, as many as a file of {self.size} bytes may'
            raise SpentError(f'unpacks to more than {most}: a chunk that declares {size} bytes is left out')

    def unpacked(self, size: int) -> None:
        """A chunk of ``size`` bytes was unpacked."""
        self._remaining -= size

    def outside(self) -> bool:
        """Allow for a record outside of any chunk; False if that is one too many."""
        self.records -= _OUTSIDE
        return self.records >= 0

    def describe(self, size: int) -> None:
        """Allow for a schema, channel or metadata record of ``size`` bytes. Raises DamagedError."""
        if size > MAX_DESCRIPTION_BYTES:
            raise DamagedError(f'it has {size} bytes, more than {MAX_DESCRIPTION_BYTES}')
        self.records -= _DESCRIPTION + size // _BYTES_OF_TEXT
        self.check()

    def check(self) -> None:
        """Raise DamagedError if too many records came."""
        if self.records < 0:
            raise DamagedError(f'more records than a file of {self.size} bytes can need')


class Warnings:
    """Lines, each once, at most ``MAX_WARNINGS``."""

    def __init__(self) -> None:
        self._lines: dict[str, None] = {}
        self._more = False

    def add(self, line: str) -> None:
        """One line, unless it is there."""
        if len(self._lines) < MAX_WARNINGS:
            self._lines[line] = None
        elif line not in self._lines:
            self._more = True

    def lines(self) -> list[str]:
        """All of them, in order."""
        return [*self._lines, *(['further warnings are not listed'] if self._more else [])]


MAGIC = b'\x89MCAP0\r\n'
RECORD_HEAD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')
"""Channel, sequence, log time, publish time; the message follows."""

_U32 = struct.Struct('<I')
_U64 = struct.Struct('<Q')
_ID = struct.Struct('<H')
_CHANNEL_HEAD = struct.Struct('<HH')
_CHUNK_HEAD = struct.Struct('<QQQI')


class Opcode(IntEnum):
    """First byte of a record."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


class Schema(NamedTuple):
    """The definition of a type."""

    id: int
    name: str
    encoding: str
    data: bytes

    def content(self) -> bytes:
        """As it stands in the file, behind the record's head."""
        return _ID.pack(self.id) + text(self.name) + text(self.encoding) + _U32.pack(len(self.data)) + self.data


class Channel(NamedTuple):
    """A topic: ``schema_id`` names its type (0: none), ``encoding`` the form of its messages."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: Mapping[str, str]

    def content(self) -> bytes:
        """As it stands in the file, behind the record's head."""
        head = _CHANNEL_HEAD.pack(self.id, self.schema_id)
        return head + text(self.topic) + text(self.encoding) + texts(self.metadata)


class Metadata(NamedTuple):
    """Named texts."""

    name: str
    metadata: dict[str, str]

    def content(self) -> bytes:
        """As it stands in the file, behind the record's head."""
        return text(self.name) + texts(self.metadata)


class McapMessage(NamedTuple):
    """One message of a channel; times in ns."""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


class Chunk(NamedTuple):
    """Records together, compressed; ``crc`` of them uncompressed, 0 if there is none."""

    start: int
    end: int
    size: int
    crc: int
    compression: str
    data: bytes

    def content(self) -> bytes:
        """As it stands in the file, behind the record's head."""
        head = _CHUNK_HEAD.pack(self.start, self.end, self.size, self.crc) + text(self.compression)
        return head + _U64.pack(len(self.data)) + self.data


McapRecord = Schema | Channel | Metadata | McapMessage


def record(opcode: Opcode, content: bytes) -> bytes:
    """A whole record."""
    return RECORD_HEAD.pack(opcode, len(content)) + content


def text(value: str) -> bytes:
    """A text behind its length."""
    encoded = value.encode()
    return _U32.pack(len(encoded)) + encoded


def texts(values: Mapping[str, str]) -> bytes:
    """Names and values, behind their length together."""
    inside = b''.join(text(name) + text(value) for name, value in values.items())
    return _U32.pack(len(inside)) + inside


class _Fields:
    """Takes a record apart, from front to back. Raises DamagedError if a field is longer than the record."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def take(self, size: int) -> bytes:
        at, self._at = self._at, self._at + size
        if self._at > len(self._content):
            raise DamagedError('a field is longer than its record')
        return self._content[at : self._at]

    def numbers(self, layout: struct.Struct) -> tuple[int, ...]:
        return layout.unpack(self.take(layout.size))

    def sized(self, layout: struct.Struct = _U32) -> bytes:
        (size,) = self.numbers(layout)
        return self.take(size)

    def text(self) -> str:
        try:
            return self.sized().decode()
        except UnicodeDecodeError:
            raise DamagedError('a text is not UTF-8') from None

    def texts(self) -> dict[str, str]:
        (size,) = self.numbers(_U32)
        end = self._at + size
        texts = {}
        while self._at < end:
            name = self.text()
            texts[name] = self.text()
        return texts


def parsed(opcode: int, content: bytes) -> McapRecord:
    """A schema, channel, metadata record or message. Raises DamagedError if it contradicts itself."""
    fields = _Fields(content)
    match opcode:
        case Opcode.SCHEMA:
            (number,) = fields.numbers(_ID)
            return Schema(id=number, name=fields.text(), encoding=fields.text(), data=fields.sized())
        case Opcode.CHANNEL:
            number, schema = fields.numbers(_CHANNEL_HEAD)
            return Channel(
                id=number, schema_id=schema, topic=fields.text(), encoding=fields.text(), metadata=fields.texts()
            )
        case Opcode.METADATA:
            return Metadata(name=fields.text(), metadata=fields.texts())
        case Opcode.MESSAGE:
            number, sequence, log_time, publish_time = fields.numbers(MESSAGE_HEAD)
            return McapMessage(
                channel_id=number,
                sequence=sequence,
                log_time=log_time,
                publish_time=publish_time,
                data=content[MESSAGE_HEAD.size :],
            )
    raise ValueError(f'opcode {opcode} is none of those that are read')


def parsed_chunk(content: bytes) -> Chunk:
    """A chunk, still compressed. Raises DamagedError if it contradicts itself."""
    fields = _Fields(content)
    start, end, size, crc = fields.numbers(_CHUNK_HEAD)
    return Chunk(start=start, end=end, size=size, crc=crc, compression=fields.text(), data=fields.sized(_U64))
