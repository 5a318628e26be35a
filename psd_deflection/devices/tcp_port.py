# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``socket://HOST:PORT``: the bytes of a device over TCP, as a serial server, ser2net or an ESP32 gives them.

A host that is cut off sends nothing, not even that it is gone. The reader tells the silence as it does of a serial
line. Its question then waits for a confirmation in vain, so that the kernel ends the connection after ``DEAD_S``.
"""

from __future__ import annotations

import contextlib
import errno
import select
import socket
import threading
import time

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.port import SLICE_S, WRITE_S, DescriptorPort, waited_for
from psd_deflection.devices.port_names import Address
from psd_deflection.devices.source import PortClosedError

CONNECT_S = 2.0
"""How long a connection may take."""

DEAD_S = 10
"""A connection on which nothing is confirmed for so long is ended."""

MOST_DISCARDED = 256
"""Reads after which unread bytes are no longer discarded: a host that sends without end must not keep us."""

_KEEP_ALIVE = {'TCP_KEEPIDLE': 4, 'TCP_KEEPINTVL': 2, 'TCP_KEEPCNT': 3, 'TCP_USER_TIMEOUT': 1000 * DEAD_S}
"""Seconds without a byte until the kernel asks, between two questions, their number; ms until it gives up."""


class TcpPort(DescriptorPort):
    """A connection. Raises DeviceError with its name if there is none; PortClosedError if it was given up."""

    def __init__(self, name: str, address: Address, given_up: threading.Event | None = None) -> None:
        super().__init__(name, given_up)

        def connect() -> socket.socket:
            return socket.create_connection((address.host, address.port), CONNECT_S)

        try:
            self._socket = waited_for(name, connect, socket.socket.close, self._given_up, CONNECT_S)
        except OSError as error:
            raise DeviceError(f'{name}: {why_no_connection(error, address)}') from None
        keep_alive(self._socket)
        self._socket.setblocking(False)
        self._fd = self._socket.fileno()

    def _came(self, received: bytes) -> None:
        if not received:
            raise PortClosedError(
                f'{self.name}: the device is gone (the other end closed the connection; '
                'has another program the port there?)'
            )

    def discard_input(self) -> None:
        """Discard unread bytes: they are older than their time of reading."""
        # Without bytes to read, or gone: the next read tells.
        with contextlib.suppress(OSError):
            for _ in range(MOST_DISCARDED):
                if not self._socket.recv(1 << 16):
                    break

    def write(self, frame: bytes) -> None:
        """Send to the device; PortClosedError if it is gone or takes nothing for a second."""
        left = memoryview(frame)
        deadline = time.monotonic() + WRITE_S
        while left:
            self._check_given_up()
            try:
                left = left[self._socket.send(left) :]
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise PortClosedError(f'{self.name}: cannot be written to (it takes nothing)') from None
                select.select((), (self._fd,), (), SLICE_S)
            except OSError as error:
                raise PortClosedError(f'{self.name}: cannot be written to ({error.strerror})') from None

    def close(self) -> None:
        """End the connection."""
        with contextlib.suppress(OSError):
            self._socket.close()


def keep_alive(connection: socket.socket) -> None:
    """Let the kernel end a connection whose other end does not answer any more; send small pieces at once."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    for name, value in _KEEP_ALIVE.items():
        # Not every system has each.
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def why_no_connection(error: BaseException | None, address: Address) -> str:
    """Why there is no connection, and what to do."""
    if isinstance(error, socket.gaierror):
        return f'no host of the name {address.host} is known; is it spelt right? (a number, 192.168.1.20, will do too)'
    if isinstance(error, ConnectionRefusedError):
        return f'the host is there, but nothing listens on its port {address.port}; is the serial server on?'
    if isinstance(error, TimeoutError):
        return f'no answer in {CONNECT_S:g} s; is the host switched on, and in this network?'
    if isinstance(error, OSError) and error.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN):
        return f'the host cannot be reached ({error.strerror}); is its cable in, and is it in this network?'
    return f'cannot be opened ({error})'
