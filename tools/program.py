# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Runs a program as a process and reads its output, for tests, campaigns and the check of documented commands."""

import contextlib
import fcntl
import os
import pty
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

WAIT_S = 240.0
"""Longest wait for what is expected: with ten busy loops on two cores it may come a hundred times as late as alone."""
ROOT = Path(__file__).resolve().parent.parent
PSD_DEFLECTION = (sys.executable, '-m', 'psd_deflection')  # How our own program is started in this environment.


def copy_checkout(target: Path, *words: str) -> Path:
    """Copy the files that git tracks, or lists with ``words``, into ``target``, with their times; return it."""
    listed = subprocess.run(['git', 'ls-files', '-z', *words], cwd=ROOT, check=True, capture_output=True, text=True)
    for name in filter(None, listed.stdout.split('\0')):
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)
    return target


@contextlib.contextmanager
def ros_domain() -> Iterator[int]:
    """A ROS_DOMAIN_ID that nobody else has, held by a lock. RuntimeError if none is free."""
    # Each domain takes ports of its own; those above 99 are in the range that systems use for others. In any order: a
    # container beside us has its own locks and the same network.
    for candidate in random.sample(range(20, 100), 80):
        with (Path(tempfile.gettempdir()) / f'psd_deflection_test_domain_{candidate}').open('w') as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield candidate
            return
    raise RuntimeError('no ROS domain is free')


Words = Sequence[str]
Env = Mapping[str, str] | None


class Program:
    """``command`` in a new session, without input; stdout and stderr are read together. ``terminal``: it writes to a
    terminal; otherwise into a pipe. ``wait_s`` limits each wait."""

    def __init__(
        self, command: Words, cwd: Path = ROOT, *, terminal: bool = False, env: Env = None, wait_s: float = WAIT_S
    ) -> None:
        self._wait_s = wait_s
        self._fd, theirs = pty.openpty() if terminal else os.pipe()
        nothing, ours = subprocess.DEVNULL, {**os.environ, 'PYTHONUNBUFFERED': '1', **(env or {})}
        self.process = subprocess.Popen(
            command, cwd=cwd, stdin=nothing, stdout=theirs, stderr=theirs, start_new_session=True, env=ours
        )
        os.close(theirs)
        self._output = b''
        self._ended = False
        self._new = threading.Condition()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while True:
            try:
                new = os.read(self._fd, 65536)
            except OSError:
                # A terminal whose last program has ended reads as an error, a pipe as nothing.
                new = b''
            with self._new:
                self._output += new
                self._ended = not new
                self._new.notify_all()
            if not new:
                break
        os.close(self._fd)

    @property
    def text(self) -> str:
        return self._output.decode(errors='replace')

    @property
    def lines(self) -> list[str]:
        """The lines that are complete; a live line is complete when the next one replaces it."""
        lines = re.split(r'[\r\n]+', self.text)
        return [line for line in (lines if self._ended else lines[:-1]) if line]

    def until(self, pattern: str) -> re.Match[str]:
        """Wait for the first match in a line. RuntimeError if the program ends or the time runs out first."""
        matches: list[re.Match[str]] = []

        def look() -> bool:
            matches.extend(match for line in self.lines if (match := re.search(pattern, line)))
            return bool(matches) or self._ended

        with self._new:
            self._new.wait_for(look, self._wait_s)
        if not matches:
            raise RuntimeError(f'{pattern!r} was not said, but:\n{self.text[-4000:]}')
        return matches[0]

    def send(self, number: int) -> None:
        """Send a signal to the program and its children; does nothing if they have ended."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def wait(self) -> int:
        """Wait for the end; return the exit status. Past the time limit it is killed, and RuntimeError raised."""
        try:
            status = self.process.wait(self._wait_s)
        except subprocess.TimeoutExpired:
            raise RuntimeError(f'it did not end, but said:\n{self.text[-4000:]}') from None
        finally:
            if self.process.poll() is None:
                self.send(signal.SIGKILL)
                self.process.wait()
            self._thread.join(self._wait_s)
        return status

    def end(self, number: int = signal.SIGINT) -> int:
        """Send Ctrl-C (or another signal) if it still runs; return its exit status."""
        if self.process.poll() is None:
            self.send(number)
        return self.wait()
