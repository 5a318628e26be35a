# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the reader puts on its queue, the samples that wait to be put there, and counters of what was sent or lost."""

import queue
from dataclasses import dataclass, field
from typing import NamedTuple

from psd_deflection.base.bounds import Tally
from psd_deflection.records import ParameterChange, RawChunk


@dataclass(slots=True)
class Arrival:
    """A RawChunk on its way, with the monotonic time at which its last byte was read, ns.

    ``dropped_before``: samples of the run that were dropped before it, because the queue was full.
    """

    raw: RawChunk
    read_ns: int
    dropped_before: int = 0


@dataclass(slots=True)
class Restarted:
    """On the queue: the device restarted; the unfinished block gets no more samples.

    ``change``: what the recording says of it; None if no sample was taken before, or after many
    restarts.
    """

    change: ParameterChange | None


class Annotation(NamedTuple):
    """On the queue: something that the recording is to have, and no estimate depends on."""

    change: ParameterChange


class Ended:
    """On the queue: nothing follows."""


Item = Arrival | Restarted | Annotation | Ended


class ItemQueue:
    """First in, first out; counts the chunks of samples, because a note must not take the room of a block.

    One thread puts arrivals, one takes items.
    """

    def __init__(self) -> None:
        self._items: queue.SimpleQueue[Item] = queue.SimpleQueue()  # Bound: queue_blocks, RECORDED_RESTARTS.
        self._arrived = self._taken = 0

    def put(self, item: Item) -> None:
        """Append an item; never waits."""
        self._arrived += isinstance(item, Arrival)
        self._items.put(item)

    def get(self, timeout: float = 0.0) -> Item:
        """The oldest item. Raises queue.Empty if none comes within ``timeout`` (s)."""
        item = self._items.get(timeout > 0.0, timeout or None)
        self._taken += isinstance(item, Arrival)
        return item

    def empty(self) -> bool:
        """Whether no item waits."""
        return self._items.empty()

    def qsize(self) -> int:
        """Number of items that wait."""
        return self._items.qsize()

    @property
    def blocks(self) -> int:
        """Number of arrivals that wait."""
        return self._arrived - self._taken


@dataclass(slots=True)
class SampleBuffer:
    """Samples that wait to be handed over, one row each: extended number, time and readings as in the source."""

    seq: list[int] = field(default_factory=list)  # Bound: one block.
    t: list[int] = field(default_factory=list)  # Bound: one block.
    readings: list[tuple[float, ...]] = field(default_factory=list)  # Bound: one block.
    flags: list[int] = field(default_factory=list)  # Bound: one block.

    def add(self, number: int, t: int, readings: tuple[float, ...], flags: int) -> None:
        """One more."""
        self.seq.append(number)
        self.t.append(t)
        self.readings.append(readings)
        self.flags.append(flags)


BY_DEVICE = 'dropped by the device'
DAMAGED = 'damaged on the wire'
AWAY = 'while the port was away'
UNSEEN = 'on the wire, without a trace'
"""Why samples are missing."""


@dataclass(slots=True)
class AcquisitionCounters:
    """Samples and frames received and lost. Only the reader writes; any thread may read.

    ``map_steps``: of the time map, by more than a millisecond; ``squeezed``: samples with stamps 1 ns apart after one.
    ``queue_dropped``: samples that were read, and for which there was no room to wait; ``abandoned``: those that still
    waited at the end of the run; ``dropped_why``: the last reason of either.
    """

    bytes: int = 0
    samples: int = 0
    lost: int = 0
    lost_by: Tally = field(default_factory=Tally)
    repeated: int = 0
    queue_dropped: int = 0
    abandoned: int = 0
    dropped_why: str = ''
    device_dropped: int = 0
    device_overruns: int = 0
    restarts: int = 0
    disconnects: int = 0
    silences: int = 0
    rejected_reopenings: int = 0
    clock_jumps: int = 0
    map_steps: int = 0
    squeezed: int = 0
    pings: int = 0
    pongs: int = 0
    bad_frames: Tally = field(default_factory=Tally)
    temperature: float | None = None

    @property
    def bad(self) -> int:
        """Malformed frames, all reasons together."""
        return self.bad_frames.total()

    @property
    def dropped_here(self) -> int:
        """Samples that were read and are not processed."""
        return self.queue_dropped + self.abandoned

    def count_lost(self, missing: int, cause: str) -> None:
        """Count ``missing`` samples as lost."""
        self.lost += missing
        self.lost_by.add(cause, missing)
