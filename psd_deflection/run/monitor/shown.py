# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The source of the page: what it has to give, a running session, and its calibration as a process of its own."""

import asyncio
import contextlib
import json
import os
import sys
from pathlib import Path
from typing import Any, Protocol

from psd_deflection.base.errors import PsdDeflectionError
from psd_deflection.measure.steps import REACH_S, RecentDots
from psd_deflection.measure.watch import Alarm
from psd_deflection.records import DiagnosticReport
from psd_deflection.rig.config import Rig
from psd_deflection.run.diagnostics import HealthReporter
from psd_deflection.run.monitor.metrics import Family, of_session
from psd_deflection.run.session import Session
from psd_deflection.run.session_texts import load_text, mark_text, why_no_zero, zero_text
from psd_deflection.run.state import device_file


class RejectedError(Exception):
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

    def metrics(self) -> list[Family]:
        """What was counted since the start."""

    def zero(self, late_s: float) -> str:
        """Take the dots of ``late_s`` s ago as the unloaded ones; return the result as a line. Raises RejectedError."""

    async def record(self, wanted: bool) -> str:
        """Start or stop a recording; return the result as a line once the disk has answered. Raises RejectedError."""

    def load(self, fx: float, fy: float, tz: float, add: bool, ago_s: float | None, late_s: float) -> str:
        """Note a known load (N, N, N m), beside the held one if ``add``; return it as a line. Raises RejectedError.

        ``ago_s``: s for which it has acted already; None: since the last step of the dots. ``late_s``: s for which
        the request was under way.
        """

    def step(self) -> str:
        """How long ago the dots stepped last, s; empty if they did not in the last minute. Raises RejectedError."""

    def mark(self, text: str, late_s: float) -> str:
        """Mark the moment ``late_s`` s ago; return the mark as a line. Raises RejectedError."""

    def play(self, paused: bool | None, seek_s: float | None) -> str:
        """Pause or resume, go to a time from the start; None leaves it. Raises RejectedError."""

    def alarm(self) -> Alarm | None:
        """What the watch holds against the rig now."""

    def history_file(self) -> Path | None:
        """Where the hours of the page are kept from run to run; None if they are not."""


class ShownSession:
    """A running session."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._health = HealthReporter(session)
        self._recent = RecentDots(session.rig)
        session.processing.sinks.append(self._recent)

    @property
    def rig(self) -> Rig:
        """The rig with its present zero."""
        return self._session.rig

    def describe(self) -> dict[str, Any]:
        """Port, whether it is recorded, and the load that is held."""
        folder, load = self._session.recorder.folder, self._session.load
        return {
            'kind': 'simulated' if self._session.simulated else 'live',
            'name': self._session.rig.acquisition.port,
            'recording': str(folder.absolute()) if folder is not None else None,
            'load': [load.fx, load.fy, load.tz] if load is not None else None,
        }

    def health(self, t_ns: int) -> DiagnosticReport:
        """As on ``/diagnostics``."""
        return self._health.report(t_ns)

    def metrics(self) -> list[Family]:
        """Of the session."""
        return of_session(self._session)

    def zero(self, late_s: float) -> str:
        """Take the zero between two blocks."""
        try:
            change = self._session.zero(late_s)
        except (TimeoutError, PsdDeflectionError) as error:
            raise RejectedError(f'not zeroed: {error}') from None
        if change is None:
            raise RejectedError(f'not zeroed: {why_no_zero(self._session.pipeline)}')
        return zero_text(self._session.rig)

    async def record(self, wanted: bool) -> str:
        """Start or stop the recorder between two blocks."""
        try:
            asked = await asyncio.to_thread(self._session.record, wanted)
            # Not in a thread pool: a disk that hangs would block one thread after the other, and delay the exit.
            folder = await asyncio.wrap_future(asked)
        except (TimeoutError, PsdDeflectionError) as error:
            raise RejectedError(str(error)) from None
        if folder is None:
            return 'no recording runs'
        return f'recording to {folder}' if wanted else f'recording ended: {folder}'

    def load(self, fx: float, fy: float, tz: float, add: bool, ago_s: float | None, late_s: float) -> str:
        """Take down a load that acts from now on, or has acted for some time."""
        if ago_s is None:
            ago_s, late_s = self._step_s(), 0.0
        if ago_s is None:
            raise RejectedError(f'not noted: the dots have not stepped in the last {REACH_S:g} s')
        try:
            return load_text(self._session.note_load(fx, fy, tz, add=add, ago_s=ago_s, late_s=late_s), ago_s)
        except ValueError as error:
            raise RejectedError(f'not noted: {error}') from None

    def step(self) -> str:
        """How long ago the dots stepped last."""
        ago_s = self._step_s()
        return '' if ago_s is None else f'{ago_s:.2f}'

    def _step_s(self) -> float | None:
        step_ns = self._recent.step_ns()
        return None if step_ns is None else max((self._session.acquisition.now_ns() - step_ns) / 1e9, 0.0)

    def mark(self, text: str, late_s: float) -> str:
        """Set a mark; say so if no recording has it."""
        try:
            mark = self._session.note_mark(text, late_s)
        except ValueError as error:
            raise RejectedError(f'not marked: {error}') from None
        unkept = '' if self._session.recorder.folder is not None else ' (nothing is recorded now)'
        return mark_text(mark) + unkept

    def play(self, paused: bool | None, seek_s: float | None) -> str:
        """Reject: what is measured cannot be paused."""
        raise RejectedError('only a recording can be paused')

    def alarm(self) -> Alarm | None:
        """Of the watch, if it is on."""
        watcher = self._session.watcher
        return watcher.watch.alarm if watcher is not None else None

    def history_file(self) -> Path | None:
        """Of the device; None if it is a simulated one or a recording, or has no serial number."""
        hello = self._session.acquisition.hello
        serial = hello.info.get('serial') if hello is not None else None
        if self._session.simulated or self.rig.acquisition.source == 'replay' or not serial:
            return None
        return device_file('history', str(serial), '.sqlite')


LONGEST = 1 << 20
"""Bytes of one line of the process; a look at 25 parameters has some 5 kB."""
MOST_NEEDS = 4
"""Motions to do next that the page names."""
ENDS_S = 0.5
"""How long the process may take to end with the daemon, s."""


class PageCalibration:
    """At most one process at a time. All methods run in the thread of the page's server."""

    def __init__(self) -> None:
        self._process: asyncio.subprocess.Process | None = None
        self._listener: asyncio.Task[None] | None = None
        self._out = Path()
        self._shown: dict[str, Any] = {}
        self._last = ''

    @property
    def state(self) -> dict[str, Any] | None:
        """For the page: ``running``, ``out`` (folder), ``last`` (how it ended), and what it said; None before any."""
        if self._process is None:
            return None
        running = self._listener is not None and not self._listener.done()
        return {'running': running, 'out': str(self._out), 'last': self._last, **self._shown}

    async def start(self, url: str, token_variable: str, token: str, out: Path) -> str:
        """Begin one that speaks to the page at ``url`` and writes into ``out``. Raises RejectedError."""
        if self._listener is not None and not self._listener.done():
            raise RejectedError('a calibration runs already')
        command = [sys.executable, '-m', 'psd_deflection', 'calibrate', '--live', '--json']
        self._out, self._shown, self._last = out, {}, ''
        try:
            self._process = await asyncio.create_subprocess_exec(
                *command,
                *('--url', url, '--out', str(out)),
                env={**os.environ, token_variable: token},
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
                limit=LONGEST,
                # Ctrl-C at the daemon's terminal is the daemon's.
                start_new_session=True,
            )
        except OSError as error:
            raise RejectedError(f'not calibrated: {error.strerror or error}') from None
        self._listener = asyncio.create_task(self._listen(self._process))
        return 'calibrating: zero the unloaded link, then hang known loads and note each'

    def stop(self) -> str:
        """Let it end with what it has. Raises RejectedError if none runs."""
        if self._process is None or self._listener is None or self._listener.done():
            raise RejectedError('no calibration runs')
        with contextlib.suppress(ProcessLookupError):
            # As Ctrl-C; SIGINT itself is ignored by whatever a script has started in the background.
            self._process.terminate()
        return f'the calibration ends; its files: {self._out}'

    async def close(self) -> None:
        """End it with the daemon: it writes what it has, if it is quick."""
        if self._listener is None or self._listener.done() or self._process is None:
            return
        with contextlib.suppress(RejectedError):
            self.stop()
        await asyncio.wait([self._listener], timeout=ENDS_S)
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()
        await self._listener

    async def _listen(self, process: asyncio.subprocess.Process) -> None:
        errors = asyncio.create_task(_last_line(process.stderr))
        try:
            async for line in _lines(process.stdout):
                self._take(line)
            status = await process.wait()
            last = await errors
        finally:
            errors.cancel()
        known = 'calibrated' if status == 0 else f'not calibrated: {last or f"exit status {status}"}'
        self._last = known.removeprefix('not calibrated: psd-deflection ')

    def _take(self, line: bytes) -> None:
        """One look at the recording; what the command prints at its end is none."""
        try:
            look = json.loads(line)
        except ValueError:
            return
        if not isinstance(look, dict):
            return
        if isinstance(look.get('waiting'), str):
            self._shown = {'waiting': look['waiting']}
        elif isinstance(look.get('needs'), list) and isinstance(look.get('parameters'), list):
            shown = {key: look.get(key) for key in ('kind', 'seconds', 'determined', 'rejected', 'parameters')}
            self._shown = {**shown, 'needs': look['needs'][:MOST_NEEDS]}


async def _lines(stream: asyncio.StreamReader | None) -> Any:
    while stream is not None:
        try:
            line = await stream.readline()
        except ValueError:
            # Longer than LONGEST: it is no look.
            continue
        if not line:
            return
        yield line


async def _last_line(stream: asyncio.StreamReader | None) -> str:
    last = ''
    async for line in _lines(stream):
        last = line.decode(errors='replace').strip() or last
    return last
