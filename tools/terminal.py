"""A program with a terminal before it, for what runs the documents' commands."""

from __future__ import annotations

import codecs
import contextlib
import os
import pty
import re
import select
import signal
import subprocess
import time
from pathlib import Path

WAIT_S = 400.0


class Terminal:
    """A program with a terminal before it, as a person has one."""

    def __init__(self, line: str, folder: Path, stdin: int = subprocess.DEVNULL) -> None:
        self._fd, theirs = pty.openpty()
        self.process = subprocess.Popen(
            ['bash', '-c', f'exec {line}'],
            cwd=folder,
            stdin=stdin,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
        )
        os.close(theirs)
        self.text = ''
        # A read may end within a character.
        self._decoder = codecs.getincrementaldecoder('utf-8')('replace')

    def until(self, pattern: str) -> re.Match[str]:
        """The first match in what it says; a read may end anywhere, so ``pattern`` says where what it wants ends."""
        end = time.monotonic() + WAIT_S
        while (match := re.search(pattern, self.text)) is None:
            if not self._read(end):
                raise RuntimeError(f'{pattern!r} was not said')
        return match

    def _read(self, end: float) -> bool:
        if self._fd < 0:
            return False
        ready, _, _ = select.select((self._fd,), (), (), max(0.0, end - time.monotonic()))
        try:
            new = os.read(self._fd, 65536) if ready else b''
        except OSError:
            new = b''
        self.text += self._decoder.decode(new)
        return bool(new)

    def end(self) -> int:
        """Ctrl-C, all it says, and its exit status."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGINT)
        return self.finish()

    def finish(self) -> int:
        """Wait until it is over."""
        end = time.monotonic() + WAIT_S
        while self._read(end):
            pass
        try:
            status = self.process.wait(max(1.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            raise RuntimeError('did not end') from None
        finally:
            if self._fd >= 0:
                os.close(self._fd)
                self._fd = -1
        return status
