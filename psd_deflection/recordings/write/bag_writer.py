# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes rosbag2 bags and single MCAP files. A crash costs at most a second: chunks span less than half a second, and
the rig is the first message of every file."""

import abc
import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, Self

from msg_adapters import BY_NAME, MESSAGE_TYPES, to_messages
from psd_deflection import __version__
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.files import HeldFolder, creating, lock
from psd_deflection.model.simulation.catalogue import with_laws
from psd_deflection.recordings import cdr
from psd_deflection.recordings.provenance import provenance
from psd_deflection.recordings.write.bag_metadata import (
    DEFAULT_QOS,
    LATCHED_QOS,
    FileCount,
    TopicCount,
    bag_information,
    qos_text,
    to_yaml,
    totals,
    write_metadata,
)
from psd_deflection.recordings.write.mcap_writer import McapWriter
from psd_deflection.records import ParameterChange, Record, ReferencePose, ReferenceWithCovariance, RigState
from psd_deflection.rig.declarations import FRAME_PREFIX

CHUNK_NS = 500_000_000
"""A chunk spans less than this log time, ns: a crash costs it and what waits in the recorder's queue."""

META_SOFTWARE = 'psd_deflection'
META_NODE = 'node'
META_DROPPED = 'psd_deflection.dropped_here'
"""``META_SOFTWARE`` and ``META_DROPPED`` name MCAP metadata records: what recorded the file, and what it lacks.
``META_NODE`` is a key in the first.
"""

CUSTOM = {'psd_deflection_version': __version__}


class _RecordSink(abc.ABC):
    """A sink of records that ``with`` closes."""

    def __init__(self, rig_values: Mapping[str, object]) -> None:
        self._frame_prefix = str(rig_values.get(FRAME_PREFIX, ''))

    @abc.abstractmethod
    def close(self) -> None: ...

    @abc.abstractmethod
    def _change(self, change: ParameterChange) -> None: ...

    @abc.abstractmethod
    def write_encoded(self, topic: str, type_name: str, message: bytes, t_ns: int) -> None: ...

    def put(self, record: Record) -> None:
        """Write all messages of one record, at the record's own stamp.

        A ParameterChange waits for the next message, and gets its time.
        """
        if isinstance(record, ParameterChange):
            self._change(record)
            return
        for message in to_messages(record, self._frame_prefix):
            self.write_encoded(message.topic, message.type, cdr.encode(message.type, message.fields), message.t_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class McapFile(_RecordSink):
    """One MCAP file being written; common to bags and single files.

    Call it from one thread at a time. Raises RecordingError if the file exists, cannot be
    created, or the disk cannot be written. After such an error the file is closed and holds all
    complete chunks. While it is being written the file is locked (``flock``), so that no program
    repairs it. ``durable``: each chunk is written to the disk, not only to the operating system,
    before the next begins. ``folder``: where the file is made, if its caller holds that folder.
    ``node``: full name of the recorded ROS node.
    """

    def __init__(
        self,
        path: Path,
        *,
        rig_values: Mapping[str, object],
        device_hello: Mapping[str, object] | None = None,
        durable: bool = False,
        folder: HeldFolder | None = None,
        node: str = '',
    ) -> None:
        super().__init__(rig_values)
        rig_values = with_laws(rig_values)
        self.path = path
        self._durable = durable
        self.topics: dict[str, TopicCount] = {}
        self.start_ns = 0
        self.end_ns = 0
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._chunk_first: int | None = None
        self._chunk_last = 0
        self._begun = False
        self.changes: list[ParameterChange] = []
        self.custom = dict(CUSTOM)
        self._present = dict(rig_values)
        self._hello = device_hello
        # Written with the next message, whose time is then known.
        self._untold = [self._state(0, 0, {})] if rig_values or device_hello else []
        self._stream: BinaryIO | None = None
        self._spool: BinaryIO | None = None
        with creating(path), HeldFolder(path.parent) if folder is None else contextlib.nullcontext(folder) as held:
            self._stream = held.create(path.name)
            with contextlib.suppress(OSError):
                lock(self._stream)
            spool = self._spool = held.unnamed(f'.{path.name}.index')
        with self._guard():
            self._writer = McapWriter(self._stream, spool, library=f'psd_deflection {__version__}')
            self._writer.add_metadata(META_SOFTWARE, {'version': __version__, **({META_NODE: node} if node else {})})
            self._flush()

    @property
    def closed(self) -> bool:
        """True once nothing more can be written, be it after ``close`` or after an error."""
        return self._stream is None

    def within(self, folder: HeldFolder) -> bool:
        """Whether the file still has its name in ``folder``."""
        return self._stream is not None and folder.holds(self.path.name, self._stream)

    @property
    def size(self) -> int:
        """Bytes of the file so far, without the unfinished chunk."""
        return self._stream.tell() if self._stream is not None else 0

    def flush(self) -> None:
        """End the chunk, so that a crash from now on does not cost it."""
        with self._guard():
            self._flush()
            self._chunk_first = None

    def _flush(self) -> None:
        self._writer.flush()
        if self._durable and self._stream is not None:
            os.fsync(self._stream.fileno())

    @contextlib.contextmanager
    def _guard(self) -> Any:
        if self._stream is None:
            raise self._closed()
        try:
            yield
        except OSError as error:
            raise self._failed(error) from None

    def _closed(self) -> RecordingError:
        return RecordingError(f'{self.path}: the recording is closed')

    def _failed(self, error: OSError) -> RecordingError:
        self._abandon()
        return RecordingError(
            f'{self.path}: cannot be written ({error.strerror or error}); it ends with the last complete chunk'
        )

    def _abandon(self) -> None:
        stream, self._stream = self._stream, None
        for file in (stream, self._spool):
            if file is not None:
                with contextlib.suppress(OSError):
                    file.close()

    def _change(self, change: ParameterChange) -> None:
        if self._stream is None:
            raise self._closed()
        self.changes.append(change)
        self._present |= {name: value for name, value in change.values if name in self._present}
        self._untold.append(self._state(change.t_ns, change.block, dict(change.values)))

    def _state(self, t_ns: int, block: int, changed: Mapping[str, object]) -> RigState:
        return RigState(t_ns, block, dict(self._present), self._hello, changed, __version__, provenance())

    def _notify_rig(self, t_ns: int) -> None:
        """Write the rig as messages too: a bag that rosbag2 converts keeps its messages and loses the MCAP metadata."""
        untold, self._untold = self._untold, []
        for state in untold:
            for message in to_messages(state):
                self._write(message.topic, message.type, cdr.encode(message.type, message.fields), t_ns)

    def write_encoded(self, topic: str, type_name: str, message: bytes, t_ns: int) -> None:
        """Write one message that is already encoded as CDR, at log time ``t_ns``.

        Raises KeyError for a type that no adapter of :mod:`msg_adapters` declares.
        """
        if self._untold:
            self._notify_rig(t_ns)
        self._write(topic, type_name, message, t_ns)

    def _write(self, topic: str, type_name: str, message: bytes, t_ns: int) -> None:
        if self._stream is None:
            raise self._closed()
        # Written out instead of _guard, which would cost as much as the rest.
        try:
            channel = self._channels.get(topic)
            if channel is None:
                channel = self._register(topic, type_name)
            first = self._chunk_first
            if first is not None and max(self._chunk_last, t_ns) - min(first, t_ns) >= CHUNK_NS:
                self._flush()
                first = None
            self._chunk_first = t_ns if first is None else min(first, t_ns)
            self._chunk_last = t_ns if first is None else max(self._chunk_last, t_ns)
            entry = self.topics[topic]
            self._writer.add_message(channel, t_ns, message, t_ns, entry.messages)
        except OSError as error:
            raise self._failed(error) from None
        if self._begun:
            self.start_ns = min(self.start_ns, t_ns)
            self.end_ns = max(self.end_ns, t_ns)
        else:
            self._begun = True
            self.start_ns = self.end_ns = t_ns
        entry.messages += 1

    def _register(self, topic: str, type_name: str) -> int:
        message = MESSAGE_TYPES[type_name]
        schema = self._schemas.get(type_name)
        if schema is None:
            schema = self._writer.register_schema(type_name, 'ros2msg', message.definition.encode())
            self._schemas[type_name] = schema
        row = BY_NAME.get(topic)
        qos = LATCHED_QOS if row is not None and row.delivery.latched else DEFAULT_QOS
        channel = self._writer.register_channel(
            topic, 'cdr', schema, {'offered_qos_profiles': qos_text(qos), 'topic_type_hash': message.type_hash}
        )
        self._channels[topic] = channel
        self.topics[topic] = TopicCount(topic, type_name, qos, message.type_hash)
        return channel

    def note_dropped(self, samples: int, messages: int) -> None:
        """Note what the recording lacks because the machine that recorded did not keep up; the last note holds."""
        dropped = {'samples': str(samples), 'messages': str(messages)}
        self.custom[META_DROPPED] = json.dumps(dropped)
        with self._guard():
            self._writer.add_metadata(META_DROPPED, dropped)

    def count(self) -> FileCount:
        """The file's entry for ``metadata.yaml``."""
        messages = sum(t.messages for t in self.topics.values())
        return FileCount(self.path.name, self.start_ns, self.end_ns, messages)

    def close(self) -> None:
        """Write index and summary and close; a second call does nothing."""
        if self._stream is None:
            return
        if self._untold and self.topics:
            self._notify_rig(self.end_ns)
        with self._guard():
            information = bag_information([self.count()], list(self.topics.values()), self.custom)
            self._writer.add_metadata('rosbag2', {'serialized_metadata': to_yaml(information)})
            self._writer.finish()
            if self._durable:
                self._stream.flush()
                os.fsync(self._stream.fileno())
            self._stream.close()
            if self._spool is not None:
                self._spool.close()
        self._stream = None


class BagWriter(_RecordSink):
    """A rosbag2 bag being written: ``NAME/NAME_0.mcap`` and so on, ``NAME/metadata.yaml`` at the end.

    ``rig_values``: the flat parameter set, effects included. ``node``: full name of the recorded
    ROS node. ``max_bytes``, ``max_s``: a file of this size, or with this span of log time, is
    closed and the next one begun (0: never); each file can be read alone. Raises RecordingError if
    the folder exists already or cannot be created; the calls raise it as in :class:`McapFile`.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        rig_values: Mapping[str, object],
        device_hello: Mapping[str, object] | None = None,
        max_bytes: int = 0,
        max_s: float = 0.0,
        durable: bool = False,
        node: str = '',
    ) -> None:
        super().__init__(rig_values)
        self.folder = Path(folder)
        with creating(self.folder):
            self.folder.mkdir(parents=True)
            self._held = HeldFolder(self.folder, follow=False)
        self._name = self.folder.resolve().name
        self._rig_values, self._hello, self._node = rig_values, device_hello, node
        self._max_bytes, self._max_ns, self._durable = max_bytes, round(max_s * 1e9), durable
        self._number = 0
        self._ended: list[tuple[FileCount, list[TopicCount]]] = []
        self._file = self._begin()

    @property
    def path(self) -> Path:
        """The file that is written at present."""
        return self._file.path

    @property
    def closed(self) -> bool:
        """True once nothing more can be written, be it after ``close`` or after an error."""
        return self._file.closed

    @property
    def in_place(self) -> bool:
        """Whether the file being written is still found at its path: neither it nor the folder was moved."""
        return self._held.in_place() and self._file.within(self._held)

    def _begin(self) -> McapFile:
        file = McapFile(
            self.folder / f'{self._name}_{self._number}.mcap',
            rig_values=self._rig_values,
            device_hello=self._hello,
            durable=self._durable,
            folder=self._held,
            node=self._node,
        )
        self._number += 1
        return file

    def _change(self, change: ParameterChange) -> None:
        self._file.put(change)

    def write_encoded(self, topic: str, type_name: str, message: bytes, t_ns: int) -> None:
        """Write one message that is already encoded as CDR, at log time ``t_ns``; begin a new file if it is due."""
        file = self._file
        full = self._max_bytes and file.size >= self._max_bytes
        if full or (self._max_ns and file.topics and t_ns - file.start_ns >= self._max_ns):
            self.rotate()
        self._file.write_encoded(topic, type_name, message, t_ns)

    def rotate(self) -> None:
        """Close the file and begin the next, which repeats all parameter changes so far."""
        before = self._file
        before.close()
        self._ended.append((before.count(), list(before.topics.values())))
        self._file = self._begin()
        for change in before.changes:
            self._file.put(change)

    @property
    def oldest_age_s(self) -> float:
        """How long before the newest message the oldest complete file ended, s; 0 without one."""
        return (self._file.end_ns - self._ended[0][0].end_ns) * 1e-9 if self._ended else 0.0

    def drop_oldest(self) -> Path | None:
        """Delete the oldest complete file; None if there is only the one being written."""
        if not self._ended:
            return None
        count, _ = self._ended.pop(0)
        path = self.folder / count.path
        try:
            self._held.remove(count.path)
        except OSError as error:
            raise RecordingError(f'{path}: cannot be deleted ({error.strerror or error})') from None
        return path

    def flush(self) -> None:
        """End the chunk, so that a crash from now on does not cost it."""
        self._file.flush()

    def note_dropped(self, samples: int, messages: int) -> None:
        """Note what the bag lacks, in the file being written and in ``metadata.yaml``; call it just before the end."""
        self._file.note_dropped(samples, messages)

    def information(self) -> dict[str, Any]:
        """The tree of ``metadata.yaml`` for the messages written so far."""
        parts = [*self._ended, (self._file.count(), list(self._file.topics.values()))]
        topics = totals(t for _, counts in parts for t in counts)
        return bag_information([count for count, _ in parts], topics, self._file.custom)

    def close(self) -> None:
        """Close the file, then write ``metadata.yaml``; a second call does nothing.

        There is no ``metadata.yaml`` if writing a file failed, or it is no longer in the folder:
        ``psd-deflection recover`` makes one from the files, and our reader needs none. If the folder
        was moved, the bag is completed at its new place.
        """
        if self.closed:
            self._held.close()
            return
        there = self._file.within(self._held)
        try:
            self._file.close()
            if there:
                write_metadata(self._held, self.information())
        except OSError as error:
            reason = error.strerror or error
            raise RecordingError(f'{self.folder / "metadata.yaml"}: cannot be written ({reason})') from None
        finally:
            self._held.close()

    def discard(self) -> None:
        """Close and delete a bag into which nothing was written.

        Raises OSError or RecordingError if the disk cannot be written.
        """
        ours = self.in_place
        self._file.close()
        self._held.remove(self.path.name)
        self._held.close()
        if ours:
            self.folder.rmdir()


class ReferenceSink:
    """Poses into ``file``, which it closes. Raises RecordingError if the disk cannot be written."""

    def __init__(self, file: McapFile | BagWriter) -> None:
        self._file = file

    def put(self, t_ns: int, reference: ReferenceWithCovariance | None, status: str) -> None:
        """Write the pose of one frame; a frame without one has no message."""
        if reference is not None:
            self._file.put(ReferencePose(t_ns, reference.dx, reference.dy, reference.theta))
            self._file.put(reference)

    def close(self) -> None:
        """Write index and summary and close."""
        self._file.close()
