# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pipeline thread: takes chunks off the queue and gives records to the sinks. Requests of other threads run between
two blocks and must not wait for anything."""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from psd_deflection.base.log import INFO, WARNING, LogCallback
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import Record
from psd_deflection.run.arrivals import Annotation, Arrival, ItemQueue, Restarted
from psd_deflection.run.realtime import lag_reason

T = TypeVar('T')

REQUEST_TIMEOUT_S = 2.0
"""Time limit for a request to begin, and again for it to end, s."""

MOST_WAITING = 10_000
"""Requests that may wait while something holds up the pipeline."""

LATENCY_NS = 1_000_000_000
"""Latencies are reported over this time."""

INTERVAL_S = 1.0
"""Minimum time between two lines about estimates."""


class RecordSink(Protocol):
    """Takes records."""

    def put(self, record: Record) -> None:
        """One record, in order."""


@dataclass(slots=True)
class Latency:
    """Last byte read -> the block's records given to all sinks, over the last second, s."""

    median: float
    worst: float


class OutageLog:
    """Reports when estimates stop and why, and when they resume: one line a second at most.

    Blocks that were affected in between are counted in the next line.
    """

    def __init__(self, log: LogCallback) -> None:
        self._log = log
        self._last_line = -INTERVAL_S
        self._now = ''
        self._text = ''
        self._blocks = 0
        self._changes = 0

    def block(self, cause: str, text: str, now: float) -> None:
        """Take one block. ``cause``: '' if all is well. ``text``: the line to print. ``now``: monotonic time, s."""
        if cause != self._now:
            self._changes += 1
            self._now, self._text = cause, text
        self._blocks += bool(cause)
        if not self._changes or now - self._last_line < INTERVAL_S:
            return
        line = self._text if cause else 'estimates are back'
        if self._changes > 1 or (not cause and self._blocks):
            noun = 'block' if self._blocks == 1 else 'blocks'
            line += f' ({self._blocks} {noun} affected since the last line)'
        self._last_line = now
        self._blocks = self._changes = 0
        self._log(line, WARNING if cause else INFO)


class Processing:
    """Runs ``pipeline`` over ``items`` until one of them is Ended; ``sinks`` get the records in this order.

    ``dropped_before``: samples that were dropped on the way here, before those that were processed
    last. ``clock``: monotonic time, ns; the same clock as that of the chunks' ``read_ns``.
    """

    def __init__(
        self, items: ItemQueue, pipeline: Pipeline, log: LogCallback, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.pipeline = pipeline
        self.sinks: list[RecordSink] = []
        self.failed: BaseException | None = None
        self.beat = time.monotonic()
        self.dropped_before = 0
        self.requests_dropped = 0
        self._items = items
        self._clock = clock
        # Bound: MOST_WAITING; of those that are waited for, one a thread.
        self._requests: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]]] = queue.SimpleQueue()
        self._latencies: deque[tuple[int, float]] = deque()  # Bound: one second.
        self._heard_ns = clock()
        self._thread = threading.Thread(target=self._run, name='pipeline', daemon=True)
        self._outage_log = OutageLog(log)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def join(self, timeout: float | None = None) -> None:
        """Wait until everything that was read is processed. Stop the acquisition first."""
        if self._thread.ident is not None:
            self._thread.join(timeout)

    def lag_reason(self) -> str:
        """Why blocks wait for it, in words."""
        return lag_reason(self._thread, time.monotonic() - self.beat)

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def latency(self) -> Latency | None:
        """Latencies of the blocks of the last second, or None if there was none."""
        since = self._clock() - LATENCY_NS
        taken = sorted(seconds for at, seconds in tuple(self._latencies) if at >= since)
        return Latency(taken[len(taken) // 2], taken[-1]) if taken else None

    def silent_s(self) -> float:
        """Time since the samples arrived that were processed last, s."""
        return (self._clock() - self._heard_ns) / 1e9

    def request(self, action: Callable[[], T]) -> T:
        """Run ``action`` between two blocks and return its result; its errors are raised here.

        Raises TimeoutError if it cannot begin within ``REQUEST_TIMEOUT_S``; then it never runs.
        Raises TimeoutError with another message if it has begun and does not end in that time.
        """
        asked: Future[T] = Future()
        self._requests.put((asked, action))
        if not self.alive:
            self._carry_out()
        if not wait((asked,), REQUEST_TIMEOUT_S).done:
            if asked.cancel():
                raise TimeoutError('no data flows')
            if not wait((asked,), REQUEST_TIMEOUT_S).done:
                raise TimeoutError('it was begun and has not ended: something holds up the pipeline')
        return asked.result()

    def later(self, action: Callable[[], object]) -> None:
        """Run ``action`` between two blocks and do not wait for it; it is dropped if ``MOST_WAITING`` wait already."""
        if self._requests.qsize() >= MOST_WAITING:
            self.requests_dropped += 1
        else:
            self._requests.put((Future(), action))

    def give(self, records: Iterable[Record]) -> int:
        """Hand each record to every sink as it comes; return the number of records."""
        count = 0
        for record in records:
            count += 1
            for sink in self.sinks:
                sink.put(record)
        return count

    def _run(self) -> None:
        try:
            while True:
                self.beat = time.monotonic()
                try:
                    item = self._items.get(timeout=0.1)
                except queue.Empty:
                    self._carry_out()
                    continue
                if isinstance(item, Arrival):
                    self._heard_ns = item.read_ns
                    self.dropped_before = item.dropped_before
                    if self.give(self.pipeline.process(item.raw)):
                        self._note_latency(item.read_ns)
                        self._notify_rejections()
                elif isinstance(item, Annotation):
                    self.give([item.change])
                elif isinstance(item, Restarted):
                    self.give(self.pipeline.flush())
                    if item.change is not None:
                        self.give([item.change])
                else:
                    self.give(self.pipeline.flush())
                    self._carry_out()
                    return
                self._carry_out()
        except BaseException as error:
            self.failed = error
            raise

    def _carry_out(self) -> None:
        while True:
            try:
                asked, action = self._requests.get_nowait()
            except queue.Empty:
                return
            # The caller that gave up was told that the action did not run.
            if not asked.set_running_or_notify_cancel():
                continue
            try:
                asked.set_result(action())
            except Exception as error:
                asked.set_exception(error)

    def _note_latency(self, read_ns: int) -> None:
        now = self._clock()
        self._latencies.append((now, (now - read_ns) / 1e9))
        while self._latencies[0][0] < now - LATENCY_NS:
            self._latencies.popleft()

    def _notify_rejections(self) -> None:
        spots = self.pipeline.last_spots
        if spots is None:
            return
        estimate = self.pipeline.last_estimate
        cause = spots.status.name if spots.reason else ''
        text = f'no estimate: {spots.reason}'
        if cause and estimate is not None:
            cause += ' degraded'
            without = ' and '.join(f'psd_{psd}' for psd in spots.excluded)
            how = f'without {without}' if without else 'translation from one detector alone'
            text = f'degraded, {how}: {spots.reason}'
        self._outage_log.block(cause, text, time.monotonic())
