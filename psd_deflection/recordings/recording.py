# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Interface of all recordings: bags, single MCAP files and CSV."""

from __future__ import annotations

import abc
import copy
import functools
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar, overload

import numpy as np
import numpy.typing as npt

from msg_adapters import LOAD, REFERENCE, SAMPLES, TEMPERATURE
from psd_deflection.base.drawings import plotted
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.tables import Table, html_table
from psd_deflection.base.text import sanitize
from psd_deflection.measure.averaging import BlockCutter
from psd_deflection.recordings.charts import moments, samples_chart
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.mcap_format import Warnings
from psd_deflection.recordings.read.mcap_reader import RawMessage
from psd_deflection.recordings.sample_table import digest_of, sample_dtype, samples_table
from psd_deflection.recordings.spans import Bound, span_ns
from psd_deflection.records import (
    RESTART,
    AppliedLoad,
    BaseAcceleration,
    Mark,
    Moment,
    ParameterChange,
    RawChunk,
    ReferencePose,
    ReferenceWithCovariance,
    SampleBlock,
    TemperatureReading,
    channel_names,
)

if TYPE_CHECKING:
    import pandas
    import xarray

    from psd_deflection.base.figures import ShownFigure

DEFAULT_BLOCK_SIZE = 20
LONGEST_REPR = 2000
EPOCH_FROM_NS = 10**18
"""September 2001; smaller times do not count from the epoch."""
SQUEEZED_NS = 100
"""Samples whose stamps are no further apart have no times of their own, ns."""

Held = TypeVar('Held', AppliedLoad, TemperatureReading)


class Recording(abc.ABC):
    """An opened recording. Every iterator starts from the front and may be taken more than once.

    ``path``: what was opened. ``parameters``: the flat parameter set it was made with, {} if it holds
    none. ``hello``: the device's, or None. ``version``: of the software that recorded, or ''.
    ``made_with``: what computed it (:func:`psd_deflection.recordings.provenance.provenance`), {} if it does not say.
    ``node``: full name of the ROS node that recorded itself, or ''.
    ``dropped_here``: samples and messages that it lacks because the machine that recorded did not keep up.
    ``recorded_by_us``: whether our recorder wrote it, which counts every message that it could not write.
    ``changes``: of parameters during the run, in order. ``memories``: the first few times that the pipeline said all
    that it remembered, each with the block before which that was. ``restarts``: of the device, each as the last sample
    number before and the first after; the numbers between belong to no sample. ``restarts`` and ``warnings``
    (one line each) are complete after the first full pass over the recording. ``requested_block_size``: None takes
    the recorded one. ``temperatures_held``: whether each temperature holds until the next one, as in the rows of a CSV;
    otherwise they are points on a curve.
    """

    temperatures_held = False

    def __init__(self, path: Path, block_size: int | None) -> None:
        self.path = path
        self.parameters: Mapping[str, Any] = {}
        self.hello: Mapping[str, Any] | None = None
        self.version = ''
        self.made_with: Mapping[str, str] = {}
        self.node = ''
        self.dropped_here = (0, 0)
        self.recorded_by_us = False
        self.changes: Sequence[ParameterChange] = ()
        self.memories: Sequence[ParameterChange] = ()
        self.restarts: set[tuple[int, int]] = set()
        self.requested_block_size = block_size
        self._later_warnings = Warnings()

    @property
    def namespace(self) -> str:
        """Namespace of the recorded node, '' if it had none."""
        return ''

    @property
    def block_size(self) -> int:
        """Samples per block: the requested number, else the recorded one, else 20."""
        if self.requested_block_size is not None:
            return self.requested_block_size
        recorded = self.parameters.get('block_size')
        return recorded if isinstance(recorded, int) and 1 <= recorded <= 1000 else DEFAULT_BLOCK_SIZE

    def with_block_size(self, block_size: int) -> Self:
        """The same recording, cut into blocks of another number of samples."""
        if block_size == self.block_size:
            return self
        other = copy.copy(self)
        other.requested_block_size = block_size
        # After a restart numbers go on with the next block, so they depend on its size.
        other.__dict__.pop('samples', None)
        other.restarts = self._recorded_restarts()
        return other

    def crop(self, first: Bound | None = None, last: Bound | None = None) -> Recording:
        """The part from ``first`` on and before ``last``: s from the first sample, times with a time zone, marks.

        ``mark:TEXT`` is the first mark with this text; as ``last`` the first one after the start.
        The load and the temperature that held at its start belong to it. Raises RecordingError if no sample lies in
        it, or it has no such mark; ConfigError if ``first`` is not below ``last``, or a text is no bound.
        """
        return RecordingWindow(self, first, last)

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.samples)

    def __bool__(self) -> bool:
        """True: it is there, and need not be read for that."""
        return True

    @property
    def start(self) -> datetime | None:
        """The time of the first sample, UTC; None if its times do not count from the epoch."""
        first_ns = int(self.samples['t_ns'][0])
        return datetime.fromtimestamp(first_ns / 1e9, UTC) if first_ns >= EPOCH_FROM_NS else None

    @property
    def duration(self) -> float:
        """Seconds that the samples last, by their stamps: to the end of the last one."""
        return self.lasts(*self.samples['t_ns'][[0, -1]].tolist())

    @overload
    def __getitem__(self, part: str) -> npt.NDArray[Any]: ...

    @overload
    def __getitem__(self, part: slice) -> Recording: ...

    def __getitem__(self, part: str | slice) -> npt.NDArray[Any] | Recording:
        """``recording[2.0:5.0]`` is ``recording.crop(2.0, 5.0)``; ``recording['x1']`` a column of its table.

        Raises KeyError for a column that is not there.
        """
        if isinstance(part, str):
            return self._table().column(part)
        if not isinstance(part, slice) or part.step is not None:
            raise ConfigError(f'recording[{part!r}]: must be a part of time, as recording[2.0:5.0]')
        return self.crop(part.start, part.stop)

    def _recorded_restarts(self) -> set[tuple[int, int]]:
        """The restarts that the recorder noted, before any pass over the recording."""
        return {r for change in self.changes if (r := _restart_in(change)) is not None}

    def memory_from(self, first: int) -> ParameterChange | None:
        """What the pipeline remembered before block ``first``, the recording's first one, or before one after it.

        None if that is not recorded, or if the blocks are cut to another size.
        """
        if self.block_size != self.parameters.get('block_size'):
            return None
        return next((memory for memory in self.memories if memory.block >= first), None)

    @property
    @abc.abstractmethod
    def complete(self) -> bool:
        """False if the end is missing or a part that was read is damaged."""

    @property
    @abc.abstractmethod
    def warnings(self) -> Sequence[str]:
        """Faults that did not stop the reading."""

    def warn(self, text: str) -> None:
        """Add to ``warnings`` what was found while it was used."""
        self._later_warnings.add(text)

    def blocks(self) -> Iterator[SampleBlock]:
        """The samples, cut into blocks at seq // block_size.

        Raises RecordingError if there are none, or if they cannot be read.
        """
        cutter = BlockCutter(self.block_size)
        for chunk in self._chunks():
            yield from cutter.add(chunk, chunk.readings.astype(np.float32, copy=False))
        yield from cutter.flush()

    @functools.cached_property
    def psds(self) -> int:
        """PSDs of which it holds samples. Raises RecordingError if it holds none."""
        first = next(self.blocks(), None)
        return 2 if first is None else first.volts.shape[1] // 3

    def lost(self, first: int, last: int, present: int) -> int:
        """Samples lost from number ``first`` to ``last``, of which ``present`` are there."""
        missing = last - first + 1 - present
        if missing and self.restarts:
            before, after = np.array(list(self.restarts), np.int64).T
            missing -= int(np.clip(np.minimum(last + 1, after) - np.maximum(first, before + 1), 0, None).sum())
        return max(missing, 0)

    @abc.abstractmethod
    def _chunks(self) -> Iterator[RawChunk]:
        """The samples in order, any number at a time, in volts; ``seq`` always increases."""

    @abc.abstractmethod
    def topics(self) -> dict[str, int]:
        """Number of messages of each topic; for a CSV, as in a bag of the same samples."""

    @abc.abstractmethod
    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Encoded messages of the files, of ``topics`` or of all; none from a CSV."""

    @abc.abstractmethod
    def loads(self) -> list[AppliedLoad]:
        """Known loads, each held until the next."""

    def marks(self) -> list[Mark]:
        """The moments that somebody marked, in order of time."""
        return []

    def moments(self) -> tuple[Moment, ...]:
        """The marks, s from the first sample."""
        return moments(self.marks(), int(self.samples['t_ns'][0]))

    def rows_with_load(self) -> tuple[int, int]:
        """Number of rows of a CSV that say their load, and the time of the last one, ns; (0, 0) for others."""
        return 0, 0

    def accelerations(self) -> Iterator[tuple[int, BaseAcceleration]]:
        """Known accelerations of the base as they came, each with the time (ns) when it was there."""
        return iter(())

    @abc.abstractmethod
    def references(self) -> list[ReferencePose]:
        """Independent measurements of the tip."""

    def references_with_covariance(self) -> list[ReferenceWithCovariance]:
        """The same with their covariances, if they were recorded."""
        return []

    @abc.abstractmethod
    def temperatures(self) -> list[TemperatureReading]:
        """Ambient temperatures."""

    @abc.abstractmethod
    def estimates(self) -> dict[str, EstimateSeries]:
        """Recorded deflections by topic; {} if none were recorded."""

    @property
    def name(self) -> str:
        """Its file or folder and, if it is a part, from when to when: for what is computed from it."""
        return self.path.name

    @property
    def digest(self) -> str:
        """SHA-256 of its files; '' if it has none. Raises RecordingError if one cannot be read."""
        return digest_of(self.path)

    @functools.cached_property
    def sample_rate_hz(self) -> float:
        """Samples a second, from the sample numbers and times of the first thousand or so."""
        before: tuple[int, int] | None = None
        steps: list[tuple[int, int]] = []
        n_samples = 0
        for block in self.blocks():
            for n, t_ns in ((int(block.seq[i]), int(block.t_ns[i])) for i in (0, -1)):
                # Stamps 1 ns apart are those after a step of the time map: no rate.
                if before is not None and t_ns - before[1] > SQUEEZED_NS * (n - before[0]) > 0:
                    steps.append((n - before[0], t_ns - before[1]))
                    n_samples += n - before[0]
                before = n, t_ns
            if n_samples >= 1000:
                break
        if not steps:
            return 0.0
        # Across a step, stamps and numbers disagree.
        period = float(np.median([t_ns / n for n, t_ns in steps]))
        even = [(n, t_ns) for n, t_ns in steps if abs(t_ns - period * n) <= 0.5 * period * n]
        count, lasted = np.sum(even if 2 * len(even) > len(steps) else steps, axis=0).tolist()
        return float(count * 1e9 / lasted)

    @property
    def has_samples(self) -> bool:
        """Whether there are samples in it; a bag may hold messages of other nodes alone."""
        return True

    def lasts(self, first_ns: int, last_ns: int) -> float:
        """Seconds from the sample at ``first_ns`` to the end of the one at ``last_ns``, by their stamps."""
        rate = self.sample_rate_hz
        return (last_ns - first_ns) * 1e-9 + (1.0 / rate if rate > 0.0 else 0.0)

    @functools.cached_property
    def samples(self) -> npt.NDArray[np.void]:
        """Every sample as a structured array (n,) of :func:`sample_dtype`, read at first use."""
        blocks = list(self.blocks())
        out = np.empty(sum(len(b.seq) for b in blocks), sample_dtype(blocks[0].volts.shape[1] // 3))
        out['seq'] = np.concatenate([b.seq for b in blocks])
        out['t_ns'] = np.concatenate([b.t_ns for b in blocks])
        out['t'] = (out['t_ns'] - out['t_ns'][0]) * 1e-9
        volts = np.concatenate([b.volts for b in blocks])
        for i, channel in enumerate(channel_names(volts.shape[1] // 3)):
            out[channel] = volts[:, i]
        out['flags'] = np.concatenate([b.flags for b in blocks])
        return out

    def _table(self) -> Table:
        beside = (self.loads(), self.temperatures(), self.references())
        return samples_table(self.samples, self.psds, *beside, str(self.path))

    def to_pandas(self, *, clock: bool = False) -> pandas.DataFrame:
        """One row a sample, in volts, with the columns of a CSV, over ``t`` (s), or over the UTC if ``clock``.

        Loads and temperatures are held; they are NaN before the first, which is unknown. A reference is in the first
        row at or after its time. ``.attrs['units']`` has the units.
        Raises RecordingError if there are no samples, ConfigError if pandas is not installed.
        """
        return self._table().to_pandas(clock=clock)

    def to_xarray(self) -> xarray.Dataset:
        """The same as a dataset over ``t`` (s); every variable has ``units`` and ``long_name``.

        Raises RecordingError if there are no samples, ConfigError if xarray is not installed.
        """
        return self._table().to_xarray()

    def plot(self) -> ShownFigure:
        """The samples over time, with the marks, as a matplotlib figure; of a part: ``.crop(2.0, 5.0).plot()``.

        A notebook shows it; ``.savefig('a.png')`` writes it. Raises RecordingError if there are no samples,
        ConfigError if matplotlib is not installed.
        """
        return plotted(samples_chart(self.samples, self.psds, self.moments()))

    def _summary(self) -> list[tuple[str, object]]:
        """What is known without reading all of it."""
        rows: list[tuple[str, object]] = []
        if self.hello is not None:
            rows.append(('device', self.hello.get('serial', 'without a serial number')))
        if self.namespace:
            rows.append(('namespace', self.namespace))
        rows.append(('parameters', len(self.parameters) or 'none recorded'))
        if 'samples' in self.__dict__:
            samples = self.samples
            rows += [('samples', len(samples)), ('duration', f'{self.duration:.3f} s')]
        if 'sample_rate_hz' in self.__dict__:
            rows.append(('sample rate', f'{self.sample_rate_hz:g} Hz'))
        return rows

    def __repr__(self) -> str:
        try:
            words = f'{self.path}: ' + ', '.join(f'{name} {value}' for name, value in self._summary())
        except RecordingError as error:
            words = str(error)
        return f'<{type(self).__name__} {sanitize(words, LONGEST_REPR)}>'

    def _repr_html_(self) -> str:
        rows: list[tuple[str, object]] = []
        try:
            rows += [('sample rate', f'{self.sample_rate_hz:g} Hz'), *self.topics().items()]
            rows = [*(row for row in self._summary() if row[0] != 'sample rate'), *rows]
        except RecordingError as error:
            rows.append(('cannot be read', error))
        return html_table(f'{type(self).__name__} {self.path}', rows)


class RecordingWindow(Recording):
    """The samples of ``source`` from ``first`` on and before ``last``, with what was recorded beside them.

    A bound is in s from the first sample of ``source``, a time of the clock, or a mark; None: its start or end. The
    load and the temperature that held at the start come with the start's time. Sample and block numbers stay; so the
    first and the last block may have less samples. Parameters that were changed before the start are among ``changes``.

    Raises as :meth:`Recording.crop` does.
    """

    def __init__(self, source: Recording, first: Bound | None, last: Bound | None) -> None:
        super().__init__(source.path, source.requested_block_size)
        self._source, self._bounds = source, (first, last)
        start = next((int(block.t_ns[0]) for block in source.blocks()), 0)
        self.first_ns, self.end_ns = span_ns(source, start, (first, last))
        ends = '' if last is None else f' to {(self.end_ns - start) / 1e9:g} s'
        self._part = f'from {(self.first_ns - start) / 1e9:g} s{ends}'
        if self.first_ns >= self.end_ns:
            raise ConfigError(f'{source.path}: from {first} to {last}: must rise')
        self.parameters, self.hello, self.version = source.parameters, source.hello, source.version
        self.made_with, self.node, self.recorded_by_us = source.made_with, source.node, source.recorded_by_us
        self.changes: Sequence[ParameterChange] = [c for c in source.changes if c.t_ns < self.end_ns]
        self.restarts = source.restarts
        self.temperatures_held = source.temperatures_held
        if next(self._chunks(), None) is None:
            raise RecordingError(f'{source.path}: has no sample from {first} to {last}')

    @property
    def namespace(self) -> str:
        """That of the recorded node."""
        return self._source.namespace

    @property
    def name(self) -> str:
        """That of the whole, and which part: s from its first sample."""
        return f'{self._source.name}, {self._part}'

    @property
    def digest(self) -> str:
        """Digest of the whole recording's files."""
        return self._source.digest

    def with_block_size(self, block_size: int) -> Self:
        """The same part, cut into blocks of another number of samples."""
        if block_size == self.block_size:
            return self
        return type(self)(self._source.with_block_size(block_size), *self._bounds)

    @property
    def complete(self) -> bool:
        """Of the whole."""
        return self._source.complete

    @property
    def warnings(self) -> Sequence[str]:
        """Of the whole."""
        return self._source.warnings

    def warn(self, text: str) -> None:
        """To those of the whole."""
        self._source.warn(text)

    def _chunks(self) -> Iterator[RawChunk]:
        for block in self._source.blocks():
            inside = (block.t_ns >= self.first_ns) & (block.t_ns < self.end_ns)
            if inside.any():
                yield RawChunk(block.seq[inside], block.t_ns[inside], block.volts[inside], block.flags[inside])

    def topics(self) -> dict[str, int]:
        """Number of messages of each topic; for a CSV, as in a bag of the same samples."""
        counts = Counter(message.channel.topic for message in self.messages())
        if counts:
            return dict(counts)
        beside = {LOAD: len(self.loads()), REFERENCE: len(self.references()), TEMPERATURE: len(self.temperatures())}
        return {SAMPLES: sum(1 for _ in self.blocks())} | {name: count for name, count in beside.items() if count}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Those that were recorded in it; none from a CSV."""
        return (m for m in self._source.messages(topics) if self.has(m.log_time))

    def has(self, t_ns: int) -> bool:
        """Whether a time lies in it, ns."""
        return self.first_ns <= t_ns < self.end_ns

    def _held(self, values: Sequence[Held]) -> list[Held]:
        """Those in it, and the last one before it, from its start on."""
        before = [value for value in values if value.t_ns <= self.first_ns]
        return [value._replace(t_ns=self.first_ns) for value in before[-1:]] + [
            value for value in values if self.first_ns < value.t_ns < self.end_ns
        ]

    def loads(self) -> list[AppliedLoad]:
        """Known loads, each held until the next; the first is that which held at the start."""
        return self._held(self._source.loads())

    def rows_with_load(self) -> tuple[int, int]:
        """As of the whole, in proportion."""
        count, last = self._source.rows_with_load()
        if not count:
            return count, last
        until = min(last, self.end_ns - 1)
        full = part = 0
        for block in self._source.blocks():
            full += int(np.count_nonzero(block.t_ns <= last))
            part += int(np.count_nonzero((block.t_ns >= self.first_ns) & (block.t_ns <= until)))
        return round(count * part / full) if full else 0, until

    def marks(self) -> list[Mark]:
        """Those that were set in it."""
        return [mark for mark in self._source.marks() if self.has(mark.t_ns)]

    def accelerations(self) -> Iterator[tuple[int, BaseAcceleration]]:
        """Those that came in it."""
        return ((t_ns, acceleration) for t_ns, acceleration in self._source.accelerations() if self.has(t_ns))

    def references(self) -> list[ReferencePose]:
        """Independent measurements of the tip."""
        return [reference for reference in self._source.references() if self.has(reference.t_ns)]

    def references_with_covariance(self) -> list[ReferenceWithCovariance]:
        """The same with their covariances, if they were recorded."""
        return [reference for reference in self._source.references_with_covariance() if self.has(reference.t_ns)]

    def temperatures(self) -> list[TemperatureReading]:
        """Ambient temperatures; the first is the last one before the start."""
        return self._held(self._source.temperatures())

    def estimates(self) -> dict[str, EstimateSeries]:
        """Recorded deflections by topic."""
        out = {}
        for topic, series in self._source.estimates().items():
            inside = (series.t_ns >= self.first_ns) & (series.t_ns < self.end_ns)
            if inside.any():
                out[topic] = series.rows(inside)
        return out


def _restart_in(change: ParameterChange) -> tuple[int, int] | None:
    value = dict(change.values).get(RESTART)
    if not isinstance(value, tuple) or len(value) != 2 or not all(isinstance(n, int) for n in value):
        return None
    before, after = int(value[0]), int(value[1])
    return (before, after) if 0 <= before < after < 2**62 else None
