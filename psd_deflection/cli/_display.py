# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The terminal display of a session: one live line, and messages above it."""

import contextlib
import math
import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from psd_deflection.base.axes import SHOWN, SHOWN_UNITS, SYMBOLS
from psd_deflection.base.errors import RecordingError, SamplesDroppedError
from psd_deflection.base.log import ERROR, INFO, WARNING
from psd_deflection.cli._report import program
from psd_deflection.run.session import Session

REFRESH_S = 0.25
PLAIN_REFRESH_S = 5.0
PLAIN_REFRESH_LATER_S = 60.0

_SIGNS = {WARNING: '[WARN] ', ERROR: '[ERROR] '}


class Display:
    """One live line on a terminal; elsewhere lines, soon one a minute. Any thread may call its methods."""

    def __init__(self) -> None:
        self._live = sys.stderr.isatty()
        self._wait = REFRESH_S if self._live else PLAIN_REFRESH_S
        self._lock = threading.Lock()
        self._last = 0.0
        self._shown = False
        self._last_count = 0
        self._recorded: dict[Path, Mapping[Path, str]] = {}

    def watch(self, session: Session) -> None:
        """Watch a running session: show its state, and remember its recordings."""
        self.note_recorded(session)
        self.update(session)

    def note_recorded(self, session: Session) -> None:
        """Remember the recording that the session makes, for :meth:`tell_recorded`."""
        folder = session.recorder.folder
        if folder is not None:
            self._recorded[folder] = session.recorder.ended_early

    @contextlib.contextmanager
    def report_recorded(self) -> Iterator[None]:
        """At the end of a run print the recordings that were made, also if something of them is missing."""
        try:
            yield
        except (SamplesDroppedError, RecordingError):
            self._notify_recorded()
            raise
        self._notify_recorded()

    def _notify_recorded(self) -> None:
        """Print the recordings that were made, and how to replay them."""
        for folder, ended_early in self._recorded.items():
            if folder.is_dir():
                rest = '; it ended early' if folder in ended_early else ''
                replay = f'{program()} replay {shlex.quote(str(folder))} --compare'
                self.log(f'recorded {folder}{rest}\n  replay it:  {replay}')

    def log(self, text: str, level: int = INFO, /) -> None:
        """Print a message on its own line, above the live one."""
        with self._lock:
            self._put(f'{_SIGNS.get(level, "")}{text}\n', shown=False)

    def update(self, session: Session) -> None:
        """Show the state, if an update is due."""
        self.show(session.acquisition.counters.samples, lambda rate: live_line(session, rate))

    def show(self, count: int, line: Callable[[float], str]) -> None:
        """Show ``line`` of the rate (1/s) at which ``count`` grows, if an update is due."""
        now = time.monotonic()
        passed = now - self._last
        if passed < self._wait:
            return
        if self._last and not self._live:
            # In a journal regular lines are noise; changes have their own messages.
            self._wait = min(2.0 * self._wait, PLAIN_REFRESH_LATER_S)
        rate = (count - self._last_count) / passed if self._last else math.nan
        if count < self._last_count:
            # Another session, which counts from zero.
            rate = math.nan
        self._last, self._last_count = now, count
        text = line(rate)
        with self._lock:
            self._put(text + ('' if self._live else '\n'), shown=self._live)

    def _put(self, text: str, shown: bool) -> None:
        clear = '\r\x1b[K' if self._shown else ''
        self._shown = shown
        # The terminal may be gone; the calling thread reads or records and must continue.
        with contextlib.suppress(OSError, ValueError):
            print(clear + text, end='', file=sys.stderr, flush=True)


def live_line(session: Session, rate: float) -> str:
    """Rate, dX, dY in um, theta in mdeg with their standard deviations, losses."""
    counters = session.acquisition.counters
    estimate, spots = session.pipeline.last_estimate, session.pipeline.last_spots
    head = f'{rate:6.0f} samples/s' if rate == rate else '     ? samples/s'
    dropped = counters.queue_dropped + session.recorder.dropped
    tail = f'lost {counters.lost + dropped}, bad frames {counters.bad}'
    if session.recorder.folder is not None:
        tail += '  ● rec'
    if rate == 0.0:
        # While the device sends nothing, an old estimate would look like a new one.
        body = 'no samples: the device is away' if session.acquisition.away else 'no samples come'
    elif estimate is not None:
        pose = estimate.dx, estimate.dy, estimate.theta
        shown = zip(SYMBOLS, pose, estimate.variances, SHOWN, SHOWN_UNITS, strict=True)
        body = '  '.join(
            f'{a} {v * factor:+9.2f} ± {math.sqrt(var) * factor:.2f} {unit}' for a, v, var, factor, unit in shown
        )
    else:
        body = f'no estimate: {spots.reason}' if spots is not None and spots.reason else 'no estimate yet'
    return f'{head}  {body}  {tail}'
