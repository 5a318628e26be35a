# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``udp://HOST:PORT``: datagrams to this machine from one sender, the first whose bytes make a frame; others are
counted and said once. One that was silent for ``SILENT_S`` gives way, by a reconnection."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.port import READ_SIZE, SLICE_S, Address, OpenPort, waited_for
from psd_deflection.devices.source import Notice, PortClosedError

BIND_S = 2.0
"""How long it may take to find the address of this machine."""

SILENT_S = 2.0
"""A sender that was silent for so long gives way to another one."""

LARGEST = 65_535
"""Bytes of the largest datagram."""

RECEIVE_BYTES = 1 << 20
"""Room that the kernel is asked for; it gives less, unless ``net.core.rmem_max`` is larger."""

MOST_SENDERS = 8
"""Senders that are listened to at a time until one is found."""

KEPT = 2048
"""Bytes that are kept of each of them."""

MOST_DATAGRAMS = 256
"""Datagrams of one read."""

MOST_PENDING = 512
"""Bytes that wait for a sender to whom they go."""

Validator = Callable[[bytes], bool]
"""Fed with one sender's bytes in turn: whether they make something of the device's protocol."""


@dataclass(frozen=True, slots=True)
class Datagrams:
    """What a source wants of datagrams. ``validator``: makes a :data:`Validator` for a new sender.

    ``end``: bytes that end each datagram, so that nothing is put together of two; empty: they are one stream.
    """

    validator: Callable[[], Validator] = lambda: lambda piece: True
    end: bytes = b''


class UdpPort(OpenPort):
    """A port on which datagrams come. Raises DeviceError with its name if it cannot be had."""

    def __init__(
        self, name: str, address: Address, datagrams: Datagrams | None = None, given_up: threading.Event | None = None
    ) -> None:
        super().__init__(name, given_up)
        try:
            self._socket = waited_for(name, lambda: _bound(address), socket.socket.close, self._given_up, BIND_S)
        except OSError as error:
            raise DeviceError(f'{name}: {_why(error, address)}') from None
        self._datagrams = datagrams or Datagrams()
        # The sender, and when it was heard last (monotonic, s).
        self._sender: Any = None
        self._heard = 0.0
        # Before there is one: those that may be it, and what waits to be sent to it.
        self._candidates: dict[Any, _Candidate] = {}  # Bound: MOST_SENDERS.
        self._pending = b''
        self._other_datagrams = 0
        self._notices: list[Notice] = []  # Bound: one a port: that others send.

    def read(self, timeout: float) -> bytes:
        """Return the bytes of the sender that have arrived; empty after ``timeout`` s, but at most 0.1 s.

        Raises PortClosedError if the port was given up, or another device sends now.
        """
        self._check_given_up()
        ready, _, _ = select.select((self._socket,), (), (), min(timeout, SLICE_S))
        taken = bytearray()
        if ready:
            now = time.monotonic()
            for _ in range(MOST_DATAGRAMS):
                datagram, sender = self._receive()
                if sender is None:
                    break
                taken += self._sorted(datagram, sender, now)
                if len(taken) >= READ_SIZE:
                    break
        return bytes(taken)

    def _receive(self) -> tuple[bytes, Any]:
        """The next datagram and its sender; None if no more is there."""
        try:
            return self._socket.recvfrom(LARGEST)
        except BlockingIOError:
            return b'', None
        except OSError as error:
            raise PortClosedError(f'{self.name}: the network is gone ({error.strerror})') from None

    def _sorted(self, datagram: bytes, sender: Any, now: float) -> bytes:
        """What a datagram adds to the stream."""
        datagram += self._datagrams.end
        if sender == self._sender:
            self._heard = now
            return datagram
        if self._sender is not None:
            self._other(datagram, sender, now)
            return b''
        candidate = self._candidate(sender)
        if not candidate.takes(datagram):
            return b''
        self._candidates = {}
        self._sender, self._heard = sender, now
        pending, self._pending = self._pending, b''
        if pending:
            self._send(pending)
        return candidate.last_bytes

    def _candidate(self, sender: Any) -> _Candidate:
        """What is known of somebody who may be the sender."""
        candidate = self._candidates.get(sender)
        if candidate is None:
            while len(self._candidates) >= MOST_SENDERS:
                del self._candidates[next(iter(self._candidates))]
            candidate = self._candidates[sender] = _Candidate(self._datagrams.validator())
        return candidate

    def _other(self, datagram: bytes, sender: Any, now: float) -> None:
        """Count what somebody else sends. Raises PortClosedError if it is a device that follows a silent one."""
        self._other_datagrams += 1
        if self._other_datagrams == 1:
            self._notices.append(
                Notice(f'datagrams of {_shown(sender)} are not taken: {_shown(self._sender)} sends already')
            )
        if now - self._heard > SILENT_S and self._candidate(sender).takes(datagram):
            raise PortClosedError(f'{self.name}: {_shown(self._sender)} is silent, and {_shown(sender)} sends now')

    def write(self, frame: bytes) -> None:
        """Send to the sender; if there is none yet, the last frame waits for it. A datagram may be lost on its way."""
        if self._sender is None:
            self._pending = frame[:MOST_PENDING]
        else:
            self._send(frame)

    def _send(self, frame: bytes) -> None:
        try:
            self._socket.sendto(frame, self._sender)
        except BlockingIOError:
            # There is no room for it: lost, as others are on their way.
            pass
        except OSError as error:
            raise PortClosedError(f'{self.name}: cannot be written to ({error.strerror})') from None

    def fileno(self) -> int:
        """The descriptor."""
        return self._socket.fileno()

    def notices(self) -> list[Notice]:
        """That others send, once."""
        notices, self._notices = self._notices, []
        return notices

    def discard_input(self) -> None:
        """Discard datagrams that were not read: they are older than their time of reading."""
        with contextlib.suppress(OSError):
            for _ in range(MOST_DATAGRAMS):
                self._socket.recvfrom(LARGEST)

    def describe(self) -> Mapping[str, str]:
        """Who sends, and how many datagrams came from others."""
        sender = self._sender
        return {
            'sender': 'none yet' if sender is None else _shown(sender),
            'datagrams of other senders': str(self._other_datagrams),
        }

    def close(self) -> None:
        """Give the port back."""
        self._socket.close()


class _Candidate:
    """Somebody who may be the sender. ``last_bytes``: those that it sent."""

    def __init__(self, validator: Validator) -> None:
        self.last_bytes = b''
        self._validator = validator

    def takes(self, datagram: bytes) -> bool:
        """Whether it is the device's protocol, with ``datagram``."""
        self.last_bytes = (self.last_bytes + datagram)[-max(KEPT, len(datagram)) :]
        return self._validator(datagram)


def _bound(address: Address) -> socket.socket:
    addresses = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE)
    family, kind, protocol, _, place = addresses[0]
    made = socket.socket(family, kind, protocol)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
        made.setblocking(False)
        made.bind(place)
    except OSError:
        made.close()
        raise
    return made


def _shown(sender: Any) -> str:
    host, port = sender[:2]
    return f'[{host}]:{port}' if ':' in host else f'{host}:{port}'


def _why(error: OSError, address: Address) -> str:
    if isinstance(error, socket.gaierror):
        return f'no address {address.host} is known; name an address of this machine (0.0.0.0: all of them)'
    if error.errno == errno.EADDRNOTAVAIL:
        return f'{address.host} is no address of this machine; datagrams come to one of them (0.0.0.0: to all of them)'
    if error.errno == errno.EADDRINUSE:
        return 'another program takes what comes there; end it, or let the device send to another port'
    if error.errno in (errno.EACCES, errno.EPERM):
        return 'no permission; take a port above 1023'
    return f'cannot be opened ({os.strerror(error.errno) if error.errno else error})'
