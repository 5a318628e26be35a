# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a process requests from the system: locked memory, real-time priority for the reader, a watchdog
(``docs/deploy``); what the system asks of it: signals; and why a thread does not keep up."""

import ctypes
import gc
import os
import signal
import socket
import sys
import threading
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

SHARED_MEMORY = '/dev/shm'
READER_PRIORITY = 50
"""SCHED_FIFO priority of the reader thread. Threads inherit the policy, so the reader sets its own."""

MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4


def prefer_reader() -> str:
    """Give the calling thread SCHED_FIFO 50; return the outcome as text."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(READER_PRIORITY))
    except (OSError, AttributeError) as error:
        reason = getattr(error, 'strerror', None) or error
        return f'reader: ordinary scheduling, SCHED_FIFO {READER_PRIORITY} is rejected ({reason}; see docs/deploy)'
    return f'reader: SCHED_FIFO {READER_PRIORITY}'


def lock_memory() -> str:
    """Call ``mlockall``, so that none of our memory is swapped out; return the outcome as text.

    Pages are locked as they are touched: unused stacks cost nothing. Under a finite limit nothing is
    locked, because a later allocation would be rejected and end the process.
    """
    try:
        import resource
    except ImportError:
        return 'memory: not locked, this system has no mlockall'
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit != resource.RLIM_INFINITY and os.geteuid() != 0:
        return f'memory: not locked, the limit is {limit} bytes (memlock; see docs/deploy)'
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) == 0:
            return 'memory: locked (mlockall)'
        reason = os.strerror(ctypes.get_errno())
    except (OSError, AttributeError) as error:
        reason = str(error)
    return f'memory: not locked, mlockall is rejected ({reason}; see docs/deploy)'


def settle() -> None:
    """Exempt the present objects from garbage collection: they stay until the end."""
    gc.collect()
    gc.freeze()


def shared_memory_left() -> int:
    """Free bytes of ``SHARED_MEMORY``, in which DDS and the tracing of ROS 2 map memory."""
    try:
        system = os.statvfs(SHARED_MEMORY)
    except OSError:
        # Where there is none, nothing can be mapped, and whoever tries is told so.
        return sys.maxsize
    return system.f_bavail * system.f_frsize


def of_systemd() -> bool:
    """Whether this is the process of a unit of ``Type=notify``."""
    return bool(os.environ.get('NOTIFY_SOCKET'))


class Watchdog:
    """Tells systemd that the daemon is ready and alive (sd_notify(3)).

    Without ``NOTIFY_SOCKET`` in the environment it does nothing. ``clock``: monotonic, s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._address = os.environ.get('NOTIFY_SOCKET', '')
        if self._address.startswith('@'):
            self._address = '\0' + self._address[1:]
        usec = os.environ.get('WATCHDOG_USEC', '')
        pid = os.environ.get('WATCHDOG_PID', '')
        meant = not pid or pid == str(os.getpid())
        # Twice as often as necessary.
        self._interval = int(usec) / 2e6 if usec.isdecimal() and meant else 0.0
        self._last = -self._interval

    def _report(self, text: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
                channel.connect(self._address)
                channel.send(text.encode())
        except OSError:
            # systemd does not listen; the run does not depend on it.
            self._address = ''

    def ready(self) -> None:
        """The daemon runs."""
        self._report('READY=1')

    def alive(self) -> None:
        """Tell systemd that the process is alive; to be called from the loop that must not hang."""
        if not self._interval:
            return
        now = self._clock()
        if now - self._last >= self._interval:
            self._last = now
            self._report('WATCHDOG=1')

    def stopping(self) -> None:
        """The daemon ends."""
        self._report('STOPPING=1')


HELD_S = 1.0
"""A thread that has made no step for so long is held up, unless it waits for a processor."""

SLOW = 'this machine is too slow'
_PACKAGE = 'psd_deflection.'
_STATES = {'D': 'waits for the disk', 'T': 'is stopped'}


def lag_reason(thread: threading.Thread, still_s: float) -> str:
    """Why ``thread`` is behind, in words. ``still_s``: how long it has made no step, s."""
    state = _state_of(thread)
    if still_s < HELD_S or state == 'R':
        return SLOW
    place = _place_of(thread)
    return f'{thread.name} {_STATES.get(state, "is held up")}' + (f' in {place}' if place else '')


def _state_of(thread: threading.Thread) -> str:
    """What the kernel says of it: R runs, or waits for a processor; '' if it does not say."""
    try:
        text = Path(f'/proc/self/task/{thread.native_id}/stat').read_text()
    except OSError:
        return ''
    return text.rpartition(')')[2].split()[0]


def _place_of(thread: threading.Thread) -> str:
    """The innermost function of ours that it is in."""
    frame = sys._current_frames().get(thread.ident or 0)  # noqa: SLF001
    while frame is not None:
        module = str(frame.f_globals.get('__name__', ''))
        if module.startswith(_PACKAGE):
            return f'{module.removeprefix(_PACKAGE)}.{frame.f_code.co_name}'
        frame = frame.f_back
    return ''


T = TypeVar('T')


class StopRequestedError(BaseException):
    """A signal came while the main thread waited for a device. Like KeyboardInterrupt, it is not an Exception."""


class Signals:
    """Handles the signals from now on: they set ``stop``; inside :meth:`interruptible` they end the wait too.

    SIGHUP (the terminal was closed, or the ssh connection broke) is one of them unless it is ignored
    (``nohup``), so that the recording is completed. For the main thread only.

    A signal that raised an exception anywhere would cut the last blocks off a recording. So the signal sets an
    event, which the main loop checks. Only the wait for a device ends at once.
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

    def restore_handlers(self) -> None:
        """Restore the previous signal handlers."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
