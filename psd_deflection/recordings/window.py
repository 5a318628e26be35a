"""A part of a recording: what was recorded between two times."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from typing import Self, TypeVar

import numpy as np

from msg_adapters import LOAD, REFERENCE, SAMPLES, TEMPERATURE
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.read.mcap_reader import RawMessage
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import (
    AppliedLoad,
    BaseAcceleration,
    ParameterChange,
    RawChunk,
    ReferencePose,
    ReferenceWithCovariance,
    TemperatureReading,
)

Bound = float | datetime
"""s from the first sample, or a time with a time zone."""
Span = tuple[Bound | None, Bound | None]
"""From and up to; None: the start or the end."""
WHOLE: Span = (None, None)
Held = TypeVar('Held', AppliedLoad, TemperatureReading)


class RecordingWindow(Recording):
    """The samples of ``source`` from ``first`` on and before ``last``, with what was recorded beside them.

    A bound is in s from the first sample of ``source``, or a time of the clock; None: its start or end. The load and
    the temperature that held at the start come with the start's time. Sample and block numbers stay; so the first and
    the last block may have less samples. Parameters that were changed before the start are among ``changes``.

    Raises RecordingError if no sample lies in it, ConfigError if ``first`` is not below ``last``.
    """

    def __init__(self, source: Recording, first: Bound | None, last: Bound | None) -> None:
        super().__init__(source.path, source.requested_block_size)
        self._source, self._bounds = source, (first, last)
        start = next((int(block.t_ns[0]) for block in source.blocks()), 0)
        self.first_ns = start if first is None else _ns(first, start)
        self.end_ns = np.iinfo(np.int64).max if last is None else _ns(last, start)
        if self.first_ns >= self.end_ns:
            raise ConfigError(f'{source.path}: from {first} to {last}: must rise')
        self.parameters, self.hello, self.version = source.parameters, source.hello, source.version
        self.made_with, self.node, self.rig_from_messages = source.made_with, source.node, source.rig_from_messages
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
    def digest(self) -> str:
        """Of the files of the whole."""
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
        return (m for m in self._source.messages(topics) if self._has(m.log_time))

    def _has(self, t_ns: int) -> bool:
        return self.first_ns <= t_ns < self.end_ns

    def _held(self, found: Sequence[Held]) -> list[Held]:
        """Those in it, and the last one before it, from its start on."""
        before = [one for one in found if one.t_ns <= self.first_ns]
        return [one._replace(t_ns=self.first_ns) for one in before[-1:]] + [
            one for one in found if self.first_ns < one.t_ns < self.end_ns
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
        whole = part = 0
        for block in self._source.blocks():
            whole += int(np.count_nonzero(block.t_ns <= last))
            part += int(np.count_nonzero((block.t_ns >= self.first_ns) & (block.t_ns <= until)))
        return round(count * part / whole) if whole else 0, until

    def accelerations(self) -> Iterator[tuple[int, BaseAcceleration]]:
        """Those that came in it."""
        return ((t_ns, one) for t_ns, one in self._source.accelerations() if self._has(t_ns))

    def references(self) -> list[ReferencePose]:
        """Independent measurements of the tip."""
        return [one for one in self._source.references() if self._has(one.t_ns)]

    def references_with_covariance(self) -> list[ReferenceWithCovariance]:
        """The same with their covariances, if they were recorded."""
        return [one for one in self._source.references_with_covariance() if self._has(one.t_ns)]

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


def _ns(bound: Bound, start_ns: int) -> int:
    """A bound in ns, by the clock of the recording."""
    if isinstance(bound, datetime):
        return (bound - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000
    return start_ns + round(bound * 1e9)
