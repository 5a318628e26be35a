# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A calibration from the live page: ``psd-deflection calibrate --live`` as a process of its own, and what it says."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from psd_deflection.run.monitor.shown import RejectedError

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
