# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where a simulated device is reached over the network, as real ones are: a TCP port, or datagrams that it sends."""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections.abc import Iterator
from dataclasses import replace

from psd_deflection.base.errors import ConfigError
from psd_deflection.devices.port_names import Address, network_address

ABSENT_S = 0.2
"""How long nothing is sent to a host that takes no datagrams."""

DATAGRAM = 1400
"""Bytes of a datagram: what an Ethernet carries in one piece."""

FORMS = 'socket://HOST:PORT or udp://HOST:PORT'


class ServedTcp:
    """Listens on ``address`` for one host at a time, as a serial server does; others are turned away."""

    def __init__(self, address: Address) -> None:
        self._host: socket.socket | None = None
        family = socket.AF_INET6 if ':' in address.host else socket.AF_INET
        self._listener = socket.create_server((address.host, address.port), family=family, backlog=4)
        self._listener.setblocking(False)
        self.name = _named('socket', address.host, self._listener.getsockname()[1])

    def listen(self, seconds: float) -> bytes | None:
        """What the host has sent, after at most ``seconds``; None if there is none. Raises OSError."""
        asked = [self._listener] if self._host is None else [self._listener, self._host]
        ready, _, _ = select.select(asked, (), (), seconds)
        if self._listener in ready:
            self._accept()
        if self._host is None:
            return None
        if self._host not in ready:
            return b''
        received = self._host.recv(4096)
        if not received:
            self.hang_up()
            return None
        return received

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            host, _ = self._listener.accept()
            if self._host is not None:
                host.close()
                return
            host.setblocking(False)
            host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._host = host

    def send(self, stream: bytes) -> int:
        """Send as much as there is room for; return how many bytes. Raises OSError if the host is gone."""
        if self._host is None:
            raise ConnectionResetError
        try:
            return self._host.send(stream)
        except BlockingIOError:
            return 0
        except OSError:
            self.hang_up()
            raise

    def hang_up(self) -> None:
        """End the connection, if there is one; the host may come again."""
        if self._host is not None:
            self._host.close()
            self._host = None

    def close(self) -> None:
        """Listen no more."""
        self.hang_up()
        self._listener.close()


class ServedUdp:
    """Sends datagrams to the host at ``address``, and takes what comes back from there."""

    def __init__(self, address: Address) -> None:
        family, kind, protocol, _, place = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        self._socket.connect(place)
        self._absent_until = 0.0
        self.name = _named('udp', address.host, address.port)

    def listen(self, seconds: float) -> bytes | None:
        """What the host has sent, after at most ``seconds``; None if it takes no datagrams."""
        if (left := self._absent_until - time.monotonic()) > 0.0:
            time.sleep(min(seconds, left))
            return None
        ready, _, _ = select.select((self._socket,), (), (), seconds)
        try:
            return self._socket.recv(65_535) if ready else b''
        except BlockingIOError:
            return b''
        except OSError:
            self._absent_until = time.monotonic() + ABSENT_S
            return None

    def send(self, stream: bytes) -> int:
        """Send a datagram of what begins ``stream``; return how many bytes. Raises OSError if nobody takes it."""
        try:
            return self._socket.send(stream[:DATAGRAM])
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Send no more."""
        self._socket.close()


Served = ServedTcp | ServedUdp


@contextlib.contextmanager
def open_sockets(where: str, count: int) -> Iterator[list[Served]]:
    """``count`` ports at ``where`` (``socket://HOST:PORT``, ``udp://HOST:PORT``), the next ones with the next numbers.

    Number 0 of ``socket://`` takes any that is free. Raises ConfigError if one cannot be had.
    """
    address = network_address(where, 'serve', 0)
    if address is None or address.scheme not in ('socket', 'udp') or (address.scheme == 'udp' and not address.port):
        raise ConfigError(f'serve = {where!r}: must be {FORMS}')
    with contextlib.ExitStack() as stack:
        made: list[Served] = []
        for n in range(count):
            one = replace(address, port=address.port + n if address.port else 0)
            try:
                made.append(ServedTcp(one) if one.scheme == 'socket' else ServedUdp(one))
            except (OSError, OverflowError) as error:
                why = getattr(error, 'strerror', None) or error
                raise ConfigError(f'serve = {where!r}: cannot be served there ({why})') from None
            stack.callback(made[-1].close)
        yield made


def _named(scheme: str, host: str, port: int) -> str:
    return f'{scheme}://[{host}]:{port}' if ':' in host else f'{scheme}://{host}:{port}'
