"""What a program says, line by line, for tests that wait for it."""

from __future__ import annotations

import re
import threading
from typing import IO

import pytest

WAIT_S = 60.0
"""Longest that a test waits for what will come; a busy machine takes its time."""


class Heard:
    """``lines`` of a stream as they come, until its end."""

    def __init__(self, stream: IO[str]) -> None:
        self.lines: list[str] = []
        self._ended = False
        self._new = threading.Condition()
        self._stream = stream
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        for line in self._stream:
            with self._new:
                self.lines.append(line.rstrip('\n'))
                self._new.notify_all()
        with self._new:
            self._ended = True
            self._new.notify_all()

    def until(self, pattern: str) -> re.Match[str]:
        """The first match in a line; waits for it until nothing more can come."""
        found: list[re.Match[str]] = []

        def look() -> bool:
            found.extend(match for line in self.lines if (match := re.search(pattern, line)))
            # Not the program's end: its last lines may be on their way still.
            return bool(found) or self._ended

        with self._new:
            self._new.wait_for(look, WAIT_S)
        if not found:
            pytest.fail(f'{pattern!r} was not said, but: {self.lines}')
        return found[0]

    def close(self) -> None:
        """Wait for the last lines; the program has ended."""
        self._thread.join(WAIT_S)
        self._stream.close()
