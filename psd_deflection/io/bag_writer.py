"""Writes recordings: rosbag2 bags (a folder with ``metadata.yaml`` and MCAP) and lone MCAP files.

A crash must cost at most a second: chunks span less than one second of log time and are handed to
the operating system as they end; parameters, version and hello are at the front of the file. What
a crash leaves is read up to the cut by :mod:`psd_deflection.io.bag_reader`.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer

from msg_adapters import to_messages
from psd_deflection import __version__
from psd_deflection.errors import RecordingError
from psd_deflection.io import cdr
from psd_deflection.io.bag_metadata import DEFAULT_QOS, Qos, TopicCount, bag_information, qos_text, to_yaml
from psd_deflection.io.ros2msg import TYPE_HASHES, definition
from psd_deflection.records import ParameterChange, Record, SampleBlock

NS_PER_S = 1_000_000_000

META_SOFTWARE = 'psd_deflection'
META_PARAMETERS = 'psd_deflection.parameters'
META_HELLO = 'psd_deflection.device_hello'
META_SEQUENCE = 'psd_deflection.sequence'
META_CHANGE = 'psd_deflection.change.'
"""Names of the MCAP metadata records; every value in the last four is JSON."""


def _json_values(values: Mapping[str, object]) -> dict[str, str]:
    def plain(value: object) -> object:
        if isinstance(value, Mapping):
            return dict(value)
        if isinstance(value, tuple):
            return list(value)
        raise TypeError(f'{type(value).__name__} {value!r} has no JSON')

    return {key: json.dumps(value, default=plain) for key, value in values.items()}


class McapFile:
    """One MCAP file being written; the part that a bag and a lone file share.

    ``write`` takes the records of one thread. Raises RecordingError where the file exists, cannot
    be made, or the disk refuses more; after such an error the file is closed and holds all chunks
    that were complete.
    """

    def __init__(
        self,
        path: Path,
        *,
        rig_values: Mapping[str, object],
        device_hello: Mapping[str, object] | None = None,
        qos: Mapping[str, Qos] | None = None,
    ) -> None:
        self.path = path
        self.topics: dict[str, TopicCount] = {}
        self.start_ns = 0
        self.end_ns = 0
        self._qos = dict(qos or {})
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._chunk_first: int | None = None
        self._chunk_last = 0
        self._sequence_noted = False
        self._changes = 0
        self._stream: BinaryIO | None = None
        parameters = _json_values(rig_values)
        hello = None if device_hello is None else _json_values(device_hello)
        try:
            self._stream = path.open('xb')
        except FileExistsError:
            raise RecordingError(f'{path}: exists already; a recording is never overwritten') from None
        except OSError as error:
            raise RecordingError(f'{path}: cannot be made ({error.strerror or error})') from None
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD, enable_crcs=True)
        with self._guard():
            self._writer.start(profile='ros2', library=f'psd_deflection {__version__}')
            self._writer.add_metadata(META_SOFTWARE, {'version': __version__})
            self._writer.add_metadata(META_PARAMETERS, parameters)
            if hello is not None:
                self._writer.add_metadata(META_HELLO, hello)
            self._writer.flush()

    @property
    def closed(self) -> bool:
        """True once nothing more can be written, be it after ``close`` or after an error."""
        return self._stream is None

    @contextlib.contextmanager
    def _guard(self) -> Any:
        if self._stream is None:
            raise RecordingError(f'{self.path}: the recording is closed')
        try:
            yield
        except OSError as error:
            self._abandon()
            raise RecordingError(
                f'{self.path}: cannot be written ({error.strerror or error}); it ends with the last complete chunk'
            ) from None

    def _abandon(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            with contextlib.suppress(OSError):
                stream.close()

    def write_hello(self, device_hello: Mapping[str, object]) -> None:
        """Note the device's hello when it comes after the start of the recording; the last one counts."""
        with self._guard():
            self._writer.add_metadata(META_HELLO, _json_values(device_hello))

    def write(self, record: Record) -> None:
        """Write all messages of one record; the log time is the record's own stamp."""
        if isinstance(record, ParameterChange):
            with self._guard():
                self._changes += 1
                head = {'t_ns': str(record.t_ns), 'block': str(record.block)}
                self._writer.add_metadata(
                    f'{META_CHANGE}{self._changes:06d}', {**head, 'values': json.dumps(dict(record.values))}
                )
            return
        if isinstance(record, SampleBlock) and not self._sequence_noted:
            self._note_sequence(int(record.seq[0]))
        for message in to_messages(record):
            self.write_encoded(message.topic, message.type, cdr.encode(message.type, message.fields), message.t_ns)

    def _note_sequence(self, first: int) -> None:
        # The topic holds seq modulo 2^32; blocks are cut by the whole number.
        self._sequence_noted = True
        if first >> 32:
            with self._guard():
                self._writer.add_metadata(META_SEQUENCE, {'first': str(first)})

    def write_encoded(self, topic: str, type_name: str, message: bytes, t_ns: int) -> None:
        """Write one message that is CDR already, at log time ``t_ns``.

        Raises KeyError for a type that :mod:`psd_deflection.io.ros2msg` does not define.
        """
        with self._guard():
            channel = self._channels.get(topic)
            if channel is None:
                channel = self._register(topic, type_name)
            first = self._chunk_first
            if first is not None and max(self._chunk_last, t_ns) - min(first, t_ns) >= NS_PER_S:
                self._writer.flush()
                first = None
            self._chunk_first = t_ns if first is None else min(first, t_ns)
            self._chunk_last = t_ns if first is None else max(self._chunk_last, t_ns)
            entry = self.topics[topic]
            self._writer.add_message(channel, t_ns, message, t_ns, entry.messages)
        if not any(t.messages for t in self.topics.values()):
            self.start_ns = self.end_ns = t_ns
        self.start_ns = min(self.start_ns, t_ns)
        self.end_ns = max(self.end_ns, t_ns)
        entry.messages += 1

    def _register(self, topic: str, type_name: str) -> int:
        schema = self._schemas.get(type_name)
        if schema is None:
            schema = self._writer.register_schema(type_name, 'ros2msg', definition(type_name).encode())
            self._schemas[type_name] = schema
        qos = self._qos.get(topic, DEFAULT_QOS)
        type_hash = TYPE_HASHES[type_name]
        channel: int = self._writer.register_channel(
            topic, 'cdr', schema, {'offered_qos_profiles': qos_text(qos), 'topic_type_hash': type_hash}
        )
        self._channels[topic] = channel
        self.topics[topic] = TopicCount(topic, type_name, qos, type_hash)
        return channel

    def information(self) -> dict[str, Any]:
        """The tree of ``metadata.yaml`` for what was written so far."""
        return bag_information(
            self.path.name,
            list(self.topics.values()),
            self.start_ns,
            self.end_ns,
            {'psd_deflection_version': __version__},
        )

    def close(self) -> None:
        """Write index and summary and close; does nothing the second time."""
        if self._stream is None:
            return
        with self._guard():
            self._writer.add_metadata('rosbag2', {'serialized_metadata': to_yaml(self.information())})
            self._writer.finish()
            self._stream.close()
        self._stream = None

    # A recorder is a sink like any other.
    put = write

    def __enter__(self) -> McapFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class BagWriter(McapFile):
    """A rosbag2 bag being written: ``NAME/NAME_0.mcap``, and ``NAME/metadata.yaml`` at the end.

    ``rig_values``: the flat parameter set, effects included. ``qos``: topic to profile
    (:func:`psd_deflection.io.bag_metadata.qos_profile`) where it is not the default one.
    Raises RecordingError where the folder exists already or cannot be made.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        rig_values: Mapping[str, object],
        device_hello: Mapping[str, object] | None = None,
        qos: Mapping[str, Qos] | None = None,
    ) -> None:
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True)
        except FileExistsError:
            raise RecordingError(f'{self.folder}: exists already; a recording is never overwritten') from None
        except OSError as error:
            raise RecordingError(f'{self.folder}: cannot be made ({error.strerror or error})') from None
        name = self.folder.resolve().name
        super().__init__(self.folder / f'{name}_0.mcap', rig_values=rig_values, device_hello=device_hello, qos=qos)

    def close(self) -> None:
        """Close the file, then write ``metadata.yaml``; does nothing the second time.

        A bag whose file ended with an error gets no ``metadata.yaml``: ``ros2 bag reindex`` makes
        one of what is there, and our reader needs none.
        """
        if self.closed:
            return
        super().close()
        target = self.folder / 'metadata.yaml'
        partial = self.folder / 'metadata.yaml.partial'
        try:
            partial.write_text(to_yaml({'rosbag2_bagfile_information': self.information()}), encoding='utf-8')
            partial.replace(target)
        except OSError as error:
            raise RecordingError(f'{target}: cannot be written ({error.strerror or error})') from None
