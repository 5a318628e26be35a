# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Repairs a recording that ends in a crash: every intact message is copied into a new file with index and summary, and
only then the old one is renamed to ``NAME.mcap.cut``. A failed repair loses nothing."""

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import BinaryIO

from msg_adapters import SAMPLES
from psd_deflection import __version__
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.files import HeldFolder, lock
from psd_deflection.base.foreign_yaml import YamlError, parse_yaml
from psd_deflection.recordings import cdr
from psd_deflection.recordings.mcap_format import (
    MAGIC,
    Channel,
    DamagedError,
    McapMessage,
    McapRecord,
    Metadata,
    Schema,
)
from psd_deflection.recordings.read.bag_reader import files_in, read_information
from psd_deflection.recordings.read.mcap_reader import McapReader
from psd_deflection.recordings.write.bag_metadata import (
    DEFAULT_QOS,
    FileCount,
    Qos,
    TopicCount,
    bag_information,
    totals,
    write_metadata,
)
from psd_deflection.recordings.write.bag_writer import CHUNK_NS, CUSTOM
from psd_deflection.recordings.write.mcap_writer import McapWriter

_MAX_QOS_TEXT = 10_000


@dataclass(slots=True)
class RecoveredFile:
    """One file: its content now; ``repaired``: whether it needed repair; ``span_ns``: duration, by the stamps of the
    samples where there are any; ``warnings`` of the reading."""

    path: Path
    repaired: bool
    count: FileCount
    span_ns: int
    topics: list[TopicCount]
    warnings: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Recovered:
    """``files`` in order; ``metadata_written``: ``metadata.yaml`` was written; ``set_aside``: files without content."""

    files: list[RecoveredFile]
    metadata_written: bool
    set_aside: list[Path]


def _qos_of(metadata: Mapping[str, str]) -> Qos | list[Qos]:
    """The QoS profiles of a channel: the default if it names none, an empty list if they cannot be read."""
    text = metadata.get('offered_qos_profiles', '')
    if not text or len(text) > _MAX_QOS_TEXT:
        return DEFAULT_QOS if not text else []
    with contextlib.suppress(YamlError):
        profiles = parse_yaml(text)
        if isinstance(profiles, list) and all(isinstance(q, dict) for q in profiles):
            return profiles
    return []


class _Copy:
    """Counts the records that it gets, and writes them if there is a ``target``."""

    def __init__(self, target: Path | None) -> None:
        self.topics: dict[str, TopicCount] = {}
        self._stream = target.open('xb') if target is not None else None
        self._spool: BinaryIO | None = None
        self._writer: McapWriter | None = None
        if target is not None and self._stream is not None:
            with HeldFolder(target.parent) as held:
                self._spool = held.unnamed(f'.{target.name}.index')
            self._writer = McapWriter(self._stream, self._spool, library=f'psd_deflection {__version__} recover')
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._numbers: dict[int, int] = {}
        self._schema_numbers: dict[tuple[str, str, bytes], int] = {}
        self._first: int | None = None
        self.messages = 0
        self.start = self.end = 0
        self.stamps: tuple[int, int] | None = None

    def add(self, record: McapRecord) -> None:
        if isinstance(record, McapMessage):
            self._add_message(record)
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Metadata) and self._writer is not None and record.name != 'rosbag2':
            self._writer.add_metadata(record.name, record.metadata)

    def _add_message(self, m: McapMessage) -> None:
        channel = self._channels.get(m.channel_id)
        if channel is None:
            raise DamagedError('a message belongs to no channel')
        schema = self._schemas.get(channel.schema_id, Schema(id=0, name='', encoding='', data=b''))
        topic = self.topics.get(channel.topic)
        if topic is None:
            type_hash = channel.metadata.get('topic_type_hash', '')
            topic = TopicCount(channel.topic, schema.name, _qos_of(channel.metadata), type_hash)
            self.topics[channel.topic] = topic
        topic.messages += 1
        self.start = min(self.start, m.log_time) if self.messages else m.log_time
        self.end = max(self.end, m.log_time)
        self.messages += 1
        if channel.topic.endswith(SAMPLES) and len(m.data) >= cdr.FRAME_AT:
            stamp = cdr.header_stamp_ns(m.data)
            low, high = self.stamps or (stamp, stamp)
            self.stamps = (min(low, stamp), max(high, stamp))
        writer = self._writer
        if writer is None:
            return
        if m.channel_id not in self._numbers:
            key = (schema.name, schema.encoding, schema.data)
            if key not in self._schema_numbers:
                self._schema_numbers[key] = writer.register_schema(*key)
            self._numbers[m.channel_id] = writer.register_channel(
                channel.topic, channel.encoding, self._schema_numbers[key], channel.metadata
            )
        if self._first is not None and abs(m.log_time - self._first) >= CHUNK_NS:
            writer.flush()
            self._first = None
        self._first = m.log_time if self._first is None else self._first
        writer.add_message(self._numbers[m.channel_id], m.log_time, m.data, m.publish_time, m.sequence)

    def finish(self) -> None:
        if self._writer is None or self._stream is None:
            return
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self.abandon()

    def abandon(self) -> None:
        for file in (self._stream, self._spool):
            if file is not None:
                file.close()


def _recover_file(path: Path) -> RecoveredFile:
    source = McapReader(path)
    if path.stat().st_size <= len(MAGIC):
        return RecoveredFile(path, False, FileCount(path.name, 0, 0, 0), 0, [], source.warnings)
    cut = source.cut_at is not None
    partial = path.with_name(path.name + '.partial')
    partial.unlink(missing_ok=True)
    copy = _Copy(partial if cut else None)
    try:
        for record in source.contents():
            try:
                copy.add(record)
            except DamagedError as error:
                source.warn(f'{error}; it is left out')
        copy.finish()
    except BaseException:
        copy.abandon()
        partial.unlink(missing_ok=True)
        raise
    count = FileCount(path.name, copy.start, copy.end, copy.messages)
    if cut:
        try:
            _set_aside(path)
        except RecordingError:
            partial.unlink()
            raise
        partial.rename(path)
    first, last = copy.stamps or (copy.start, copy.end)
    return RecoveredFile(path, cut, count, last - first, list(copy.topics.values()), source.warnings)


def _set_aside(path: Path) -> Path:
    """Rename ``path`` to ``PATH.cut`` and return that; raises RecordingError if an earlier repair left a file there."""
    aside = path.with_name(path.name + '.cut')
    if aside.exists():
        raise RecordingError(f'{aside}: exists already, from an earlier repair; move it away first')
    path.rename(aside)
    return aside


def _reject_if_written(path: Path) -> None:
    with path.open('rb') as stream:
        if not lock(stream, shared=True):
            raise RecordingError(f'{path}: is being recorded at this moment; end the recording first')


def recover(path: str | Path) -> Recovered:
    """Repair ``path``, a bag folder or a single ``.mcap``, in place.

    Raises RecordingError if nothing in it can be read, if it is still being recorded, or if the
    disk cannot be written.
    """
    path = Path(path)
    try:
        if path.is_dir():
            return _recover_folder(path)
        if not path.is_file():
            raise RecordingError(f'{path}: no such recording')
        _reject_if_written(path)
        file = _recover_file(path)
        if path.stat().st_size <= len(MAGIC):
            raise RecordingError(f'{path}: has no more than its first bytes; there is nothing to recover')
        return Recovered([file], False, [])
    except OSError as error:
        raise RecordingError(f'{path}: cannot be repaired ({error.strerror or error})') from None


def _describes(metadata: Path, files: list[RecoveredFile]) -> bool:
    """Whether ``metadata.yaml`` can be read and lists the files of the folder, or files that rosbag2 compressed."""
    try:
        information = read_information(metadata)
    except RecordingError:
        return False
    named = information.get('relative_file_paths')
    names = {PurePath(str(n)).name for n in named} if isinstance(named, list) else set()
    return bool(information.get('compression_mode')) or names == {f.path.name for f in files}


def _recover_folder(folder: Path) -> Recovered:
    paths = files_in(folder)
    if not paths:
        raise RecordingError(f'{folder}: is no bag: it holds no .mcap file')
    for file in paths:
        _reject_if_written(file)
    files, set_aside = [], []
    for file in paths:
        # A file with no more than its first bytes holds nothing. The only file of a bag stays, even so.
        if file.stat().st_size <= len(MAGIC) and len(paths) > 1:
            set_aside.append(_set_aside(file))
            continue
        files.append(_recover_file(file))
    metadata = folder / 'metadata.yaml'
    if metadata.is_file() and not set_aside and not any(f.repaired for f in files):
        if _describes(metadata, files):
            return Recovered(files, False, set_aside)
        metadata.replace(metadata.with_name(metadata.name + '.cut'))
    topics = totals(t for f in files for t in f.topics)
    with HeldFolder(folder) as held:
        write_metadata(held, bag_information([f.count for f in files], topics, CUSTOM))
    return Recovered(files, True, set_aside)
