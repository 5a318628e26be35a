# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Serves a simulated device on pseudo-terminals or on the network, in real time, as a process of its own: parameters
come as a line of JSON, each further line is a load, and the end of its standard input ends it."""

import contextlib
import json
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from psd_deflection.base.errors import ConfigError, PsdDeflectionError
from psd_deflection.devices.device import OUTPUT_LIMIT, LineDevice, PowerUp
from psd_deflection.devices.port import Address, network_address
from psd_deflection.devices.pseudo_terminal import PORT_LINE, link_names, open_terminals
from psd_deflection.devices.registry import SIMULATED, find_device
from psd_deflection.devices.rig_feed import RigFeed
from psd_deflection.model.simulation.loads import CyclicLoads, thesis_load_cases
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, rig_from_values

CATCH_UP_NS = 20_000_000

DWELL_S = 4.0
FIRST_LOAD_S = 1.0
"""Time without load after power-up, s: long enough for a zero, short enough that the user soon sees it move."""


def served_loads(rate: float) -> CyclicLoads:
    """The thesis's load cases, repeated; the first, unloaded, ends ``FIRST_LOAD_S`` after power-up."""
    return CyclicLoads(thesis_load_cases(DWELL_S, rate), start=round((DWELL_S - FIRST_LOAD_S) * rate))


class Hand:
    """Loads of a rig that is served: the cycle, until another thread holds a load."""

    def __init__(self, cycle: CyclicLoads) -> None:
        self._cycle = cycle
        self._held: FloatArray | None = None

    def hold(self, line: bytes) -> None:
        """Hold the load of a line of JSON: Fx, Fy, N, Tz, N m. Raises ValueError if it is none."""
        held = np.array(json.loads(line), dtype=np.float64)
        if held.shape != (3,) or not np.isfinite(held).all():
            raise ValueError('a load has three finite numbers')
        self._held = held

    def take(self, n: int) -> FloatArray:
        """The next n loads (n, 3)."""
        held = self._held
        return self._cycle.take(n) if held is None else np.tile(held, (n, 1))


def simulated_devices(
    name: str, rig: Rig, seed: int = 0, power_up: PowerUp | None = None, hand: Hand | None = None
) -> Sequence[LineDevice]:
    """The twins of the device ``name``, one per port, that measure ``rig`` under the loads of ``hand``.

    Without it, under :func:`served_loads`.
    Raises ConfigError if there is no such device, or it cannot be simulated.
    """
    simulate = find_device(name).simulate
    if simulate is None:
        raise ConfigError(f'source = {name!r}: cannot be simulated; {", ".join(SIMULATED)} can')
    loads = hand or served_loads(rig.converter.sample_rate_hz)
    return simulate(RigFeed(rig, lambda _, n: loads.take(n), seed=seed), power_up or PowerUp())


class HostSide(Protocol):
    """Where a simulated device is reached. ``name``: what the host opens."""

    name: str

    def listen(self, seconds: float) -> bytes | None:
        """What the host has sent, after at most ``seconds``; None if nobody has the port open. Raises OSError."""

    def send(self, stream: bytes) -> int:
        """Send as much as there is room for; return how many bytes. Raises OSError if nobody has it open."""


def serve(device: LineDevice, port: HostSide, stopped: Callable[[], bool]) -> None:
    """Run the device in real time until ``stopped()``."""
    start = time.monotonic_ns()
    pending = b''
    listening = False
    while not stopped():
        try:
            heard = port.listen(max(device.due_in_ns(time.monotonic_ns() - start), 0) / 1e9)
            now = time.monotonic_ns() - start
            if heard is None:
                listening, pending = False, b''
                device.take(now, room=1 << 30)
                continue
            if not listening:
                listening = True
                pending = device.greeting()
            if heard:
                pending += device.receive(heard, now)
            until = now + min(device.due_in_ns(now), 0)
            caught_up = False
            while not caught_up:
                # Unlike a device, this process may be late on a busy machine. Then the overdue samples
                # are sent piece by piece: they are dropped only if the host does not read.
                until = min(until + CATCH_UP_NS, now)
                caught_up = until == now
                pending += device.take(until, room=OUTPUT_LIMIT - len(pending))
                if pending:
                    sent = port.send(pending)
                    pending = pending[sent:]
                    caught_up = caught_up or not sent
        except OSError:
            # The host closed the port between poll and write.
            listening, pending = False, b''


def serve_all(devices: Sequence[LineDevice], ports: Sequence[HostSide], stopped: Callable[[], bool]) -> None:
    """Serve each device on its port until ``stopped()``, the first one in this thread."""
    threads = [
        threading.Thread(target=serve, args=(device, port, stopped), name=port.name, daemon=True)
        for device, port in zip(devices[1:], ports[1:], strict=True)
    ]
    for thread in threads:
        thread.start()
    serve(devices[0], ports[0], stopped)
    for thread in threads:
        thread.join()


def stopped_by_signals() -> threading.Event:
    """An event that SIGINT and SIGTERM set from now on."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


def main() -> int:
    """Serve the rig that the daemon describes on standard input, until that closes; return the exit status."""
    line = sys.stdin.buffer.readline()
    if not line:
        # The daemon that started us ended before it sent parameters.
        return 0
    stop = stopped_by_signals()
    try:
        rig = _rig_of(line)
        hand = Hand(served_loads(rig.converter.sample_rate_hz))
        if not rig.acquisition.demo:
            hand.hold(b'[0, 0, 0]')

        def until_the_end() -> None:
            with contextlib.suppress(OSError, ValueError):
                for held in sys.stdin.buffer:
                    hand.hold(held)
            stop.set()

        threading.Thread(target=until_the_end, name='parent', daemon=True).start()
        devices = simulated_devices(rig.acquisition.source, rig, hand=hand)
        with open_terminals(link_names(None, len(devices))) as ports:
            print(f'{PORT_LINE}{",".join(port.name for port in ports)}', flush=True)
            serve_all(devices, ports, stop.is_set)
    except PsdDeflectionError as error:
        print(f'simulated rig: {error}', file=sys.stderr)
        return error.exit_status
    return 0


def _rig_of(line: bytes) -> Rig:
    try:
        values = json.loads(line)
    except ValueError:
        raise ConfigError('standard input: must be the parameters as a line of JSON') from None
    return rig_from_values(values, 'parameters of the daemon')


if __name__ == '__main__':
    sys.exit(main())


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
        if (remaining := self._absent_until - time.monotonic()) > 0.0:
            time.sleep(min(seconds, remaining))
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
            endpoint = replace(address, port=address.port + n if address.port else 0)
            try:
                made.append(ServedTcp(endpoint) if endpoint.scheme == 'socket' else ServedUdp(endpoint))
            except (OSError, OverflowError) as error:
                why = getattr(error, 'strerror', None) or error
                raise ConfigError(f'serve = {where!r}: cannot be served there ({why})') from None
            stack.callback(made[-1].close)
        yield made


def _named(scheme: str, host: str, port: int) -> str:
    return f'{scheme}://[{host}]:{port}' if ':' in host else f'{scheme}://{host}:{port}'
