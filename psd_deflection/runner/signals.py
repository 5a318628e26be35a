"""SIGINT, SIGTERM, SIGHUP: a wish to end, not an interruption, but for the waiting for a device.

A signal that raised wherever it comes would tear the last blocks off a recording. So it is noted,
and whoever runs looks; only while a device is waited for does it end the waiting at once.
"""

from __future__ import annotations

import signal
import types
from collections.abc import Callable
from typing import TypeVar

T = TypeVar('T')


class StopRequestedError(BaseException):
    """A signal came while the main thread waited for a device. Like KeyboardInterrupt, no Exception."""


class Signals:
    """The signals from now on: ``stop`` is set at once; inside :meth:`interruptible` they end the waiting too.

    SIGHUP, a terminal that is closed or an ssh that breaks off, is one of them unless it was to be
    passed over (``nohup``): the recording gets its end. For the main thread alone.
    """

    def __init__(self) -> None:
        self.stop = False
        self._raise = False
        heard = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            heard.append(signal.SIGHUP)
        self._previous = {s: signal.signal(s, self._received) for s in heard}

    def _received(self, number: int, frame: types.FrameType | None) -> None:
        self.stop = True
        if self._raise:
            self._raise = False
            raise StopRequestedError

    def interruptible(self, action: Callable[[], T]) -> T:
        """``action()``; a signal before or during it ends it with StopRequestedError."""
        self._raise = True
        try:
            if self.stop:
                raise StopRequestedError
            return action()
        finally:
            self._raise = False

    def restore(self) -> None:
        """Give the signals back to who had them."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
