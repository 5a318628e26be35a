# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""SIGINT, SIGTERM and SIGHUP ask the program to end; they interrupt it only while it waits for a device.

A signal that raised an exception anywhere would cut the last blocks off a recording. So the signal sets an
event, which the main loop checks. Only the wait for a device ends at once.
"""

from __future__ import annotations

import signal
import types
from collections.abc import Callable
from typing import TypeVar

T = TypeVar('T')


class StopRequestedError(BaseException):
    """A signal came while the main thread waited for a device. Like KeyboardInterrupt, it is not an Exception."""


class Signals:
    """Handles the signals from now on: they set ``stop``; inside :meth:`interruptible` they end the wait too.

    SIGHUP (the terminal was closed, or the ssh connection broke) is one of them unless it is ignored
    (``nohup``), so that the recording is completed. For the main thread only.
    """

    def __init__(self) -> None:
        self.stop = False
        self._raise = False
        heard = [signal.SIGINT, signal.SIGTERM]
        # Windows has none.
        if hasattr(signal, 'SIGHUP') and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            heard.append(signal.SIGHUP)
        self._previous = {s: signal.signal(s, self._received) for s in heard}

    def _received(self, number: int, frame: types.FrameType | None) -> None:
        self.stop = True
        if self._raise:
            self._raise = False
            raise StopRequestedError

    def interruptible(self, action: Callable[[], T]) -> T:
        """Return ``action()``. A signal before or during it raises StopRequestedError."""
        self._raise = True
        try:
            if self.stop:
                raise StopRequestedError
            return action()
        finally:
            self._raise = False

    def restore(self) -> None:
        """Restore the previous signal handlers."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
