# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a daemon requests from the system: locked memory, real-time priority for the reader, a watchdog.

None of it is needed to run. The log says once what the system granted and what it rejected, with the reason
(``docs/deploy``).
"""

from __future__ import annotations

import ctypes
import gc
import os
import socket
import sys
import time
from collections.abc import Callable

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
