# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""An open port, whatever carries its bytes, and what all of them share: how they wait, and how a wait ends.

Another thread may end every wait for a port, also while it is opened: by :meth:`OpenPort.give_up`, or by the event
that it was opened with. So each wait is cut into slices.
"""

from __future__ import annotations

import abc
import os
import select
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, InvalidStateError
from typing import TypeVar

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.source import Notice, PortClosedError

READ_SIZE = 4096

SLICE_S = 0.1
"""Longest single wait, so that ``give_up`` takes effect soon."""

WRITE_S = 1.0
"""A port that takes nothing for so long counts as gone."""

T = TypeVar('T')


class OpenPort(abc.ABC):
    """An open port. ``name``: as given. ``given_up``: once it is set, every wait for this port ends."""

    def __init__(self, name: str, given_up: threading.Event | None = None) -> None:
        self.name = name
        self._given_up = threading.Event() if given_up is None else given_up

    @abc.abstractmethod
    def read(self, timeout: float) -> bytes:
        """Return the bytes that have arrived; empty after ``timeout`` s, but at most 0.1 s.

        Raises PortClosedError if the port is gone or was given up.
        """

    @abc.abstractmethod
    def write(self, frame: bytes) -> None:
        """Send to the device; PortClosedError if it is gone or takes nothing for a second."""

    @abc.abstractmethod
    def discard_input(self) -> None:
        """Discard unread bytes: they are older than their time of reading."""

    @abc.abstractmethod
    def close(self) -> None:
        """Give the port back."""

    def fileno(self) -> int | None:
        """The descriptor, for ``select``; None if there is none."""
        return None

    def give_up(self) -> None:
        """End every wait for this port. Any thread may call it."""
        self._given_up.set()

    def notices(self) -> list[Notice]:
        """What a person should be told of it since the last call."""
        return []

    def describe(self) -> Mapping[str, str]:
        """Its state beside its name, for diagnostics. Any thread may call it."""
        return {}

    def _check_given_up(self) -> None:
        if self._given_up.is_set():
            raise PortClosedError(f'{self.name}: given up')


class DescriptorPort(OpenPort):
    """A port whose bytes come from the descriptor ``_fd``, which does not block: read with select and ``os.read``."""

    _fd: int

    def read(self, timeout: float) -> bytes:
        """Return the bytes that have arrived, at most 4096; empty after ``timeout`` s, but at most 0.1 s.

        Raises PortClosedError if the port is gone or was given up.
        """
        self._check_given_up()
        try:
            ready, _, _ = select.select((self._fd,), (), (), min(timeout, SLICE_S))
            if not ready:
                return b''
            received = os.read(self._fd, READ_SIZE)
        except BlockingIOError:
            return b''
        except OSError as error:
            raise PortClosedError(f'{self.name}: the device is gone ({error.strerror})') from None
        self._came(received)
        return received

    @abc.abstractmethod
    def _came(self, received: bytes) -> None:
        """A read that was ready returned this; raises PortClosedError if it shows that the device is gone."""

    def fileno(self) -> int:
        """The descriptor."""
        return self._fd


def waited_for(
    name: str, work: Callable[[], T], undo: Callable[[T], object], given_up: threading.Event, seconds: float
) -> T:
    """What ``work`` returns, at most ``seconds`` later; it runs in a thread of its own, because nothing can end it.

    ``undo``: called with what it returns after nobody waits for it any more. Raises what ``work`` raises,
    PortClosedError if ``given_up`` is set, TimeoutError.
    """
    done: Future[T] = Future()

    def run() -> None:
        try:
            found = work()
        except Exception as error:
            failed = error
            _settle(lambda: done.set_exception(failed))
            return
        if not _settle(lambda: done.set_result(found)):
            undo(found)

    try:
        threading.Thread(target=run, name='open port', daemon=True).start()
    except RuntimeError as error:
        raise DeviceError(f'{name}: cannot be opened ({error})') from None
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0 and not given_up.is_set():
        try:
            return done.result(min(left, SLICE_S))
        except TimeoutError:
            if done.done():
                return done.result()
    if not done.cancel():
        # It came just now.
        return done.result()
    if given_up.is_set():
        raise PortClosedError(f'{name}: given up')
    raise TimeoutError


def _settle(notify: Callable[[], None]) -> bool:
    """Tell a Future how it ended; False if nobody waits for it any more."""
    try:
        notify()
    except InvalidStateError:
        return False
    return True
