# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""An open port, whatever carries its bytes, and what all of them share: how they wait, and how a wait ends.

Another thread may end every wait for a port, also while it is opened: by :meth:`OpenPort.give_up`, or by the event
that it was opened with. So each wait is cut into slices.
"""

import abc
import os
import re
import select
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, InvalidStateError
from dataclasses import dataclass
from typing import TypeVar

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.base.text import did_you_mean
from psd_deflection.devices.source import Notice, PortClosedError
from psd_deflection.rig.parameters import shown

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
            result = work()
        except Exception as error:
            failed = error
            _settle(lambda: done.set_exception(failed))
            return
        if not _settle(lambda: done.set_result(result)):
            undo(result)

    try:
        threading.Thread(target=run, name='open port', daemon=True).start()
    except RuntimeError as error:
        raise DeviceError(f'{name}: cannot be opened ({error})') from None
    deadline = time.monotonic() + seconds
    while (remaining := deadline - time.monotonic()) > 0 and not given_up.is_set():
        try:
            return done.result(min(remaining, SLICE_S))
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


SCHEMES = ('socket', 'rfc2217', 'udp')
"""``socket``: bytes over TCP. ``rfc2217``: a serial port over TCP, with its speed. ``udp``: datagrams that come."""

FORMS = 'a serial port, socket://HOST:PORT, rfc2217://HOST:PORT or udp://HOST:PORT'

OPTION = 'ign_set_control'
"""The option of an rfc2217 address: for servers that do not answer what is set of the control lines."""

_OTHER_NAMES = {'tcp': 'socket', 'telnet': 'rfc2217'}
_URL = re.compile(r'([A-Za-z][A-Za-z0-9+.-]*)://(.*)', re.DOTALL)
_PLACE = re.compile(
    r'(?:\[(?P<six>[0-9A-Fa-f:.]+(?:%\w+)?)\]|(?P<host>[\w.-]+)):(?P<port>[0-9]{1,5})(?P<rest>.*)', re.DOTALL
)


@dataclass(frozen=True, slots=True)
class Address:
    """A port of the network. ``host``: a name or a number, without brackets. ``option``: what follows a ``?``."""

    scheme: str
    host: str
    port: int
    option: str = ''

    @property
    def has_baud(self) -> bool:
        """Whether a line speed can be set there."""
        return self.scheme == 'rfc2217'


def network_address(name: str, key: str = 'port', least: int = 1) -> Address | None:
    """The address that ``name`` gives, None if it names a port of this machine.

    ``least``: smallest number of a port. Raises ConfigError, which names ``key``, for another scheme, and for an
    address that is not complete.
    """
    url = _URL.fullmatch(name)
    if url is None:
        return None
    scheme = url[1].lower()
    if scheme not in SCHEMES:
        intended = _OTHER_NAMES.get(scheme)
        hint = f'; did you mean {intended}://?' if intended else did_you_mean(scheme, SCHEMES)
        raise ConfigError(f'{key} = {shown(name)}: must be {FORMS}{hint}')
    place = _PLACE.fullmatch(url[2])
    form = f'{scheme}://HOST:PORT'
    if place is None:
        six = '; a number of IPv6 stands in brackets: [::1]' if url[2].count(':') > 1 else ''
        raise ConfigError(f'{key} = {shown(name)}: must be {form}{six}')
    port = int(place['port'])
    if not least <= port <= 65535:
        raise ConfigError(f'{key} = {shown(name)}: the last number must be at least {least} and at most 65535')
    option = place['rest'].removeprefix('?')
    if place['rest'] and not (scheme == 'rfc2217' and option == OPTION):
        also = f' or {form}?{OPTION}' if scheme == 'rfc2217' else ''
        raise ConfigError(f'{key} = {shown(name)}: must be {form}{also}')
    return Address(scheme, place['six'] or place['host'], port, option)


def has_baud(name: str) -> bool:
    """Whether the port of that name has a line speed. Raises ConfigError as :func:`network_address`."""
    address = network_address(name)
    return address is None or address.has_baud
