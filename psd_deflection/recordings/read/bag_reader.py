# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads bag folders and single MCAP files, written by this package, by ``ros2 bag record`` or by another program.

A block is the samples with equal ``seq // block_size``. The recorded ``seq`` is modulo 2^32 (in some
recordings, ``seq_high`` has the rest), which is not a multiple of the default block size, 20. So the reader restores
the full numbers; its blocks are then those of the recorded node.
"""

import contextlib
import functools
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from msg_adapters import (
    ACCELERATION,
    DEFLECTION_WITH_COVARIANCE,
    DIAGNOSTICS,
    FILTERED,
    LOAD,
    MARK,
    REFERENCE,
    REFERENCE_WITH_COVARIANCE,
    RIG,
    SAMPLES,
    TEMPERATURE,
    TOPIC_TYPES,
    accel_stamped,
    pose_stamped,
    pose_with_covariance_stamped,
    string,
    temperature,
    wrench_stamped,
)
from msg_adapters.header import header, stamp_ns
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.foreign_yaml import tree_of_file
from psd_deflection.base.sequence import RecordedSequence
from psd_deflection.measure.state import FULL
from psd_deflection.recordings import cdr
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.mcap_format import Warnings
from psd_deflection.recordings.read.clouds import CloudDecoder, joined_points
from psd_deflection.recordings.read.mcap_reader import McapReader, RawMessage, RecordedChannel
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.write.bag_writer import META_DROPPED, META_NODE, META_SOFTWARE
from psd_deflection.records import (
    AppliedLoad,
    BaseAcceleration,
    Mark,
    ParameterChange,
    RawChunk,
    ReferencePose,
    ReferenceWithCovariance,
    SampleBlock,
    TemperatureReading,
)

MAX_YAML_BYTES = 16_000_000
"""Largest ``metadata.yaml`` that is read, bytes: the file is untrusted input."""

MAX_PIPELINE_STATES = 4
"""Largest number of pipeline states (``memories``) that is kept. Each is the state of the processing just before a
block. A replay that starts at block n loads the first state whose block is n or later, on reaching that block."""

MAX_RESTARTS = 10_000
"""Device restarts that are kept: a bound on memory."""

CLOCK_LEAP_NS = 10_000_000_000
"""Largest change of (log time - stamp) that a slow recorder explains, ns. A larger change is a leap of its clock."""

_BATCH_MESSAGES = 50
"""Messages whose points are converted together, because numpy's overhead is per call."""

Converted = TypeVar('Converted')


class BagRecording(Recording):
    """A bag folder or a single ``.mcap`` file. Raises RecordingError if ``path`` is neither or cannot be read.

    ``block_size``: samples per block; None takes the recorded size. ``namespace``: ROS namespace of the recorded node
    (``/arm``). None finds the namespace by the topic of the samples and raises RecordingError if several rigs were
    recorded. Methods name topics without the namespace. :class:`Recording` describes the attributes.
    """

    def __init__(self, path: Path, block_size: int | None = None, namespace: str | None = None) -> None:
        super().__init__(path, block_size)
        self._bag_warnings = Warnings()
        self._clock_leap_reported = False
        files = self._files_of(path) if path.is_dir() else [path]
        self._sources = [McapReader(file) for file in files]
        stripped = None if namespace is None else namespace.strip('/')
        # None: not given; '': the root namespace.
        self._given_namespace = f'/{stripped}' if stripped else stripped
        metadata = {name: entry for source in self._sources for name, entry in source.metadata.items()}
        software = metadata.get(META_SOFTWARE, {})
        self.recorded_by_us = META_SOFTWARE in metadata
        self.version, self.node = software.get('version', ''), software.get(META_NODE, '')
        self.dropped_here = _dropped_counts(metadata.get(META_DROPPED, {}))
        self._read_rig()
        self.restarts = self._recorded_restarts()

    def _files_of(self, folder: Path) -> list[Path]:
        """Return the bag's MCAP files in the order of ``metadata.yaml``; without it, by the numbers in their names."""
        meta_file = folder / 'metadata.yaml'
        present_files = files_in(folder)
        if not meta_file.is_file():
            if not present_files:
                raise RecordingError(f'{folder}: is no bag: it holds neither metadata.yaml nor an .mcap file')
            self._bag_warnings.add(f'{folder}: has no metadata.yaml (a recorder that was stopped hard?)')
            return present_files
        information = read_information(meta_file)
        storage = information.get('storage_identifier')
        # `ros2 bag reindex` leaves the identifier empty. McapReader checks the format of each file itself.
        if storage not in ('mcap', '', None):
            raise RecordingError(
                f'{folder}: is a bag with {storage} storage; only mcap is read: `mcap convert IN.db3 OUT.mcap` or '
                '`ros2 bag convert` make it'
            )
        if information.get('compression_mode') in ('file', 'FILE', 'message', 'MESSAGE'):
            raise RecordingError(
                f'{folder}: is compressed by rosbag2 (compression_mode {information["compression_mode"]}); '
                'record with --storage-preset-profile zstd_fast instead, or unpack it with ros2 bag convert'
            )
        listed = information.get('relative_file_paths')
        if not isinstance(listed, list) or not listed or not all(isinstance(path, str) for path in listed):
            raise RecordingError(f'{meta_file}: relative_file_paths names no file')
        # Before version 4 of metadata.yaml the listed paths begin with the name of the bag's folder.
        listed_files = [folder / PurePath(path).name for path in listed]
        for file in listed_files:
            if not file.is_file():
                raise RecordingError(
                    f'{file}: is listed in metadata.yaml but missing; `psd-deflection recover` makes metadata.yaml anew'
                )
        for file in present_files:
            if file not in listed_files:
                self._bag_warnings.add(
                    f'{file}: is not listed in metadata.yaml and is not read; `psd-deflection recover` lists all files'
                )
        return listed_files

    @property
    def complete(self) -> bool:
        """True if no file is cut, and no damage was found in what has been read so far."""
        return not any(source.warnings for source in self._sources)

    @property
    def warnings(self) -> Sequence[str]:
        """Faults that did not stop the reading, one a line: the bag's, those of ``Recording.warn``, each file's."""
        file_warnings = (line for source in self._sources for line in source.warnings)
        return [*self._bag_warnings.lines(), *self._later_warnings.lines(), *file_warnings]

    def _add_warning(self, text: str) -> None:
        self._bag_warnings.add(f'{self.path}: {text}')

    def _add_restart(self, before: int, after: int) -> None:
        """Keep a device restart: the last sample number before the restart and the first sample number after it."""
        if len(self.restarts) < MAX_RESTARTS:
            self.restarts.add((before, after))

    def _read_rig(self) -> None:
        """Read parameters, versions, ``hello`` (device description), changes and pipeline states from topic ``RIG``."""
        # The keys are an ordered set: a node may send the same change again.
        changes: dict[ParameterChange, None] = {}
        # What each message must have: the first recorded parameters with all changes up to and including its own.
        expected_parameters: dict[str, object] = {}
        for channel, log_time, message in self.messages([RIG]):
            if channel.type != TOPIC_TYPES[RIG] or channel.encoding != 'cdr':
                continue
            try:
                rig_state = string.to_rig(cdr.decode(channel.type, message))
                t_ns, block, memory = rig_state.t_ns, rig_state.block, rig_state.memory
                change = _to_change(t_ns, block, rig_state.changed)
                # FULL marks a change that replaces the complete state of a pipeline.
                pipeline_state = None if memory is None else _to_change(t_ns, block, {FULL: 1.0, **memory})
            except (ValueError, TypeError) as error:
                self._add_warning(f'{RIG} at log time {log_time} ns is not readable ({error}) and is left out')
                continue
            if not self.parameters:
                self.parameters, self.version = rig_state.parameters, rig_state.version
                self.made_with = rig_state.made_with
                expected_parameters = dict(rig_state.parameters)
            if self.hello is None:
                self.hello = rig_state.hello
            expected_parameters |= {
                name: value for name, value in rig_state.changed.items() if name in expected_parameters
            }
            # A message that repeats an earlier change may have other parameters than expected by now, of the same rig.
            if expected_parameters != rig_state.parameters and change not in changes:
                self._add_warning(
                    f'another rig starts at log time {log_time} ns; the first rig is taken for the whole recording'
                )
            if change.values:
                changes[change] = None
            if pipeline_state is not None and len(self.memories) < MAX_PIPELINE_STATES:
                self.memories = [*self.memories, pipeline_state]
        self.changes = sorted(changes, key=lambda change: change.block)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the encoded messages on ``topics`` (None: on all), file by file, in the order of each file."""
        if not self.namespace:
            for source in self._sources:
                yield from source.messages(topics)
            return
        without_namespace = self._without_namespace
        recorded_topics = {recorded for recorded, name in without_namespace.items() if topics is None or name in topics}
        for source in self._sources:
            for channel, log_time, message in source.messages(recorded_topics):
                yield RawMessage(channel._replace(topic=without_namespace[channel.topic]), log_time, message)

    @functools.cached_property
    def namespace(self) -> str:
        """Namespace of the recorded node, '' if it has none. Raises RecordingError if the bag holds several rigs."""
        if self._given_namespace is not None:
            return self._given_namespace
        topics = self._known_topics()
        if not any(topic.endswith(SAMPLES) for topic in topics):
            # A cut file lacks the list of topics at its end: topics become known as its chunks are read.
            if self._first_message_on(SAMPLES) is not None:
                return ''
            topics = self._known_topics()
        if SAMPLES in topics:
            return ''
        sample_topics = [topic for topic in sorted(topics) if topic.endswith(SAMPLES) and self._has_samples_on(topic)]
        if len(sample_topics) > 1:
            choices = ', '.join(topic.removesuffix(SAMPLES) for topic in sample_topics)
            raise RecordingError(
                f'{self.path}: holds the samples of {len(sample_topics)} rigs; give the namespace of one: {choices}'
            )
        return sample_topics[0].removesuffix(SAMPLES) if sample_topics else ''

    def _known_topics(self) -> set[str]:
        """Return the topics known so far, with namespace; those of a damaged file are complete after a full pass."""
        return {channel.topic for source in self._sources for channel in source.channels}

    def _first_message_on(self, recorded_topic: str) -> RawMessage | None:
        """Return the first message on ``recorded_topic``, which includes the namespace; None without such a message."""
        return next((message for source in self._sources for message in source.messages([recorded_topic])), None)

    def _has_samples_on(self, recorded_topic: str) -> bool:
        """Whether the first message on ``recorded_topic`` is a point cloud with the fields of our samples."""
        first = self._first_message_on(recorded_topic)
        if first is None or first.channel.type != TOPIC_TYPES[SAMPLES] or first.channel.encoding != 'cdr':
            return False
        with contextlib.suppress(ValueError):
            CloudDecoder().decode(first.cdr)
            return True
        return False

    @functools.cached_property
    def _without_namespace(self) -> dict[str, str]:
        """Map each recorded topic to its name without the namespace.

        If the bag has only one rig, topics outside the namespace keep their names.
        """
        if not self.complete:
            # Only a full pass shows all topics of a damaged file. No topic is named '': the search reads all.
            self._first_message_on('')
        recorded_topics = self._known_topics()
        prefix = f'{self.namespace}/'
        inside = {topic: topic.removeprefix(self.namespace) for topic in recorded_topics if topic.startswith(prefix)}
        if sum(topic.endswith(SAMPLES) for topic in recorded_topics) > 1:
            # The topic of the diagnostics never has a namespace.
            return {DIAGNOSTICS: DIAGNOSTICS, **inside}
        # If two topics would get the same name, the topic inside the namespace gets it.
        return {topic: topic for topic in recorded_topics if topic not in inside.values()} | inside

    def topics(self) -> dict[str, int]:
        """Return the number of messages of each topic."""
        return dict(Counter(message.channel.topic for message in self.messages()))

    @property
    def has_samples(self) -> bool:
        """Whether the recording has a message with samples."""
        return next(self.messages([SAMPLES]), None) is not None

    def blocks(self) -> Iterator[SampleBlock]:
        """Yield the samples in blocks of equal ``seq // block_size``. Raises RecordingError if there are none."""
        blocks = super().blocks()
        first_block = next(blocks, None)
        if first_block is None:
            searched = '' if self.complete else ' before the cut'
            searched += f' in the namespace {self.namespace}' if self.namespace else ''
            raise RecordingError(
                f'{self.path}: holds no samples{searched} (topic {SAMPLES}); `psd-deflection info` lists what it holds'
            )
        yield first_block
        yield from blocks

    def _chunks(self) -> Iterator[RawChunk]:
        """Yield the samples in volts with full sample numbers, one batch of messages or one message at a time."""
        numbering = RecordedSequence(self.block_size, self._add_warning, self._add_restart)
        psds = 0
        for log_time, messages in self._message_batches():
            batch = joined_points(messages)
            where = f'{self.path}: {SAMPLES} at log time {log_time} ns'
            # Where a sample number or a time goes back (wrap, restart), messages are numbered one by one.
            # ``batch.full``: a field ``seq_high`` has the high bits, so the numbers do not wrap.
            is_continuous = numbering.follows(batch.seq, batch.t_ns, batch.full)
            parts = [batch] if is_continuous else [joined_points([message]) for message in messages]
            for part in parts:
                try:
                    seq = numbering.extended(part.seq, part.t_ns, part.full)
                except ValueError as error:
                    raise RecordingError(f'{where}: {error}') from None
                # Each PSD has three channels: x, y and sum.
                part_psds = part.volts.shape[1] // 3
                psds = psds or part_psds
                if part_psds != psds:
                    raise RecordingError(f'{where}: has {part_psds} PSDs, the samples before have {psds}')
                finite = np.isfinite(part.volts).all(axis=1)
                if finite.all():
                    yield RawChunk(seq, part.t_ns, part.volts, part.flags)
                    continue
                self._add_warning('samples that are not numbers (NaN or infinite) are left out as lost')
                yield RawChunk(seq[finite], part.t_ns[finite], part.volts[finite], part.flags[finite])

    def _message_batches(self) -> Iterator[tuple[int, list[tuple[int, npt.NDArray[np.void]]]]]:
        """Yield batches of messages with the same point layout: (first log time, [(stamp, points)]), times in ns."""
        decoder = CloudDecoder()
        batch: list[tuple[int, npt.NDArray[np.void]]] = []
        first_log_time = 0
        last_delay_ns: int | None = None
        for channel, log_time, message in self.messages([SAMPLES]):
            self._check_type(channel, TOPIC_TYPES[SAMPLES])
            try:
                stamp, points = decoder.decode(message)
            except ValueError as error:
                raise RecordingError(f'{self.path}: {SAMPLES} at log time {log_time} ns: {error}') from None
            delay_ns = log_time - stamp
            leap_ns = 0 if last_delay_ns is None else delay_ns - last_delay_ns
            last_delay_ns = delay_ns
            if abs(leap_ns) > CLOCK_LEAP_NS and not self._clock_leap_reported:
                self._clock_leap_reported = True
                self._add_warning(
                    f"the recorder's clock leapt by {leap_ns / 1e9:+.3f} s at log time {log_time} ns; "
                    'samples keep their times; marks and inputs without a stamp have log times, off by the leap'
                )
            if batch and (len(batch) == _BATCH_MESSAGES or points.dtype != batch[0][1].dtype):
                yield first_log_time, batch
                batch = []
            if len(points):
                if not batch:
                    first_log_time = log_time
                batch.append((stamp, points))
        if batch:
            yield first_log_time, batch

    def _check_type(self, channel: RecordedChannel, expected_type: str) -> None:
        """Raise RecordingError unless the messages of ``channel`` have the type ``expected_type``, encoded as CDR."""
        topic, found_type, encoding = channel
        if found_type != expected_type or encoding != 'cdr':
            raise RecordingError(f'{self.path}: {topic} is {found_type!r} in {encoding!r}, not {expected_type} in cdr')

    def _records_on(self, topic: str, convert: Callable[[dict[str, Any]], Converted]) -> list[Converted]:
        """Return the converted messages on ``topic``; a stamp of 0 (not set) is replaced by the log time."""
        records = []
        for channel, log_time, message in self.messages([topic]):
            self._check_type(channel, TOPIC_TYPES[topic])
            try:
                fields = cdr.decode(channel.type, message)
                if stamp_ns(fields) == 0:
                    fields['header'] = header(log_time, fields['header']['frame_id'])
                records.append(convert(fields))
            except ValueError as error:
                raise RecordingError(f'{self.path}: {topic} at log time {log_time}: {error}') from None
        return records

    def loads(self) -> list[AppliedLoad]:
        """Return the known loads at the tip; each acts until the next."""
        return self._records_on(LOAD, wrench_stamped.to_applied_load)

    def marks(self) -> list[Mark]:
        """Return the marks, sorted by their arrival (log time); invalid marks are left out, as in a live run."""
        marks = []
        for channel, log_time, message in self.messages([MARK]):
            self._check_type(channel, TOPIC_TYPES[MARK])
            try:
                mark = string.to_mark(cdr.decode(channel.type, message))
            except ValueError as error:
                self._add_warning(f'{MARK} at log time {log_time} ns is left out: {error}')
            else:
                marks.append(mark._replace(t_ns=log_time))
        return sorted(marks, key=lambda mark: mark.t_ns)

    def accelerations(self) -> Iterator[tuple[int, BaseAcceleration]]:
        """Yield (log time in ns, known acceleration of the base); invalid messages are left out, as in a live run."""
        for channel, log_time, message in self.messages([ACCELERATION]):
            self._check_type(channel, TOPIC_TYPES[ACCELERATION])
            with contextlib.suppress(ValueError):
                yield log_time, accel_stamped.to_base(cdr.decode(channel.type, message))

    def references(self) -> list[ReferencePose]:
        """Return the independent measurements of the tip's pose."""
        return self._records_on(REFERENCE, pose_stamped.to_reference)

    def references_with_covariance(self) -> list[ReferenceWithCovariance]:
        """Return the independent measurements that were recorded with a covariance."""
        return self._records_on(REFERENCE_WITH_COVARIANCE, pose_with_covariance_stamped.to_reference)

    def temperatures(self) -> list[TemperatureReading]:
        """Return the ambient temperatures."""
        return self._records_on(TEMPERATURE, temperature.to_reading)

    def estimates(self) -> dict[str, EstimateSeries]:
        """Return the unfiltered estimates by topic.

        The topics are ``/link_tip/.../deflection`` and ``/link_tip/deflection_with_covariance``.
        """
        rows_by_topic: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
        for channel, log_time, message in self.messages():
            topic = channel.topic
            if topic == DEFLECTION_WITH_COVARIANCE:
                expected_type = pose_with_covariance_stamped.MESSAGE.name
            elif topic != FILTERED and topic.startswith('/link_tip/') and topic.endswith('/deflection'):
                expected_type = pose_stamped.MESSAGE.name
            else:
                continue
            self._check_type(channel, expected_type)
            try:
                rows_by_topic.setdefault(topic, []).append(cdr.numbers(expected_type, message))
            except ValueError as error:
                raise RecordingError(f'{self.path}: {topic} at log time {log_time}: {error}') from None
        marks = tuple(self.marks())
        return {topic: _estimate_series(topic, rows, marks) for topic, rows in rows_by_topic.items()}


def _to_change(t_ns: int, block: int, json_values: Mapping[str, Any]) -> ParameterChange:
    """Return a ParameterChange to ``json_values``. Raises TypeError if one is no number, text or list of numbers."""
    values: list[tuple[str, float | str | tuple[float, ...]]] = []
    for name, value in json_values.items():
        numbers = value if isinstance(value, list) else [value]
        if not isinstance(value, str) and not all(isinstance(number, int | float) for number in numbers):
            raise TypeError
        values.append((name, tuple(value) if isinstance(value, list) else value))
    return ParameterChange(t_ns, block, tuple(values))


def _estimate_series(topic: str, rows: list[tuple[int, tuple[float, ...]]], marks: tuple[Mark, ...]) -> EstimateSeries:
    """Return the estimates on ``topic``; ``rows``: (stamp in ns, all float64 of the message) for each message."""
    t_ns = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    numbers = np.array([values for _, values in rows], dtype=np.float64)
    pose, tilt = pose_stamped.to_poses(numbers)
    covariance = pose_with_covariance_stamped.to_covariances(numbers) if topic == DEFLECTION_WITH_COVARIANCE else None
    return EstimateSeries(topic, t_ns, pose, tilt, covariance, marks=marks)


def files_in(folder: Path) -> list[Path]:
    """Return the ``.mcap`` files in ``folder``: first those without a number, then by number (``run_10.mcap``: 10)."""

    def sort_key(path: Path) -> tuple[int, str]:
        match = re.search(r'_([0-9]{1,9})$', path.stem)
        return (int(match[1]) if match else -1, path.name)

    return sorted((file for file in folder.glob('*.mcap') if file.is_file()), key=sort_key)


def read_information(path: Path) -> dict[str, Any]:
    """Return ``rosbag2_bagfile_information`` of a ``metadata.yaml``. Raises RecordingError for an unusable file."""
    remedy = '`psd-deflection recover` makes it anew'
    try:
        tree = tree_of_file(path, "bag's metadata", MAX_YAML_BYTES)
    except ConfigError as error:
        raise RecordingError(f'{error}; {remedy}') from None
    information = tree.get('rosbag2_bagfile_information') if isinstance(tree, dict) else None
    if not isinstance(information, dict):
        raise RecordingError(f'{path}: has no rosbag2_bagfile_information; {remedy}')
    return information


def _dropped_counts(entry: Mapping[str, str]) -> tuple[int, int]:
    """Return the numbers of samples and of messages that the recorder dropped; an invalid number counts as 0."""
    texts = [entry.get(name, '0') for name in ('samples', 'messages')]
    valid = [text.isascii() and text.isdecimal() and len(text) < 16 for text in texts]
    samples, messages = (int(text) if is_valid else 0 for text, is_valid in zip(texts, valid, strict=True))
    return samples, messages
