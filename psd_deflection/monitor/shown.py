"""The source of the page: a running session, or a recording played in real time."""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any, Protocol

from psd_deflection.config import Rig
from psd_deflection.errors import PsdDeflectionError
from psd_deflection.monitor.feed import Feed
from psd_deflection.pipeline import Pipeline
from psd_deflection.records import RESTART, DiagnosticEntry, DiagnosticReport, ParameterChange, Record, SpotMeans
from psd_deflection.runner.diagnostics import ERROR, OK, WARN, HealthReporter
from psd_deflection.runner.session import Session, why_no_zero, zero_text

LONGEST_WAIT_S = 2.0
"""Longest wait for a pause in a recording, s."""

REQUEST_TIMEOUT_S = 1.0


class RefusedError(Exception):
    """The request cannot be carried out now; the message says why, in one line."""


class Shown(Protocol):
    """Interface of everything that the server can show. Calls come from the server's threads."""

    @property
    def rig(self) -> Rig:
        """The rig with its present zero."""

    def describe(self) -> dict[str, Any]:
        """``kind`` (live, simulated, replay), ``name``, ``recording`` (folder or None)."""

    def health(self, t_ns: int) -> DiagnosticReport:
        """Once a second."""

    def zero(self) -> str:
        """Take the present dots as the unloaded ones; return the result as a line. Raises RefusedError."""

    async def record(self, wanted: bool) -> str:
        """Start or stop a recording; return the result as a line once the disk has answered. Raises RefusedError."""


class ShownSession:
    """A running session."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._health = HealthReporter(session)

    @property
    def rig(self) -> Rig:
        """The rig with its present zero."""
        return self._session.rig

    def describe(self) -> dict[str, Any]:
        """Port, and whether it is recorded."""
        folder = self._session.recorder.folder
        return {
            'kind': 'simulated' if self._session.simulated else 'live',
            'name': self._session.rig.acquisition.port,
            'recording': str(folder) if folder is not None else None,
        }

    def health(self, t_ns: int) -> DiagnosticReport:
        """As on ``/diagnostics``."""
        return self._health.report(t_ns)

    def zero(self) -> str:
        """Take the zero between two blocks."""
        try:
            change = self._session.zero()
        except (TimeoutError, PsdDeflectionError) as error:
            raise RefusedError(f'not zeroed: {error}') from None
        if change is None:
            raise RefusedError(f'not zeroed: {why_no_zero(self._session.pipeline)}')
        return zero_text(self._session.rig)

    async def record(self, wanted: bool) -> str:
        """Start or stop the recorder between two blocks."""
        try:
            asked = await asyncio.to_thread(self._session.record, wanted)
            # Not in a thread pool: a disk that hangs would block one thread after the other, and delay the exit.
            folder = await asyncio.wrap_future(asked)
        except (TimeoutError, PsdDeflectionError) as error:
            raise RefusedError(str(error)) from None
        if folder is None:
            return 'no recording runs'
        return f'recording to {folder}' if wanted else f'recording ended: {folder}'


class ShownRecording:
    """A recording, played once or repeatedly; a separate thread feeds ``feed``.

    ``open_steps``: returns a new pipeline and the records of each of its steps. ``speed``: factor of the
    recorded speed.
    """

    def __init__(
        self,
        name: str,
        open_steps: Callable[[], tuple[Pipeline, Iterator[list[Record]]]],
        feed: Feed,
        say: Callable[[str], None],
        *,
        speed: float = 1.0,
        loop: bool = False,
    ) -> None:
        self.failed: BaseException | None = None
        self._name = name
        self._open = open_steps
        self._feed = feed
        self._say = say
        self._speed = speed
        self._loop = loop
        self._pipeline, self._steps = open_steps()
        self._requests: queue.SimpleQueue[Future[str]] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._woken = threading.Event()
        self._ended = False
        self._lost = 0
        self._last: SpotMeans | None = None
        self._seen = (0, 0, 0)
        self._thread = threading.Thread(target=self._run, name='replay', daemon=True)

    @property
    def rig(self) -> Rig:
        """The recording's, or the one given for it."""
        return self._pipeline.rig

    def start(self) -> None:
        """Start playing."""
        self._thread.start()

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
        """The recording's name."""
        return {'kind': 'replay', 'name': self._name, 'recording': None}

    def health(self, t_ns: int) -> DiagnosticReport:
        """Counts of the part played so far, and why blocks have no estimate."""
        counters = self._pipeline.counters
        samples, estimates, lost = counters.samples, counters.estimates, self._lost
        new_samples = max(samples - self._seen[0], 0)
        new_estimates = max(estimates - self._seen[1], 0)
        new_lost = max(lost - self._seen[2], 0)
        self._seen = (samples, estimates, lost)
        spots = self._last
        pace = 'as fast as recorded' if self._speed == 1.0 else f'{self._speed:g} times as fast as recorded'
        level, message = OK, f'playing {pace}'
        if self._ended:
            message = 'end of the recording'
        elif new_lost:
            level, message = WARN, f'{new_lost} samples lost'
        entries = [
            DiagnosticEntry(
                'psd_deflection: replay',
                level,
                message,
                (('rate (samples/s)', str(new_samples)), ('samples', str(samples)), ('lost', str(lost))),
            )
        ]
        refused = tuple((f'refused: {cause}', str(count)) for cause, count in sorted(counters.refused.items()))
        level, message = OK, 'end of the recording' if self._ended else 'estimates flow'
        if spots is not None and spots.reason:
            level, message = ERROR, spots.reason
        entries.append(
            DiagnosticEntry(
                'psd_deflection: estimates',
                level,
                message,
                (
                    ('rate (estimates/s)', str(new_estimates)),
                    ('estimates', str(estimates)),
                    *refused,
                    *self._pipeline.stamped.words(),
                ),
            )
        )
        return DiagnosticReport(t_ns, tuple(entries))

    def zero(self) -> str:
        """Take the zero between two blocks; it holds for the rest of the playback."""
        if self._ended or self._thread.ident is None:
            raise RefusedError('not zeroed: the recording has ended')
        asked: Future[str] = Future()
        self._requests.put(asked)
        self._woken.set()
        try:
            return asked.result(REQUEST_TIMEOUT_S)
        except TimeoutError:
            if asked.cancel():
                raise RefusedError('not zeroed: no data flows') from None
            # It was begun at this very moment: its answer is the true one.
            return asked.result(REQUEST_TIMEOUT_S)

    async def record(self, wanted: bool) -> str:
        """Refuse: a recording is not recorded again."""
        raise RefusedError('a recording is not recorded again; the command replay writes its answers')

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._lap()
                if not self._loop:
                    break
                self._pipeline, self._steps = self._open()
                self._lost = 0
            self._ended = True
            if not self._stop.is_set():
                self._say(f'{self._name}: end of the recording')
        except BaseException as error:
            self.failed = error
            self._ended = True
            if not isinstance(error, PsdDeflectionError):
                raise
            self._say(str(error))

    def _lap(self) -> None:
        due = time.monotonic()
        last_t_ns: int | None = None
        last_block = -1
        for records in self._steps:
            for record in records:
                if isinstance(record, ParameterChange):
                    # The numbers that a restart left out belong to no sample.
                    before_after = dict(record.values).get(RESTART)
                    if isinstance(before_after, tuple):
                        self._lost -= int(before_after[1] - before_after[0]) - 1
                if isinstance(record, SpotMeans):
                    if last_t_ns is not None:
                        due += min((record.t_ns - last_t_ns) / 1e9 / self._speed, LONGEST_WAIT_S)
                        gone = record.index - last_block - 1
                        self._lost += gone * self.rig.estimator.block_size
                    last_t_ns, last_block = record.t_ns, record.index
                    self._lost += record.lost
                    self._last = record
                self._feed.put(record)
            self._carry_out()
            while not self._stop.is_set() and self._woken.wait(max(due - time.monotonic(), 0.0)):
                self._woken.clear()
                self._carry_out()
            if self._stop.is_set():
                return

    def _carry_out(self) -> None:
        while not self._requests.empty():
            asked = self._requests.get()
            if not asked.set_running_or_notify_cancel():
                continue
            if self._pipeline.zero() is None:
                asked.set_exception(RefusedError(f'not zeroed: {why_no_zero(self._pipeline)}'))
            else:
                text = zero_text(self._pipeline.rig)
                self._say(text)
                asked.set_result(text)
