# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes one MCAP file: chunks, each followed by its message indexes, and the summary at the end.

The format: https://mcap.dev/spec. The chunk indexes, a kilobyte each (180 MB a day), wait in a second file until the
end.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import BinaryIO

from psd_deflection.recordings.mcap_format import (
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    Channel,
    Chunk,
    Metadata,
    Opcode,
    Schema,
    record,
    text,
)

_CHUNK_BYTES = 1 << 20
"""A chunk ends once it has more than this many bytes, uncompressed."""

_ENTRY = struct.Struct('<QQ')
_MESSAGE_INDEX = struct.Struct('<HI')
_PLACE = struct.Struct('<HQ')
_CHUNK_INDEX = struct.Struct('<QQQQI')
_STATISTICS = struct.Struct('<QHIIIIQQI')
_SUMMARY_OFFSET = struct.Struct('<BQQ')
_FOOTER = struct.Struct('<QQ')
_U32 = struct.Struct('<I')
_U64 = struct.Struct('<Q')


class McapWriter:
    """Writes one MCAP file to ``stream``, which is empty. ``spool``: an empty file for the chunk indexes.

    The calls raise OSError if the disk cannot be written. Neither file is closed.
    """

    def __init__(self, stream: BinaryIO, spool: BinaryIO, *, library: str) -> None:
        self._stream, self._spool = stream, spool
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._metadata_indexes: list[bytes] = []
        self._counts: dict[int, int] = defaultdict(int)
        self._chunks = 0
        self._start = self._end = 0
        self._open_chunk()
        stream.write(MAGIC + record(Opcode.HEADER, text('ros2') + text(library)))

    def _open_chunk(self) -> None:
        self._chunk = bytearray()
        self._indexes: dict[int, list[bytes]] = defaultdict(list)
        self._chunk_start = self._chunk_end = 0

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Declare a type; its number, from 1."""
        schema = Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data)
        self._schemas.append(schema)
        self._chunk += record(Opcode.SCHEMA, schema.content())
        return schema.id

    def register_channel(self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str]) -> int:
        """Declare a topic; its number, from 1."""
        channel = Channel(
            id=len(self._channels) + 1, schema_id=schema_id, topic=topic, encoding=encoding, metadata=metadata
        )
        self._channels.append(channel)
        self._chunk += record(Opcode.CHANNEL, channel.content())
        return channel.id

    def add_message(self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None:
        """Add a message; times in ns."""
        if self._indexes:
            self._chunk_start = min(self._chunk_start, log_time)
        else:
            self._chunk_start = log_time
        self._chunk_end = max(self._chunk_end, log_time)
        self._start = min(self._start, log_time) if self._counts else log_time
        self._end = max(self._end, log_time)
        self._counts[channel_id] += 1
        self._indexes[channel_id].append(_ENTRY.pack(log_time, len(self._chunk)))
        self._chunk += RECORD_HEAD.pack(Opcode.MESSAGE, MESSAGE_HEAD.size + len(data))
        self._chunk += MESSAGE_HEAD.pack(channel_id, sequence, log_time, publish_time)
        self._chunk += data
        if len(self._chunk) > _CHUNK_BYTES:
            self._end_chunk()

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Add named texts, outside of the chunk in progress."""
        written = record(Opcode.METADATA, Metadata(name=name, metadata=dict(metadata)).content())
        place = _ENTRY.pack(self._stream.tell(), len(written))
        self._metadata_indexes.append(record(Opcode.METADATA_INDEX, place + text(name)))
        self._stream.write(written)

    def flush(self) -> None:
        """End the chunk in progress, if it has messages, and hand all to the operating system."""
        self._end_chunk()
        self._stream.flush()

    def _end_chunk(self) -> None:
        if not self._indexes:
            return
        import zstandard

        self._chunks += 1
        plain = bytes(self._chunk)
        chunk = Chunk(
            start=self._chunk_start,
            end=self._chunk_end,
            size=len(plain),
            crc=zlib.crc32(plain),
            compression='zstd',
            data=zstandard.compress(plain),
        )
        at = self._stream.tell()
        written = record(Opcode.CHUNK, chunk.content())
        self._stream.write(written)
        places, indexes = bytearray(), bytearray()
        for channel_id, entries in self._indexes.items():
            places += _PLACE.pack(channel_id, at + len(written) + len(indexes))
            indexes += record(
                Opcode.MESSAGE_INDEX, _MESSAGE_INDEX.pack(channel_id, _ENTRY.size * len(entries)) + b''.join(entries)
            )
        self._stream.write(indexes)
        head = _CHUNK_INDEX.pack(chunk.start, chunk.end, at, len(written), len(places)) + places
        sizes = _ENTRY.pack(len(chunk.data), chunk.size)
        index = head + _U64.pack(len(indexes)) + text(chunk.compression) + sizes
        self._spool.write(record(Opcode.CHUNK_INDEX, index))
        self._open_chunk()

    def _statistics(self) -> bytes:
        counts = b''.join(_PLACE.pack(number, count) for number, count in self._counts.items())
        head = _STATISTICS.pack(
            sum(self._counts.values()),
            len(self._schemas),
            len(self._channels),
            0,
            len(self._metadata_indexes),
            self._chunks,
            self._start,
            self._end,
            len(counts),
        )
        return record(Opcode.STATISTICS, head + counts)

    def finish(self) -> None:
        """Write the rest and the summary; nothing can be added afterwards."""
        self._end_chunk()
        self._stream.write(record(Opcode.DATA_END, _U32.pack(0)))
        start = at = self._stream.tell()
        crc = 0
        offsets = bytearray()

        def write(pieces: Iterable[bytes]) -> None:
            nonlocal crc, at
            for piece in pieces:
                crc = zlib.crc32(piece, crc)
                at += len(piece)
                self._stream.write(piece)

        self._spool.seek(0)
        groups: list[tuple[Opcode, Iterable[bytes]]] = [
            (Opcode.SCHEMA, (record(Opcode.SCHEMA, schema.content()) for schema in self._schemas)),
            (Opcode.CHANNEL, (record(Opcode.CHANNEL, channel.content()) for channel in self._channels)),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, iter(lambda: self._spool.read(1 << 20), b'')),
            (Opcode.ATTACHMENT_INDEX, []),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        ]
        for opcode, pieces in groups:
            before = at
            write(pieces)
            offsets += record(Opcode.SUMMARY_OFFSET, _SUMMARY_OFFSET.pack(opcode, before, at - before))
        offsets_at = at
        write([bytes(offsets)])
        footer = _FOOTER.pack(start, offsets_at)
        head = RECORD_HEAD.pack(Opcode.FOOTER, len(footer) + _U32.size)
        write([head + footer])
        self._stream.write(_U32.pack(crc) + MAGIC)
