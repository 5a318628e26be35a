# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Serves a simulated device on pseudo-terminals or on the network, in real time.

Like a USB device it sends nothing while no one has its port open. A daemon starts
``python -m psd_deflection.devices.serve`` if no port is named: this process reads the parameters as a line of
JSON, prints its ports, and ends when its standard input closes. Each further line is a load that holds from then on.
"""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from psd_deflection.base.errors import ConfigError, PsdDeflectionError
from psd_deflection.devices.device import OUTPUT_LIMIT, LineDevice, PowerUp
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
    others = [
        threading.Thread(target=serve, args=(device, port, stopped), name=port.name, daemon=True)
        for device, port in zip(devices[1:], ports[1:], strict=True)
    ]
    for thread in others:
        thread.start()
    serve(devices[0], ports[0], stopped)
    for thread in others:
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
