# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recording played in real time, as the source of the page."""

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any

from psd_deflection.base.errors import PsdDeflectionError
from psd_deflection.base.log import LogCallback
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import (
    RESTART,
    AppliedLoad,
    DiagnosticEntry,
    DiagnosticReport,
    Mark,
    ParameterChange,
    Record,
    ReferencePose,
    SpotMeans,
)
from psd_deflection.rig.config import Rig
from psd_deflection.run.diagnostics import ERROR, OK, WARN
from psd_deflection.run.monitor.feed import QUEUE_ITEMS, Feed
from psd_deflection.run.monitor.metrics import Family, of_pipeline
from psd_deflection.run.monitor.shown import RejectedError
from psd_deflection.run.session_texts import why_no_zero, zero_text

LONGEST_WAIT_S = 2.0
"""Longest wait for a pause in a recording, s."""

REQUEST_TIMEOUT_S = 1.0

BEFORE_GOAL_NS = 60_000_000_000
"""What lies this long before the time that is sought is shown: the traces are not empty there."""

FULL_S = 0.01
"""Pause while the page's queue is half full."""


@dataclass(slots=True)
class _Playhead:
    """``next_time``: monotonic time of the next record, s; ``t_ns`` and ``block``: of the last one."""

    next_time: float
    t_ns: int | None = None
    block: int = -1


class ShownRecording:
    """A recording, played once or repeatedly; a separate thread feeds ``feed``.

    ``open_steps``: returns a new pipeline and the records of each of its steps. ``speed``: factor of the
    recorded speed. ``inputs``: its loads, references and marks. ``find_span``: finds the times of its first and last
    block, ns, which may take a while; it runs in a thread of its own.
    """

    def __init__(
        self,
        name: str,
        open_steps: Callable[[], tuple[Pipeline, Iterator[list[Record]]]],
        feed: Feed,
        log: LogCallback,
        *,
        speed: float = 1.0,
        loop: bool = False,
        inputs: Iterable[AppliedLoad | ReferencePose | Mark] = (),
        find_span: Callable[[], tuple[int, int]] | None = None,
    ) -> None:
        self.failed: BaseException | None = None
        self._name = name
        self._open = open_steps
        self._feed = feed
        self._log = log
        self._speed = speed
        self._loop = loop
        self._inputs = sorted(inputs, key=lambda r: r.t_ns)
        self._find_span = find_span
        self._span: tuple[int, int] | None = None
        self._pipeline, self._steps = open_steps()
        # Bound: one a connection to the page, which is answered before the next.
        self._requests: queue.SimpleQueue[tuple[Future[str], Callable[[], str]]] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._woken = threading.Event()
        self._ended = False
        self._paused = False
        self._goal: int | None = None
        self._again = False
        self._lost = 0
        self._next_input = 0
        self._load: AppliedLoad | None = None
        self._start_ns: int | None = None
        self._last: SpotMeans | None = None
        self._observed = (0, 0, 0)
        self._observed_ns = time.time_ns()
        self._thread = threading.Thread(target=self._run, name='replay', daemon=True)

    @property
    def rig(self) -> Rig:
        """The recording's, or the one given for it."""
        return self._pipeline.rig

    def start(self) -> None:
        """Start playing."""
        self._thread.start()
        if self._find_span is not None:
            threading.Thread(target=self._look_for_span, args=(self._find_span,), name='span', daemon=True).start()

    def close(self) -> None:
        """Stop playing."""
        self._stop.set()
        self._woken.set()
        if self._thread.ident is not None:
            self._thread.join()

    @property
    def ended(self) -> bool:
        """Whether the last block was played."""
        return self._ended

    def describe(self) -> dict[str, Any]:
        """The recording's name, which part of it is played, and the load that is held there."""
        load = self._load
        return {
            'kind': 'replay',
            'name': self._name,
            'recording': None,
            'load': [load.fx, load.fy, load.tz] if load is not None else None,
            'paused': self._paused,
            'seeking': self._goal is not None,
            'span': [t / 1e9 for t in self._span] if self._span is not None else None,
        }

    def health(self, t_ns: int) -> DiagnosticReport:
        """Counts of the part played so far, rates since the last report, why blocks have no estimate; ``t_ns``: now."""
        counters = self._pipeline.counters
        samples, estimates, lost = counters.samples, counters.estimates, self._lost
        new_samples = max(samples - self._observed[0], 0)
        new_estimates = max(estimates - self._observed[1], 0)
        new_lost = max(lost - self._observed[2], 0)
        seconds = (t_ns - self._observed_ns) / 1e9
        self._observed, self._observed_ns = (samples, estimates, lost), t_ns
        rates = [round(new / seconds) if seconds > 0.0 else 0 for new in (new_samples, new_estimates)]
        spots = self._last
        pace = 'as fast as recorded' if self._speed == 1.0 else f'{self._speed:g} times as fast as recorded'
        level, message = OK, f'playing {pace}'
        if self._ended:
            message = 'end of the recording'
        elif self._paused:
            message = 'paused'
        elif new_lost:
            level, message = WARN, f'{new_lost} samples lost'
        entries = [
            DiagnosticEntry(
                'psd_deflection: replay',
                level,
                message,
                (('rate (samples/s)', str(rates[0])), ('samples', str(samples)), ('lost', str(lost))),
            )
        ]
        rejected = tuple((f'rejected: {cause}', str(count)) for cause, count in sorted(counters.rejected.items()))
        level, message = OK, 'end of the recording' if self._ended else 'estimates flow'
        if spots is not None and spots.reason:
            level, message = ERROR, spots.reason
        elif self._pipeline.estimator.vibrates:
            level, message = WARN, f'vibrates {self._pipeline.estimator.vibrates}: too fast for a block'
        entries.append(
            DiagnosticEntry(
                'psd_deflection: estimates',
                level,
                message,
                (
                    ('rate (estimates/s)', str(rates[1])),
                    ('estimates', str(estimates)),
                    *rejected,
                    *self._pipeline.estimator.words(),
                ),
            )
        )
        return DiagnosticReport(t_ns, tuple(entries))

    def metrics(self) -> list[Family]:
        """Of the part that was played."""
        return of_pipeline(self._pipeline)

    def zero(self, late_s: float) -> str:
        """Take the zero between two blocks; it holds for the rest of the playback."""
        if self._ended or self._thread.ident is None:
            raise RejectedError('not zeroed: the recording has ended')
        return self._between_blocks(partial(self._take_zero, late_s), 'not zeroed: no data flows')

    async def record(self, wanted: bool) -> str:
        """Reject: a recording is not recorded again."""
        raise RejectedError('a recording is not recorded again; the command replay writes its answers')

    def load(self, fx: float, fy: float, tz: float, add: bool, ago_s: float | None, late_s: float) -> str:
        """Reject: what is recorded is not changed."""
        raise RejectedError('a recording is played: its loads are those that were recorded')

    def step(self) -> str:
        """Reject: nothing is noted here."""
        raise RejectedError('a recording is played: its loads are those that were recorded')

    def mark(self, text: str, late_s: float) -> str:
        """Reject: what is recorded is not changed."""
        raise RejectedError('a recording is played: its marks are those that were recorded')

    def play(self, paused: bool | None, seek_s: float | None) -> str:
        """Pause or resume, go to a time from the first block. What lies between is computed as fast as possible."""

        def change() -> str:
            if paused is not None:
                self._paused = paused
            if seek_s is not None and self._start_ns is not None:
                self._goal = self._start_ns + round(seek_s * 1e9)
                self._again = self._last is None or self._last.t_ns >= self._goal
            elif self._ended and paused is False:
                # Played to its end: from the start again.
                self._goal, self._again = self._start_ns, True
            return 'paused' if self._paused else 'playing'

        return self._between_blocks(change, 'not done: the recording cannot be read fast enough')

    def alarm(self) -> None:
        """None: what is played is not watched."""

    def history_file(self) -> None:
        """None: what is played is kept already."""

    def _between_blocks(self, action: Callable[[], str], too_late: str) -> str:
        asked: Future[str] = Future()
        self._requests.put((asked, action))
        self._woken.set()
        try:
            return asked.result(REQUEST_TIMEOUT_S)
        except TimeoutError:
            if asked.cancel():
                raise RejectedError(too_late) from None
            # It was begun at this very moment: its answer is the true one.
            return asked.result(REQUEST_TIMEOUT_S)

    def _take_zero(self, late_s: float) -> str:
        change = self._pipeline.zero(late_s)
        if change is None:
            raise RejectedError(f'not zeroed: {why_no_zero(self._pipeline)}')
        self._feed.put(change)
        text = zero_text(self._pipeline.rig)
        self._log(text)
        return text

    def _look_for_span(self, find: Callable[[], tuple[int, int]]) -> None:
        # A recording that cannot be read is reported by the thread that plays it.
        with contextlib.suppress(PsdDeflectionError):
            self._span = find()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._lap()
                if not self._again:
                    # Sought beyond the end.
                    self._goal = None
                if not self._again and not self._loop:
                    self._wait_at_the_end()
                if self._stop.is_set():
                    break
                self._pipeline, self._steps = self._open()
                self._feed.skip()
                self._again = self._ended = False
                self._lost = self._next_input = 0
                self._load = None
        except BaseException as error:
            self.failed = error
            self._ended = True
            if not isinstance(error, PsdDeflectionError):
                raise
            self._log(str(error), ERROR)

    def _wait_at_the_end(self) -> None:
        self._ended = True
        if not self._stop.is_set():
            self._log(f'{self._name}: end of the recording')
        while not self._stop.is_set() and not self._again:
            self._woken.wait()
            self._woken.clear()
            self._carry_out()

    def _lap(self) -> None:
        at = _Playhead(time.monotonic())
        for records in self._steps:
            for record in records:
                self._show(record, at)
            self._carry_out()
            self._seek(at)
            while not self._stop.is_set() and not self._again and self._waits(at.next_time):
                self._woken.clear()
                self._carry_out()
                if self._paused:
                    at.next_time = time.monotonic()
            if self._stop.is_set() or self._again:
                return

    def _show(self, record: Record, at: _Playhead) -> None:
        """Give the page a record, unless a goal lies far ahead; count losses and when the next one is due."""
        if isinstance(record, ParameterChange):
            # The numbers that a restart left out belong to no sample.
            before_after = dict(record.values).get(RESTART)
            if isinstance(before_after, tuple):
                self._lost -= int(before_after[1] - before_after[0]) - 1
        elif isinstance(record, SpotMeans):
            if self._start_ns is None:
                self._start_ns = record.t_ns
            self._give_inputs(record.t_ns)
            if at.t_ns is not None:
                at.next_time += min((record.t_ns - at.t_ns) / 1e9 / self._speed, LONGEST_WAIT_S)
                self._lost += (record.index - at.block - 1) * self.rig.estimator.block_size
            at.t_ns, at.block = record.t_ns, record.index
            self._lost += record.lost
            self._last = record
        if at.t_ns is None or self._goal is None or at.t_ns > self._goal - BEFORE_GOAL_NS:
            self._feed.put(record)
        else:
            self._feed.skip()

    def _seek(self, at: _Playhead) -> None:
        """On the way to a goal: no faster than the page takes it, and no waiting for what was due."""
        if self._goal is None or at.t_ns is None:
            return
        if at.t_ns < self._goal:
            while self._feed.waiting > QUEUE_ITEMS // 2 and not self._stop.wait(FULL_S):
                pass
        else:
            self._goal = None
        at.next_time = time.monotonic()

    def _waits(self, next_time: float) -> bool:
        """Wait until ``next_time``, or longer if paused; whether a request ended the wait, or it is paused."""
        if self._goal is not None:
            return False
        if self._paused:
            self._woken.wait()
            return True
        return self._woken.wait(max(next_time - time.monotonic(), 0.0))

    def _give_inputs(self, t_ns: int) -> None:
        while self._next_input < len(self._inputs) and self._inputs[self._next_input].t_ns <= t_ns:
            record = self._inputs[self._next_input]
            self._next_input += 1
            if isinstance(record, AppliedLoad):
                self._load = record
            self._feed.put(record)

    def _carry_out(self) -> None:
        while not self._requests.empty():
            asked, action = self._requests.get()
            if not asked.set_running_or_notify_cancel():
                continue
            try:
                asked.set_result(action())
            except RejectedError as error:
                asked.set_exception(error)
