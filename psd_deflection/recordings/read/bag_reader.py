# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads bags (folders) and single MCAP files: our own and those of ``ros2 bag record`` and other programs.

Sample numbers are recorded modulo 2^32. They are extended again, so that the blocks are those of the writer (2^32 is
not a multiple of 20).
"""

import contextlib
import functools
import re
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
from psd_deflection.recordings.read.mcap_reader import McapReader, RawMessage
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
    RigState,
    SampleBlock,
    TemperatureReading,
)

MAX_YAML_BYTES = 16_000_000

MOST_MEMORIES = 4
"""So many of the states that a pipeline tells are kept: the one from before the first block, and those after it."""

MAX_RESTARTS = 10_000
"""Restarts of one recording that are counted."""

LEAP_NS = 10_000_000_000
"""A recorder that does not keep up is late by less."""

_BATCH = 50
"""Number of messages whose samples are decoded at once: numpy's cost is per call."""

T = TypeVar('T')


class BagRecording(Recording):
    """A bag folder or a single ``.mcap``. Raises RecordingError if nothing in it can be read.

    ``namespace``: of the node that was recorded (``/arm``). None: it is found, and every call that reads messages
    raises RecordingError if the bag holds several rigs. Topics have their own names here, without the namespace.
    """

    def __init__(self, path: Path, block_size: int | None = None, namespace: str | None = None) -> None:
        super().__init__(path, block_size)
        self._own_warnings = Warnings()
        self._leapt = False
        files = self._files_of(path) if path.is_dir() else [path]
        self._sources = [McapReader(f) for f in files]
        bare = None if namespace is None else namespace.strip('/')
        self._given_namespace = f'/{bare}' if bare else bare
        metadata: dict[str, dict[str, str]] = {}
        for source in self._sources:
            metadata.update(source.metadata)
        software = metadata.get(META_SOFTWARE, {})
        self.own = META_SOFTWARE in metadata
        self.version, self.node = software.get('version', ''), software.get(META_NODE, '')
        self.dropped_here = _dropped(metadata.get(META_DROPPED, {}))
        self._take_rig()
        self.restarts = self._recorded_restarts()

    def _files_of(self, folder: Path) -> list[Path]:
        """The bag's files in the order of ``metadata.yaml``, else of their numbers."""
        meta_file = folder / 'metadata.yaml'
        found = files_in(folder)
        if not meta_file.is_file():
            if not found:
                raise RecordingError(f'{folder}: is no bag: it holds neither metadata.yaml nor an .mcap file')
            self._own_warnings.add(f'{folder}: has no metadata.yaml (a recorder that was stopped hard?)')
            return found
        information = read_information(meta_file)
        storage = information.get('storage_identifier')
        # `ros2 bag reindex` leaves it empty; the file says itself what it is.
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
        named = information.get('relative_file_paths')
        if not isinstance(named, list) or not named or not all(isinstance(n, str) for n in named):
            raise RecordingError(f'{meta_file}: relative_file_paths names no file')
        # Bags before version 4 have the folder's name before the file's.
        files = [folder / PurePath(n).name for n in named]
        for file in files:
            if not file.is_file():
                raise RecordingError(
                    f'{file}: is named by metadata.yaml and is not there; `psd-deflection recover` makes that one anew'
                )
        for file in found:
            if file not in files:
                self._own_warnings.add(
                    f'{file}: is not listed in metadata.yaml and is not read; `psd-deflection recover` lists all files'
                )
        return files

    @property
    def complete(self) -> bool:
        """True if every file has its end and everything read so far was undamaged."""
        return not any(s.warnings for s in self._sources)

    @property
    def warnings(self) -> Sequence[str]:
        """One line for each cut or damage, and for samples that were left out."""
        return [*self._own_warnings.lines(), *self._found.lines(), *(w for s in self._sources for w in s.warnings)]

    def _warn(self, text: str) -> None:
        self._own_warnings.add(f'{self.path}: {text}')

    def _note_restart(self, last: int, first: int) -> None:
        if len(self.restarts) < MAX_RESTARTS:
            self.restarts.add((last, first))

    def _take_rig(self) -> None:
        """Parameters, hello and changes as the topic of the rig has them."""
        changes: dict[ParameterChange, None] = {}
        present: dict[str, object] = {}
        for channel, log_time, message in self.messages([RIG]):
            if channel.type != TOPIC_TYPES[RIG] or channel.encoding != 'cdr':
                continue
            try:
                state = string.to_rig(cdr.decode(channel.type, message))
                change = _to_change(state.t_ns, state.block, state.changed)
                memory = _memory_in(state)
            except (ValueError, TypeError) as error:
                self._warn(f'{RIG} at log time {log_time} ns is not readable ({error}) and is left out')
                continue
            if not self.parameters:
                self.parameters, self.version = state.parameters, state.version
                self.made_with = state.made_with
                present = dict(state.parameters)
            if self.hello is None:
                self.hello = state.hello
            present |= {name: value for name, value in state.changed.items() if name in present}
            if present != state.parameters and change not in changes:
                self._warn(f'another rig starts at log time {log_time} ns; the first one is taken for all')
            if change.values:
                changes[change] = None
            if memory is not None and len(self.memories) < MOST_MEMORIES:
                self.memories = [*self.memories, memory]
        self.changes = sorted(changes, key=lambda change: change.block)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Encoded messages of the files: (channel, log_time, cdr), of ``topics`` or of all."""
        namespace = self.namespace
        if not namespace:
            for source in self._sources:
                yield from source.messages(topics)
            return
        names = self._names
        wanted = {name for name, ours in names.items() if topics is None or ours in topics}
        for source in self._sources:
            for channel, log_time, message in source.messages(wanted):
                yield RawMessage(channel._replace(topic=names[channel.topic]), log_time, message)

    @functools.cached_property
    def namespace(self) -> str:
        """Namespace of the recorded node, '' if it has none. Raises RecordingError if there are several."""
        if self._given_namespace is not None:
            return self._given_namespace
        known = self._recorded_topics()
        if not any(topic.endswith(SAMPLES) for topic in known):
            # A cut file names its topics where its chunks begin.
            if self._first_of(SAMPLES) is not None:
                return ''
            known = self._recorded_topics()
        if SAMPLES in known:
            return ''
        found = [topic for topic in sorted(known) if topic.endswith(SAMPLES) and self._has_samples(topic)]
        if len(found) > 1:
            choices = ', '.join(topic.removesuffix(SAMPLES) for topic in found)
            raise RecordingError(
                f'{self.path}: holds the samples of {len(found)} rigs; give the namespace of one: {choices}'
            )
        return found[0].removesuffix(SAMPLES) if found else ''

    def _recorded_topics(self) -> set[str]:
        return {c.topic for s in self._sources for c in s.channels}

    def _first_of(self, topic: str) -> RawMessage | None:
        return next((m for s in self._sources for m in s.messages([topic])), None)

    def _has_samples(self, topic: str) -> bool:
        """Whether the messages of ``topic`` are ours, by the fields of the first one."""
        first = self._first_of(topic)
        if first is None or first.channel.type != TOPIC_TYPES[SAMPLES] or first.channel.encoding != 'cdr':
            return False
        try:
            CloudDecoder().decode(first.cdr)
        except ValueError:
            return False
        return True

    @functools.cached_property
    def _names(self) -> dict[str, str]:
        """Recorded name -> our name. What the namespace lacks is taken from outside, unless another rig is there."""
        if not self.complete:
            self._first_of('')
        recorded = self._recorded_topics()
        inside = {t: t.removeprefix(self.namespace) for t in recorded if t.startswith(f'{self.namespace}/')}
        rigs = [t for t in recorded if t.endswith(SAMPLES)]
        if len(rigs) > 1:
            return {DIAGNOSTICS: DIAGNOSTICS, **inside}
        return {t: t for t in recorded if t not in inside.values()} | inside

    def topics(self) -> dict[str, int]:
        """Number of messages of each topic."""
        counts: dict[str, int] = {}
        for channel, _, _ in self.messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
        return counts

    @property
    def has_samples(self) -> bool:
        """Whether there is a message of samples."""
        return next(self.messages([SAMPLES]), None) is not None

    def blocks(self) -> Iterator[SampleBlock]:
        """The samples, cut into blocks at seq // block_size. Raises RecordingError if there are none."""
        blocks = super().blocks()
        first = next(blocks, None)
        if first is None:
            cut = '' if self.complete else ' before the cut'
            cut += f' in the namespace {self.namespace}' if self.namespace else ''
            raise RecordingError(
                f'{self.path}: holds no samples{cut} (topic {SAMPLES}); `psd-deflection info` lists what it holds'
            )
        yield first
        yield from blocks

    def _chunks(self) -> Iterator[RawChunk]:
        count = RecordedSequence(self.block_size, self._warn, self._note_restart)
        psds = 0
        for log_time, messages in self._clouds():
            together = joined_points(messages)
            parts = (
                [together]
                if count.follows(together.seq, together.t_ns, together.full)
                else [joined_points([m]) for m in messages]
            )
            for part in parts:
                try:
                    seq = count.extended(part.seq, part.t_ns, part.full)
                except ValueError as error:
                    raise RecordingError(f'{self.path}: {SAMPLES} at log time {log_time} ns: {error}') from None
                _, _, t_ns, volts, flags = part
                psds = psds or volts.shape[1] // 3
                if volts.shape[1] != 3 * psds:
                    raise RecordingError(
                        f'{self.path}: {SAMPLES} at log time {log_time} ns: has {volts.shape[1] // 3} PSDs, '
                        f'the samples before have {psds}'
                    )
                finite = np.isfinite(volts).all(axis=1)
                if finite.all():
                    yield RawChunk(seq, t_ns, volts, flags)
                    continue
                self._warn('samples that are not numbers (NaN or infinite) are left out as lost')
                yield RawChunk(seq[finite], t_ns[finite], volts[finite], flags[finite])

    def _clouds(self) -> Iterator[tuple[int, list[tuple[int, npt.NDArray[np.void]]]]]:
        """Yields (log time, messages as (stamp, points)); all messages of one yield have the same layout."""
        decoder = CloudDecoder()
        batch: list[tuple[int, npt.NDArray[np.void]]] = []
        first_time = 0
        late: int | None = None
        for channel, log_time, message in self.messages([SAMPLES]):
            self._check_type(channel.type, channel.encoding, SAMPLES)
            try:
                stamp, points = decoder.decode(message)
            except ValueError as error:
                raise RecordingError(f'{self.path}: {SAMPLES} at log time {log_time} ns: {error}') from None
            if late is not None and abs(log_time - stamp - late) > LEAP_NS and not self._leapt:
                self._leapt = True
                leap = (log_time - stamp - late) / 1e9
                self._warn(
                    f"the recorder's clock leapt by {leap:+.3f} s at log time {log_time} ns; samples keep their own "
                    'times, marks and inputs without a stamp do not'
                )
            late = log_time - stamp
            if batch and (len(batch) == _BATCH or points.dtype != batch[0][1].dtype):
                yield first_time, batch
                batch = []
            if len(points):
                first_time = first_time if batch else log_time
                batch.append((stamp, points))
        if batch:
            yield first_time, batch

    def _check_type(self, found: str, encoding: str, topic: str, wanted: str = '') -> None:
        wanted = wanted or TOPIC_TYPES[topic]
        if found != wanted or encoding != 'cdr':
            raise RecordingError(f'{self.path}: {topic} is {found!r} in {encoding!r}, not {wanted} in cdr')

    def _decoded(self, topic: str, convert: Callable[[dict[str, Any]], T]) -> list[T]:
        """Every message of ``topic``; a message without a stamp (0) gets its time of arrival."""
        out = []
        for channel, log_time, message in self.messages([topic]):
            self._check_type(channel.type, channel.encoding, topic)
            try:
                fields = cdr.decode(channel.type, message)
                if stamp_ns(fields) == 0:
                    fields['header'] = header(log_time, fields['header']['frame_id'])
                out.append(convert(fields))
            except ValueError as error:
                raise RecordingError(f'{self.path}: {topic} at log time {log_time}: {error}') from None
        return out

    def loads(self) -> list[AppliedLoad]:
        """Known loads, each held until the next."""
        return self._decoded(LOAD, wrench_stamped.to_applied_load)

    def marks(self) -> list[Mark]:
        """The moments that somebody marked, each at its arrival. A live run rejects what is left out here, too."""
        out = []
        for channel, log_time, message in self.messages([MARK]):
            self._check_type(channel.type, channel.encoding, MARK)
            try:
                mark = string.to_mark(cdr.decode(channel.type, message))
            except ValueError as error:
                self._warn(f'{MARK} at log time {log_time} ns is left out: {error}')
            else:
                out.append(mark._replace(t_ns=log_time))
        return sorted(out, key=lambda mark: mark.t_ns)

    def accelerations(self) -> Iterator[tuple[int, BaseAcceleration]]:
        """Known accelerations of the base, with the time of arrival. A live run rejects what is left out here, too."""
        for channel, log_time, message in self.messages([ACCELERATION]):
            self._check_type(channel.type, channel.encoding, ACCELERATION)
            with contextlib.suppress(ValueError):
                yield log_time, accel_stamped.to_base(cdr.decode(channel.type, message))

    def references(self) -> list[ReferencePose]:
        """Independent measurements of the tip."""
        return self._decoded(REFERENCE, pose_stamped.to_reference)

    def references_with_covariance(self) -> list[ReferenceWithCovariance]:
        """The same with their covariances, if they were recorded."""
        return self._decoded(REFERENCE_WITH_COVARIANCE, pose_with_covariance_stamped.to_reference)

    def temperatures(self) -> list[TemperatureReading]:
        """Ambient temperatures."""
        return self._decoded(TEMPERATURE, temperature.to_reading)

    def estimates(self) -> dict[str, EstimateSeries]:
        """Recorded deflections by topic: the primary one, with covariance, and each solver's."""
        rows: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
        for channel, log_time, message in self.messages():
            topic = channel.topic
            if topic == DEFLECTION_WITH_COVARIANCE:
                wanted = pose_with_covariance_stamped.MESSAGE.name
            elif topic != FILTERED and topic.startswith('/link_tip/') and topic.endswith('/deflection'):
                wanted = pose_stamped.MESSAGE.name
            else:
                continue
            self._check_type(channel.type, channel.encoding, topic, wanted)
            try:
                rows.setdefault(topic, []).append(cdr.numbers(wanted, message))
            except ValueError as error:
                raise RecordingError(f'{self.path}: {topic} at log time {log_time}: {error}') from None
        marks = tuple(self.marks())
        return {topic: _series(topic, found, marks) for topic, found in rows.items()}


def _to_change(t_ns: int, block: int, tree: Mapping[str, object]) -> ParameterChange:
    def number(value: object) -> float:
        # Unchanged: an integer must be read back as an integer.
        if isinstance(value, int | float):
            return value
        raise TypeError

    values: list[tuple[str, float | str | tuple[float, ...]]] = []
    for key, value in tree.items():
        if isinstance(value, list):
            values.append((key, tuple(map(number, value))))
        else:
            values.append((key, value if isinstance(value, str) else number(value)))
    return ParameterChange(t_ns, block, tuple(values))


def _memory_in(state: RigState) -> ParameterChange | None:
    """All that the pipeline remembers, as a change from which another one goes on; None if it is not told."""
    if state.memory is None:
        return None
    return _to_change(state.t_ns, state.block, {FULL: 1.0, **state.memory})


def _series(topic: str, rows: list[tuple[int, tuple[float, ...]]], marks: tuple[Mark, ...]) -> EstimateSeries:
    t_ns = np.array([t for t, _ in rows], dtype=np.int64)
    numbers = np.array([v for _, v in rows], dtype=np.float64)
    pose, tilt = pose_stamped.to_poses(numbers)
    covariance = pose_with_covariance_stamped.to_covariances(numbers) if topic == DEFLECTION_WITH_COVARIANCE else None
    return EstimateSeries(topic, t_ns, pose, tilt, covariance, marks=marks)


def files_in(folder: Path) -> list[Path]:
    """The ``.mcap`` files of a folder in the order of their numbers."""

    def number(path: Path) -> tuple[int, str]:
        found = re.search(r'_([0-9]{1,9})$', path.stem)
        return (int(found[1]) if found else -1, path.name)

    return sorted((f for f in folder.glob('*.mcap') if f.is_file()), key=number)


def read_information(path: Path) -> dict[str, Any]:
    """The content of ``metadata.yaml``. Raises RecordingError if it cannot be used."""
    way_out = '`psd-deflection recover` makes it anew'
    try:
        tree = tree_of_file(path, "bag's metadata", MAX_YAML_BYTES)
    except ConfigError as error:
        raise RecordingError(f'{error}; {way_out}') from None
    information = tree.get('rosbag2_bagfile_information') if isinstance(tree, dict) else None
    if not isinstance(information, dict):
        raise RecordingError(f'{path}: has no rosbag2_bagfile_information; {way_out}')
    return information


def _dropped(entry: Mapping[str, str]) -> tuple[int, int]:
    counts = [entry.get(name, '0') for name in ('samples', 'messages')]
    samples, messages = (int(c) if c.isascii() and c.isdecimal() and len(c) < 16 else 0 for c in counts)
    return samples, messages
