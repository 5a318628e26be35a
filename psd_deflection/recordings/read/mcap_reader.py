# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads one MCAP file (https://mcap.dev/spec) from front to back, even cut or damaged, with a warning. Every size that
it declares is compared with the file's own or with the allowance before it is used."""

import contextlib
import struct
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.mcap_format import (
    MAGIC,
    MAX_CHUNK_BYTES,
    MESSAGE_HEAD,
    RECORD_HEAD,
    Allowance,
    Channel,
    DamagedError,
    McapRecord,
    Metadata,
    Opcode,
    Schema,
    SpentError,
    Warnings,
    parsed,
    parsed_chunk,
)

_INDEX_HEAD = struct.Struct('<BQH')
"""Head of a record and the channel that an index of messages is of."""


class RecordedChannel(NamedTuple):
    """A topic as declared in the file. ``type`` as ``pkg/msg/Name``."""

    topic: str
    type: str
    encoding: str


class RawMessage(NamedTuple):
    """One encoded message of the file."""

    channel: RecordedChannel
    log_time: int
    cdr: bytes


class McapReader:
    """One file. ``metadata``: MCAP metadata records by name; the last of a name counts.

    ``cut_at``: the byte at which a cut file ends, None if the file is complete. ``warnings``
    grow as chunks are read. Raises RecordingError if the file cannot be opened or is not an MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.cut_at: int | None = None
        self._warnings = Warnings()
        self._types: dict[int, str] = {}
        self._channels: dict[int, RecordedChannel] = {}
        try:
            self._size = path.stat().st_size
            with path.open('rb') as stream:
                self._scan(stream)
        except OSError as error:
            raise self._reject(f'cannot be read ({error.strerror or error})') from None

    @property
    def channels(self) -> list[RecordedChannel]:
        """The topics that are known by now; all of them if the file is complete, or once it was read."""
        return list(self._channels.values())

    def _reject(self, why: str) -> RecordingError:
        return RecordingError(f'{self.path}: {why}')

    @property
    def warnings(self) -> list[str]:
        """One line for each cut or damage found so far."""
        return self._warnings.lines()

    def warn(self, text: str) -> None:
        """Add a warning about this file."""
        self._warnings.add(f'{self.path}: {text}')

    def _records(self, stream: BinaryIO, allowance: Allowance) -> Iterator[tuple[int, int, int]]:
        """(opcode, offset of the content, its length) of every complete record."""
        at = len(MAGIC)
        while True:
            if not allowance.outside():
                self.warn(f'holds more than a file of {self._size} bytes can need; what follows byte {at} is left out')
                return
            stream.seek(at)
            head = stream.read(RECORD_HEAD.size)
            if len(head) < RECORD_HEAD.size:
                self._cut(at)
                return
            opcode, length = RECORD_HEAD.unpack(head)
            at += RECORD_HEAD.size
            # No record has opcode 0: these are the zeros that a file system leaves after a power cut.
            if length > self._size - at or opcode == 0:
                self._cut(at - RECORD_HEAD.size)
                return
            yield opcode, at, length
            at += length
            if opcode == Opcode.FOOTER:
                stream.seek(at)
                if stream.read(len(MAGIC)) != MAGIC:
                    self._cut(at)
                return

    def _cut(self, at: int) -> None:
        if self.cut_at is None:
            self.cut_at = at
            self.warn(f'ends at byte {at} before its end (a recorder that was stopped hard?); all before is read')

    def _scan(self, stream: BinaryIO) -> None:
        """Look at every record's head; read the records that describe the file."""
        magic = stream.read(len(MAGIC))
        if not magic:
            raise self._reject('is empty')
        if magic != MAGIC[: len(magic)]:
            raise self._reject('is not an MCAP file')
        if len(magic) < len(MAGIC):
            self._cut(len(magic))
            return
        allowance = Allowance(self._size)
        for opcode, at, length in self._records(stream, allowance):
            if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
                continue
            stream.seek(at)
            try:
                allowance.describe(length)
                self._note(parsed(opcode, stream.read(length)))
            except DamagedError as error:
                self.warn(f'the record at byte {at} is damaged ({error}) and is left out')

    def _note(self, record: McapRecord) -> None:
        if isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
        elif isinstance(record, Schema):
            self._types[record.id] = record.name
        elif isinstance(record, Channel):
            type_name = self._types.get(record.schema_id, '')
            if type_name.count('/') == 1:
                type_name = type_name.replace('/', '/msg/')
            self._channels[record.id] = RecordedChannel(record.topic, type_name, record.encoding)

    def _parts(
        self, opcodes: Collection[int], allowance: Allowance, wanted: Collection[int] | None = None
    ) -> Iterator[tuple[int, bytes]]:
        """(offset, records) of each chunk, unpacked, and of each record outside of any, as in a chunk.

        ``wanted``: numbers of channels; a chunk whose index names none of them is left out.
        """
        try:
            with self.path.open('rb') as stream:
                for opcode, at, length in self._records(stream, allowance):
                    if opcode == Opcode.DATA_END:
                        return
                    if opcode not in opcodes:
                        continue
                    if opcode == Opcode.CHUNK and wanted is not None and self._lacks(wanted, stream, at + length):
                        continue
                    if length > MAX_CHUNK_BYTES:
                        self.warn(f'the record at byte {at} has {length} bytes and is left out')
                        continue
                    stream.seek(at)
                    content = stream.read(length)
                    if opcode != Opcode.CHUNK:
                        yield at, RECORD_HEAD.pack(opcode, length) + content
                        continue
                    with self._damage_reported(at):
                        yield at, _unpacked(content, allowance)
        except OSError as error:
            raise self._reject(f'cannot be read ({error.strerror or error})') from None

    def _lacks(self, wanted: Collection[int], stream: BinaryIO, at: int) -> bool:
        """Whether the index behind a chunk, from byte ``at`` on, names known channels and none of ``wanted``."""
        named = 0
        while True:
            stream.seek(at)
            head = stream.read(_INDEX_HEAD.size)
            if len(head) < _INDEX_HEAD.size:
                return False
            opcode, length, number = _INDEX_HEAD.unpack(head)
            if opcode != Opcode.MESSAGE_INDEX:
                return named > 0
            if number in wanted or number not in self._channels or length > self._size:
                return False
            named += 1
            at += RECORD_HEAD.size + length

    @contextlib.contextmanager
    def _damage_reported(self, at: int) -> Iterator[None]:
        try:
            yield
        except DamagedError as error:
            self.warn(f'the chunk at byte {at} is damaged ({error}); what it held is missing')
        except SpentError as error:
            # Chunks that are alike have one line. This one may be damaged alone: the next one may fit.
            self.warn(str(error))

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages in the order of the file, of ``topics`` or of all.

        A damaged chunk is left out with a warning. Raises RecordingError if the disk fails.
        """
        allowance = Allowance(self._size)
        wanted = {n: c for n, c in self._channels.items() if topics is None or c.topic in topics}
        only = None if topics is None else wanted
        for at, records in self._parts((Opcode.CHUNK, Opcode.MESSAGE), allowance, only):
            with self._damage_reported(at):
                yield from self._messages_in(records, topics, wanted, allowance)

    def _messages_in(
        self, records: bytes, topics: Collection[str] | None, wanted: dict[int, RecordedChannel], allowance: Allowance
    ) -> Iterator[RawMessage]:
        # Without a Message for each: this loop handles every message of a replay.
        unpack, head = MESSAGE_HEAD.unpack_from, MESSAGE_HEAD.size
        for opcode, at, end in _records_in(records, allowance):
            if opcode == Opcode.MESSAGE:
                if end - at < head:
                    raise DamagedError('a message in it has no head')
                number, _, log_time, _ = unpack(records, at)
                channel = wanted.get(number)
                if channel is not None:
                    yield RawMessage(channel, log_time, records[at + head : end])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                allowance.describe(end - at)
                record = parsed(opcode, records[at:end])
                self._note(record)
                if isinstance(record, Channel):
                    if topics is None or record.topic in topics:
                        wanted[record.id] = self._channels[record.id]
                    else:
                        wanted.pop(record.id, None)

    def contents(self) -> Iterator[McapRecord]:
        """Every complete schema, channel, metadata record and message, in the order of the file.

        Damage is left out with a warning. Raises RecordingError if the disk fails.
        """
        kinds = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.MESSAGE)
        allowance = Allowance(self._size)
        for at, records in self._parts((*kinds, Opcode.CHUNK), allowance):
            with self._damage_reported(at):
                for opcode, start, end in _records_in(records, allowance):
                    if opcode in kinds:
                        if opcode != Opcode.MESSAGE:
                            allowance.describe(end - start)
                        yield parsed(opcode, records[start:end])


def _records_in(records: bytes, allowance: Allowance) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset of the content, its end) of each record of a chunk. Raises DamagedError."""
    at, size = 0, len(records)
    unpack, head = RECORD_HEAD.unpack_from, RECORD_HEAD.size
    while at < size:
        allowance.records -= 1
        if allowance.records < 0:
            allowance.check()
        if at + head > size:
            raise DamagedError('it ends within a record')
        opcode, length = unpack(records, at)
        at += head
        if length > size - at:
            raise DamagedError('a record in it is longer than the chunk')
        if opcode == 0:
            raise DamagedError('a record in it has opcode 0')
        yield opcode, at, at + length
        at += length


def _unpacked(content: bytes, allowance: Allowance) -> bytes:
    """The records of a chunk record's content. Raises DamagedError if it contradicts itself, or declares too much;
    SpentError if the file unpacks to too much."""
    chunk = parsed_chunk(content)
    size = chunk.size
    allowance.may_unpack(size)
    plain = _decompress(chunk.data, chunk.compression, size)
    allowance.unpacked(len(plain))
    if len(plain) != size:
        raise DamagedError(f'it holds {len(plain)} bytes and declares {size}')
    if chunk.crc and zlib.crc32(plain) != chunk.crc:
        raise DamagedError('its CRC does not match')
    return plain


def _decompress(packed: bytes, compression: str, size: int) -> bytes:
    if compression == '':
        return packed
    if size == 0:
        return b''
    # Imported where they are needed: in a browser neither is there, and lz4 is an extra.
    if compression == 'zstd':
        import zstandard

        try:
            declared = zstandard.frame_content_size(packed)
            if declared > size:
                raise DamagedError(f'its frame declares {declared} bytes and the chunk {size}')
            return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        except (zstandard.ZstdError, ValueError) as error:
            raise DamagedError(str(error)) from None
    if compression == 'lz4':
        import lz4.frame  # type: ignore[import-untyped]

        try:
            plain: bytes = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
            return plain
        except (RuntimeError, EOFError, ValueError) as error:
            raise DamagedError(str(error)) from None
    raise DamagedError(f'compression {compression!r} is not known')
