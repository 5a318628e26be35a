"""Reads one MCAP file from front to back, whatever state it is in.

Two things keep this apart from the ``mcap`` package's readers: a file that lost its tail, or a
chunk its bits, gives everything else (with a warning), and no size that a file declares is
believed before it has been held against the file's own size or a bound. The format:
https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from psd_deflection.errors import RecordingError

MAGIC = b'\x89MCAP0\r\n'

MAX_CHUNK_BYTES = 256 * 2**20
"""Of one chunk, uncompressed; writers make chunks of 1 to 4 MiB."""

MAX_METADATA_BYTES = 16 * 2**20

_FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
METADATA, DATA_END = 0x0C, 0x0F

_RECORD = struct.Struct('<BQ')
_RECORD_AND_MESSAGE = struct.Struct('<BQHIQQ')
_MESSAGE_HEAD = struct.Struct('<HIQQ')


class Channel(NamedTuple):
    """A topic as the file has it. ``type`` as ``pkg/msg/Name``."""

    topic: str
    type: str
    encoding: str


class RawMessage(NamedTuple):
    """One message as it lies in the file."""

    channel: Channel
    log_time: int
    cdr: bytes


class DamagedError(Exception):
    """What was read contradicts itself."""


class Cursor:
    """Takes fields off a record; raises DamagedError where the record ends before the field does."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def take(self, size: int) -> bytes:
        """The next ``size`` bytes."""
        piece = self._content[self._at : self._at + size]
        if len(piece) != size:
            raise DamagedError('a field is longer than its record')
        self._at += size
        return piece

    def number(self, size: int) -> int:
        """The next unsigned number, little-endian."""
        return int.from_bytes(self.take(size), 'little')

    def text(self) -> str:
        """The next text, with its length before it."""
        try:
            return self.take(self.number(4)).decode()
        except UnicodeDecodeError:
            raise DamagedError('a text is not UTF-8') from None

    def mapping(self) -> dict[str, str]:
        """The next map of texts."""
        inner = Cursor(self.take(self.number(4)))
        out = {}
        while inner._at < len(inner._content):
            key = inner.text()
            out[key] = inner.text()
        return out


class McapSource:
    """One file. ``metadata``: MCAP metadata records by name, the last of a name counts.

    ``cut_at``: the byte where the file ends before its end, None where it is whole. ``warnings``
    grow as chunks are read. Raises RecordingError where the file cannot be opened or is no MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.cut_at: int | None = None
        self.warnings: list[str] = []
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}
        try:
            self._size = path.stat().st_size
            with path.open('rb') as stream:
                self._scan(stream)
        except OSError as error:
            raise self._refuse(f'cannot be read ({error.strerror or error})') from None

    def _refuse(self, why: str) -> RecordingError:
        return RecordingError(f'{self.path}: {why}')

    def _warn(self, text: str) -> None:
        line = f'{self.path}: {text}'
        if line not in self.warnings:
            self.warnings.append(line)

    def records(self, stream: BinaryIO) -> Iterator[tuple[int, int, int]]:
        """(opcode, offset of the content, its length) of every record that is whole."""
        at = len(MAGIC)
        while True:
            stream.seek(at)
            head = stream.read(_RECORD.size)
            if len(head) < _RECORD.size:
                self._cut(at)
                return
            opcode, length = _RECORD.unpack(head)
            at += _RECORD.size
            if length > self._size - at:
                self._cut(at - _RECORD.size)
                return
            yield opcode, at, length
            at += length
            if opcode == _FOOTER:
                stream.seek(at)
                if stream.read(len(MAGIC)) != MAGIC:
                    self._cut(at)
                return

    def _cut(self, at: int) -> None:
        if self.cut_at is None:
            self.cut_at = at
            self._warn(f'ends at byte {at} before its end (a recorder that was stopped hard?); all before is read')

    def _scan(self, stream: BinaryIO) -> None:
        """Look at every record's head; read those that say what is in the file."""
        magic = stream.read(len(MAGIC))
        if not magic:
            raise self._refuse('is empty')
        if magic != MAGIC[: len(magic)]:
            raise self._refuse('is not an MCAP file')
        if len(magic) < len(MAGIC):
            self._cut(len(magic))
            return
        for opcode, at, length in self.records(stream):
            if opcode not in (SCHEMA, CHANNEL, METADATA):
                continue
            if length > MAX_METADATA_BYTES:
                self._warn(f'the record at byte {at} has {length} bytes and is left out')
                continue
            stream.seek(at)
            try:
                self._note(opcode, stream.read(length))
            except DamagedError as error:
                self._warn(f'the record at byte {at} is damaged ({error}) and is left out')

    def _note(self, opcode: int, content: bytes) -> None:
        cursor = Cursor(content)
        if opcode == METADATA:
            name = cursor.text()
            self.metadata[name] = cursor.mapping()
        elif opcode == SCHEMA:
            number = cursor.number(2)
            self._schemas[number] = cursor.text()
        elif opcode == CHANNEL:
            number, schema = cursor.number(2), cursor.number(2)
            topic, encoding = cursor.text(), cursor.text()
            type_name = self._schemas.get(schema, '')
            if type_name.count('/') == 1:
                type_name = type_name.replace('/', '/msg/')
            self._channels[number] = Channel(topic, type_name, encoding)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages in the order of the file, of ``topics`` or of all.

        A damaged chunk is left out with a warning. Raises RecordingError where the disk fails.
        """
        try:
            with self.path.open('rb') as stream:
                for opcode, at, length in self.records(stream):
                    if opcode == DATA_END:
                        return
                    if opcode not in (CHUNK, MESSAGE):
                        continue
                    stream.seek(at)
                    content = stream.read(length)
                    try:
                        if opcode == CHUNK:
                            yield from self._in_chunk(unpack_chunk(content), topics)
                        else:
                            yield from self._in_chunk(_RECORD.pack(opcode, length) + content, topics)
                    except DamagedError as error:
                        self._warn(f'the chunk at byte {at} is damaged ({error}); what it held is missing')
        except OSError as error:
            raise self._refuse(f'cannot be read ({error.strerror or error})') from None

    def _in_chunk(self, content: bytes, topics: Collection[str] | None) -> Iterator[RawMessage]:
        wanted = {n: c for n, c in self._channels.items() if topics is None or c.topic in topics}
        at, end = 0, len(content)
        unpack = _RECORD_AND_MESSAGE.unpack_from
        while at < end:
            if at + _RECORD_AND_MESSAGE.size <= end:
                opcode, length, number, _, log_time, _ = unpack(content, at)
            elif at + _RECORD.size <= end:
                opcode, length = _RECORD.unpack_from(content, at)
                number = log_time = 0
            else:
                raise DamagedError('it ends within a record')
            at += _RECORD.size
            if length > end - at:
                raise DamagedError('a record in it is longer than the chunk')
            if opcode == MESSAGE:
                channel = wanted.get(number)
                if channel is not None:
                    if length < _MESSAGE_HEAD.size:
                        raise DamagedError('a message in it has no head')
                    yield RawMessage(channel, log_time, content[at + _MESSAGE_HEAD.size : at + length])
            elif opcode in (SCHEMA, CHANNEL):
                self._note(opcode, content[at : at + length])
                wanted = {n: c for n, c in self._channels.items() if topics is None or c.topic in topics}
            at += length


def unpack_chunk(content: bytes) -> bytes:
    """The records of a chunk record's content. Raises DamagedError where it contradicts itself."""
    cursor = Cursor(content)
    cursor.take(16)  # first and last log time
    size, crc = cursor.number(8), cursor.number(4)
    compression = cursor.text()
    packed = cursor.take(cursor.number(8))
    if size > MAX_CHUNK_BYTES:
        raise DamagedError(f'it declares {size} bytes, more than {MAX_CHUNK_BYTES}')
    plain = _decompress(packed, compression, size)
    if len(plain) != size:
        raise DamagedError(f'it holds {len(plain)} bytes and declares {size}')
    if crc and zlib.crc32(plain) != crc:
        raise DamagedError('its CRC does not match')
    return plain


def _decompress(packed: bytes, compression: str, size: int) -> bytes:
    if compression == '':
        return packed
    if size == 0:
        return b''
    try:
        if compression == 'zstd':
            declared = zstandard.frame_content_size(packed)
            if declared > size:
                raise DamagedError(f'its frame declares {declared} bytes and the chunk {size}')
            return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        if compression == 'lz4':
            plain: bytes = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
            return plain
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError) as error:
        raise DamagedError(str(error)) from None
    raise DamagedError(f'compression {compression!r} is not known')
