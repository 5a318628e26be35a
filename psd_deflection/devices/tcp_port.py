# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Ports of the network: ``socket://HOST:PORT``, bytes over TCP, and ``rfc2217://HOST:PORT``, a serial port with its
line speed over Telnet (RFC 2217, ser2net)."""

import contextlib
import errno
import select
import socket
import threading
import time

import serial
from serial import rfc2217

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.port import READ_SIZE, SLICE_S, WRITE_S, Address, DescriptorPort, OpenPort, waited_for
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
        unsent = memoryview(frame)
        deadline = time.monotonic() + WRITE_S
        while unsent:
            self._check_given_up()
            try:
                unsent = unsent[self._socket.send(unsent) :]
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


OPEN_S = 4.0
"""How long connection and negotiation may take together: less than what counts as a hung reader."""

MOST_WAITING = 1_000_000
"""Bytes that may wait to be read: pyserial has no bound of its own."""


class Rfc2217Port(OpenPort):
    """A remote serial port. Raises DeviceError with its name if it cannot be opened.

    pyserial negotiates, and reads in a thread of its own. Every byte goes through a queue of it, which costs more than
    the rest of the reader: prefer ``socket://`` if the speed is set at the other end.
    """

    def __init__(
        self, name: str, address: Address, baud: int, *, rtscts: bool = False, given_up: threading.Event | None = None
    ) -> None:
        super().__init__(name, given_up)
        host = f'[{address.host}]' if ':' in address.host else address.host
        url = f'rfc2217://{host}:{address.port}' + (f'?{address.option}' if address.option else '')

        def negotiate() -> _Client:
            client = _Client(baudrate=baud, timeout=SLICE_S, rtscts=rtscts)
            client.port = url
            client.open()
            client.settle()
            return client

        try:
            self._serial = waited_for(name, negotiate, _Client.close, self._given_up, OPEN_S)
        except (serial.SerialException, ValueError) as error:
            raise DeviceError(f'{name}: {_why(error, address, baud)}') from None
        except TimeoutError:
            raise DeviceError(f'{name}: {NOT_TELNET} (waited {OPEN_S:g} s)') from None

    def read(self, timeout: float) -> bytes:
        """Return the bytes that have arrived, at most some thousand; empty after 0.1 s (``timeout`` 0: at once).

        Raises PortClosedError if the port is gone or was given up.
        """
        self._check_given_up()
        try:
            waiting = self._serial.in_waiting
            if waiting > MOST_WAITING:
                raise PortClosedError(f'{self.name}: more comes than can be read ({waiting} bytes wait)')
            if waiting or timeout <= 0.0:
                return bytes(self._serial.read(min(waiting, READ_SIZE)))
            return bytes(self._serial.read(1))
        except (serial.SerialException, OSError):
            raise PortClosedError(f'{self.name}: the device is gone (the connection ended)') from None

    def write(self, frame: bytes) -> None:
        """Send to the device; PortClosedError if it is gone or takes nothing for a second."""
        try:
            self._serial.write(frame)
        except (serial.SerialException, OSError) as error:
            raise PortClosedError(f'{self.name}: cannot be written to ({error})') from None

    def discard_input(self) -> None:
        """Discard the bytes that are here; to have those at the other end discarded takes a question and its answer."""
        with contextlib.suppress(OSError, serial.SerialException):
            self._serial.read(self._serial.in_waiting)

    def close(self) -> None:
        """Give the port back."""
        with contextlib.suppress(OSError):
            self._serial.close()


class _Client(rfc2217.Serial):
    """pyserial's client, for hosts that fail or send what they should not."""

    _socket: socket.socket | None

    def settle(self) -> None:
        """Once it is open: no send waits longer than for any other port, and a host that is cut off is noticed."""
        if self._socket is not None:
            keep_alive(self._socket)
            self._socket.settimeout(WRITE_S)

    def close(self) -> None:
        """End the connection; pyserial leaves its socket open if the other end was first."""
        connection = self._socket
        super().close()
        if connection is not None:
            connection.close()

    def _telnet_read_loop(self) -> None:
        # What is malformed ends the thread with an error, and the port reads as gone.
        with contextlib.suppress(Exception):
            super()._telnet_read_loop()  # type: ignore[misc]


NOT_TELNET = (
    'something answers there, but not as RFC 2217 says; is it a raw port (socket://), and is ser2net set to '
    'telnet(rfc2217)?'
)


def _why(error: Exception, address: Address, baud: int) -> str:
    cause = error.__context__
    if 'Could not open port' in str(error):
        return why_no_connection(cause, address)
    if 'rejected' in str(error) or 'parameter change' in str(error):
        return f'the other end does not take {baud} baud, 8 bits, no parity, 1 stop bit ({error})'
    return f'{NOT_TELNET} ({error})'
