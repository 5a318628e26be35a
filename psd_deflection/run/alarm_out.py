# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Hands each alarm of the watch to a command and to a web address, as one JSON object: in a thread of its own, bounded
in time and number. What fails is said once and counted."""

import contextlib
import os
import queue
import shlex
import shutil
import signal
import subprocess
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from http.client import HTTPException
from pathlib import Path
from typing import IO
from urllib.parse import urlsplit

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import WARNING, LogCallback
from psd_deflection.base.text import json_text
from psd_deflection.measure.watch import Alarm
from psd_deflection.recordings.recording import EPOCH_FROM_NS

COMMAND_S = 10.0
"""Seconds after which a command is ended, with what it started."""
ANSWER_S = 5.0
"""Seconds that a web server may take for each step of its answer."""
PAUSES_S = (1.0, 4.0)
"""Seconds before the second and the third try of a web address."""
MOST_WAITING = 100
"""Alarms that may wait; further ones are counted as not handed on."""
LONGEST_FILE = 4096
"""Characters that are read of a file with an address."""


def finding(alarm: Alarm, about: Mapping[str, object]) -> dict[str, object]:
    """What is handed on: times in UTC (s if the clock counts from 0), the shift and its standard deviation in m, or in
    rad for ``theta``.

    ``about``: where it was seen.
    """
    return {
        'text': f'since {_when(alarm.since_ns)}: {alarm.words}',
        'since': _when(alarm.since_ns),
        'sure_since': _when(alarm.observed_ns),
        'channel': alarm.channel,
        'shift': alarm.shift,
        'sd': alarm.sd,
        'unit': 'rad' if alarm.channel == 'theta' else 'm',
        'also': list(alarm.also),
        **about,
    }


class AlarmOut:
    """``command``: a program and its arguments, as a shell splits them; no shell runs it. It gets the JSON, one
    line, on its standard input. ``webhook``: an ``http`` or ``https`` address, to which it is posted, or a file that
    holds one. '' for neither. ``about``: joins each finding. ``log`` gets a line of what fails.

    Raises ConfigError for a command that is not there and for an address that is none. ``sent``, ``failed``: counts;
    ``failure``: why the last one failed, '' if it did not.
    """

    def __init__(self, command: str, webhook: str, log: LogCallback, about: Mapping[str, object] | None = None) -> None:
        self.sent = self.failed = 0
        self.failure = ''
        self._log, self._about = log, dict(about or {})
        self._ways: list[tuple[str, Callable[[bytes], None]]] = []  # Bound: a command and an address.
        self._logged: set[str] = set()  # Bound: two ways, and alarms that wait.
        if command:
            argv = _argv(command)
            self._ways.append((f'command {argv[0]}', lambda text: _run(argv, text)))
        if webhook:
            address = _address(webhook)
            host = urlsplit(address).hostname
            self._ways.append((f'webhook at {host}', lambda text: _post(address, text, self._ending)))
        self._waiting: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()  # Bound: MOST_WAITING.
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def put(self, alarm: Alarm) -> None:
        """Hand on an alarm; returns at once."""
        if not self._ways:
            return
        if self._waiting.qsize() >= MOST_WAITING:
            self._fail('alarms', f'{MOST_WAITING} wait already')
            return
        self._waiting.put(f'{json_text(finding(alarm, self._about))}\n'.encode())
        if self._thread is None:
            self._thread = threading.Thread(target=self._forward, name='alarms', daemon=True)
            self._thread.start()

    def values(self) -> list[tuple[str, str]]:
        """For ``/diagnostics``; empty if nothing is to be handed on."""
        if not self._ways:
            return []
        return [('alarms handed on', str(self.sent)), ('alarms not handed on', f'{self.failed} {self.failure}'.strip())]

    def close(self, patience_s: float) -> bool:
        """Hand on what waits, without further tries; whether that was done within ``patience_s``."""
        if self._thread is None:
            return True
        self._waiting.put(None)
        self._thread.join(patience_s / 2.0)
        self._ending.set()
        self._thread.join(patience_s / 2.0)
        return not self._thread.is_alive()

    def _forward(self) -> None:
        while (text := self._waiting.get()) is not None:
            for name, way in self._ways:
                try:
                    way(text)
                except _NotForwardedError as error:
                    self._fail(name, str(error))
                else:
                    self.sent += 1
                    self._logged.discard(name)

    def _fail(self, name: str, why: str) -> None:
        self.failed += 1
        self.failure = f'{name}: {why}'
        if name not in self._logged:
            self._logged.add(name)
            self._log(f'watch: {name}: {why}; an alarm was not handed on, and further ones are counted', WARNING)


class _NotForwardedError(Exception):
    """Why one alarm was not handed on."""


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """A redirected POST would become a GET without the alarm: it fails instead."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: object, newurl: str
    ) -> None:
        """None: no redirection."""


_OPENER = urllib.request.build_opener(_NoRedirect)


def _argv(command: str) -> list[str]:
    try:
        argv = shlex.split(command)
    except ValueError as error:
        raise ConfigError(f'watch_command = {command!r}: is no command line ({error})') from None
    if not argv or shutil.which(argv[0]) is None:
        raise ConfigError(f'watch_command = {command!r}: no program of that name can be run')
    return argv


def _address(given: str) -> str:
    text = given
    if '://' not in given:
        try:
            with Path(given).expanduser().open(encoding='utf-8') as file:
                text = file.read(LONGEST_FILE).strip()
        except (OSError, ValueError) as error:
            raise ConfigError(
                f'watch_webhook = {given!r}: is no address, and no file that can be read ({error})'
            ) from None
    try:
        parts = urlsplit(text)
        sound = parts.scheme in ('http', 'https') and bool(parts.hostname) and parts.port != 0
    except ValueError:
        sound = False
    if not sound or not text.isascii() or not text.isprintable() or ' ' in text:
        # What a file holds may be a secret: it is not shown.
        raise ConfigError(f'watch_webhook = {given!r}: must be an address http://… or https://…, or a file with one')
    return text


def _run(argv: list[str], text: bytes) -> None:
    try:
        process = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True)
    except OSError as error:
        raise _NotForwardedError(f'cannot be started ({error.strerror or error})') from None
    try:
        # A command that reads nothing is no failure.
        process.communicate(text, timeout=COMMAND_S)
    except subprocess.TimeoutExpired:
        raise _NotForwardedError(f'did not end within {COMMAND_S:g} s, and was killed') from None
    finally:
        # Also what it left behind.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.returncode:
        raise _NotForwardedError(f'ended with status {process.returncode}')


def _post(address: str, text: bytes, ending: threading.Event) -> None:
    request = urllib.request.Request(address, text, {'Content-Type': 'application/json'}, method='POST')
    for pause in (*PAUSES_S, None):
        try:
            with _OPENER.open(request, timeout=ANSWER_S):
                return
        except urllib.error.HTTPError as error:
            error.close()
            why, again = f'answers {error.code}', error.code >= 500 or error.code == 429
        except (OSError, HTTPException, ValueError) as error:
            reason = getattr(error, 'reason', error)
            why, again = f'cannot be reached ({getattr(reason, "strerror", None) or reason})', True
        if not again or pause is None or ending.wait(pause):
            raise _NotForwardedError(why)


def _when(t_ns: int) -> str:
    """Time in UTC as ISO 8601 has it, to ms; ``3.489 s`` on a clock that does not count from 1970."""
    if t_ns < EPOCH_FROM_NS:
        return f'{t_ns / 1e9:.3f} s'
    s, rest = divmod(t_ns, 1_000_000_000)
    return datetime.fromtimestamp(s, UTC).strftime('%Y-%m-%dT%H:%M:%S') + f'.{rest // 1_000_000:03d}Z'
