# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Passes records from the pipeline thread to the page's thread; it never waits and never grows.

Items that do not fit into the queue are dropped and counted. Publishing and recording are not affected.
"""

import json
import math
import queue
from typing import NamedTuple, TypeGuard

from psd_deflection.measure.watch import Alarm
from psd_deflection.records import (
    RESTART,
    AppliedLoad,
    DeflectionEstimate,
    Mark,
    ParameterChange,
    Record,
    ReferencePose,
    SampleBlock,
    SpotMeans,
    dot_names,
)
from psd_deflection.rig.declarations import ZEROS

QUEUE_ITEMS = 2000
"""Ten seconds at 100 blocks/s and two items per block."""

_LAG = ('dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta', 'present', 'lost', 'status', 'chi_square')


def row_columns(psds: int) -> tuple[str, ...]:
    """Columns of a row on the page: s, -, m, V, m, rad, their standard deviations, samples, BlockStatus, chi-square."""
    return ('t', 'block', *dot_names(psds), *(f'sum{n}' for n in range(1, psds + 1)), *_LAG)


COLUMNS = row_columns(2)
"""Those of two PSDs."""


class BlockResult(NamedTuple):
    """One block's dots, and its primary estimate if it has one. ``gone``: blocks before it of which no sample came."""

    spots: SpotMeans
    estimate: DeflectionEstimate | None
    gone: int = 0


Item = BlockResult | SampleBlock | AppliedLoad | Mark | ReferencePose | ParameterChange


class Feed:
    """A sink of records; :meth:`take` is for one other thread. ``dropped``: items that did not fit.

    Loads, marks and references may come from any thread, the other records from one.
    """

    def __init__(self, limit: int = QUEUE_ITEMS) -> None:
        self.dropped = 0
        self._limit = limit
        self._estimate: DeflectionEstimate | None = None
        self._index: int | None = None
        self._queue: queue.SimpleQueue[Item] = queue.SimpleQueue()  # Bound: QUEUE_ITEMS.

    def put(self, record: Record) -> None:
        """Take one record; kinds that the page does not show are ignored."""
        if isinstance(record, DeflectionEstimate):
            if record.primary:
                self._estimate = record
        elif isinstance(record, SpotMeans):
            best, self._estimate = self._estimate, None
            last, self._index = self._index, record.index
            gone = max(record.index - last - 1, 0) if last is not None else 0
            self._offer(BlockResult(record, best if best is not None and best.block == record.index else None, gone))
        elif isinstance(record, SampleBlock | AppliedLoad | Mark | ReferencePose) or is_zero(record):
            self._offer(record)
        elif isinstance(record, ParameterChange) and any(name == RESTART for name, _ in record.values):
            # The numbers between belong to no sample.
            self.skip()

    def skip(self) -> None:
        """What comes next does not follow on what came: no block between them is lost."""
        self._index = None

    @property
    def waiting(self) -> int:
        """Number of items that wait in the queue."""
        return self._queue.qsize()

    def take(self) -> list[Item]:
        """The items since the last call, in order; does not wait."""
        return [self._queue.get_nowait() for _ in range(self._queue.qsize())]

    def _offer(self, item: Item) -> None:
        if self._queue.qsize() >= self._limit:
            self.dropped += 1
        else:
            self._queue.put(item)


def is_zero(record: Record) -> TypeGuard[ParameterChange]:
    """Whether a record says that the unloaded dots changed."""
    return isinstance(record, ParameterChange) and any(name in ZEROS for name, _ in record.values)


def mark_json(record: AppliedLoad | Mark | ParameterChange | Alarm) -> str:
    """A load as ``[t, "load", fx, fy, tz]``, a mark ``[t, "mark", text]``, a zero ``[t, "zero"]``: s, N, N, N m.

    An alarm of the watch as ``[t, "alarm", words]``, at the time since which the rig is not its model.
    """
    if isinstance(record, Alarm):
        return f'[{_seconds(record.since_ns)},"alarm",{json.dumps(record.words)}]'
    if isinstance(record, Mark):
        return f'[{_seconds(record.t_ns)},"mark",{json.dumps(record.text)}]'
    if isinstance(record, AppliedLoad):
        return f'[{_seconds(record.t_ns)},"load",{record.fx:.7g},{record.fy:.7g},{record.tz:.7g}]'
    return f'[{_seconds(record.t_ns)},"zero"]'


def reference_json(record: ReferencePose) -> str:
    """``[t, dx, dy, theta]``: s, m, m, rad."""
    return f'[{_seconds(record.t_ns)},{record.dx:.7g},{record.dy:.7g},{record.theta:.7g}]'


def _seconds(t_ns: int) -> str:
    # A double holds a time since the epoch only to the microsecond.
    return f'{t_ns // 1_000_000_000}.{t_ns % 1_000_000_000 // 1000:06d}'


def row_json(result: BlockResult) -> str:
    """One row in the order of :func:`row_columns`, as JSON; null for missing numbers."""
    spots, estimate, _ = result
    values: list[float] = [*spots.dots, *spots.sums]
    if estimate is not None:
        values += [*estimate.pose, *(math.sqrt(max(v, 0.0)) for v in estimate.variances)]
    numbers = [f'{v:.7g}' if math.isfinite(v) else 'null' for v in values]
    numbers += ['null'] * (3 * len(spots.sums) + 6 - len(numbers))
    seconds = _seconds(spots.t_ns)
    chi_square = estimate.chi_square if estimate is not None else math.nan
    last = f'{chi_square:.4g}' if math.isfinite(chi_square) else 'null'
    return f'[{seconds},{spots.index},{",".join(numbers)},{spots.present},{spots.lost},{int(spots.status)},{last}]'
