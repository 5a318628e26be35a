# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated devices on lines, pulled out and plugged in by the test.

``served``: on a pseudo-terminal, in real time. ``wired``: on a line of our own, in a time of our own
that passes only while somebody waits, so that a device is never late and waits for its reader: for
sources that measure how quick the device is, whatever else the machine does.
"""

import itertools
import queue
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from psd_deflection.base.errors import DeviceError
from psd_deflection.base.log import texts
from psd_deflection.devices import LineDevice, Notice, PortClosedError, dataq, port_source, text_lines, thorlabs
from psd_deflection.devices.pseudo_terminal import PseudoTerminal
from psd_deflection.devices.rig_feed import RigFeed
from psd_deflection.devices.serve import serve
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.run import acquisition
from psd_deflection.run.acquisition import Acquisition
from psd_deflection.run.arrivals import Arrival
from test.heard import WAIT_S


def no_load(_: int, n: int) -> FloatArray:
    return np.zeros((n, 3))


class Served:
    """A device behind a link that keeps its name while the terminal comes and goes."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def plug(self, device: LineDevice) -> None:
        self._stop = threading.Event()
        self._terminal = PseudoTerminal(self.link)
        self._thread = threading.Thread(
            target=serve, args=(device, self._terminal, self._stop.is_set), name='device', daemon=True
        )
        self._thread.start()

    def unplug(self) -> None:
        if self._thread is not None:
            self._stop.set()
            self._thread.join()
            self._terminal.close()
            self._thread = None


class OwnClock:
    """Stands for the module ``time``; nanoseconds that pass while somebody waits, in whichever thread."""

    def __init__(self) -> None:
        self.now = 10**12
        self._advancing = threading.Lock()

    def advance(self, ns: int) -> None:
        with self._advancing:
            self.now += max(ns, 0)

    def monotonic_ns(self) -> int:
        return self.now

    def monotonic(self) -> float:
        return self.now / 1e9

    def time_ns(self) -> int:
        return self.now + 10**18

    def sleep(self, seconds: float) -> None:
        self.advance(round(seconds * 1e9))


class Wired:
    """A device on a line that has no kernel in it; ``link`` is the port's name."""

    def __init__(self, link: str, clock: OwnClock) -> None:
        self.link = link
        self._clock = clock
        self._waiting = b''
        self._powered = 0
        self.device: LineDevice | None = None

    def plug(self, device: LineDevice) -> None:
        """Connect it, 50 ms after whatever came before: slots of a polled device pass meanwhile."""
        self._clock.sleep(0.05)
        self._waiting, self._powered = b'', self._clock.now
        self.device = device

    def unplug(self) -> None:
        self.device = None

    def _there(self) -> LineDevice:
        if self.device is None:
            raise PortClosedError(f'{self.link}: the device is gone')
        return self.device

    def greet(self) -> None:
        """Somebody opened the port."""
        self._waiting += self._there().greeting()

    def due_in_ns(self) -> int:
        """Until it has something to be read; 0 where it has, or is gone."""
        gone = self.device is None or self._waiting
        return 0 if gone else max(self._there().due_in_ns(self._clock.now - self._powered), 0)

    def read(self, timeout: float) -> bytes:
        deadline = self._clock.now + round(timeout * 1e9)
        while True:
            self._waiting += self._there().take(self._clock.now - self._powered)
            if self._waiting or self._clock.now >= deadline:
                received, self._waiting = self._waiting, b''
                return received
            self._clock.advance(min(max(self.due_in_ns(), 1000), deadline - self._clock.now))

    def write(self, frame: bytes) -> None:
        device = self._there()
        self._waiting += device.receive(frame, self._clock.now - self._powered)

    def discard(self) -> None:
        self._there().take(self._clock.now - self._powered)
        self._waiting = b''


class WiredPort:
    """Stands for an open port."""

    def __init__(self, lines: list[Wired], name: str) -> None:
        self._number = next(i for i, line in enumerate(lines) if line.link == name)
        self._line = lines[self._number]
        if self._line.device is None:
            raise DeviceError(f'{name}: no such port')
        self._line.greet()
        self.read, self.write, self.discard_input = self._line.read, self._line.write, self._line.discard

    def fileno(self) -> int:
        return self._number

    def notices(self) -> list[Notice]:
        return []

    def describe(self) -> dict[str, str]:
        return {}

    def close(self) -> None:
        """Nothing is held."""


class Run:
    """The reader on a rig, and what it said."""

    def __init__(self, rig: Rig) -> None:
        self.logged: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.acquisition = Acquisition(rig, texts(self.logged.put))
        self.acquisition.open()
        self.acquisition.start()

    def take(self, n: int) -> list[Arrival]:
        """The next chunks until ``n`` samples have come."""
        chunks: list[Arrival] = []
        while sum(len(c.raw.seq) for c in chunks) < n:
            item = self.acquisition.queue.get(timeout=WAIT_S)
            if isinstance(item, Arrival):
                chunks.append(item)
        return chunks

    def forget(self) -> None:
        """Take what has come so far off the queue."""
        while not self.acquisition.queue.empty():
            self.acquisition.queue.get(timeout=WAIT_S)

    def heard(self, text: str) -> str:
        while True:
            message = self.logged.get(timeout=WAIT_S)
            if text in message:
                return message


@pytest.fixture(scope='session')
def unloaded() -> Callable[[Rig], RigFeed]:
    """A feed of that rig, on which nothing pulls."""
    return lambda rig: RigFeed(rig, no_load)


@pytest.fixture
def served(tmp_path: Path, request: pytest.FixtureRequest) -> Callable[[LineDevice], Served]:
    numbers = itertools.count()

    def make(device: LineDevice) -> Served:
        port = Served(tmp_path / f'port_{next(numbers)}')
        port.plug(device)
        request.addfinalizer(port.unplug)
        return port

    return make


@pytest.fixture
def wired(monkeypatch: pytest.MonkeyPatch) -> Callable[[LineDevice], Wired]:
    clock = OwnClock()
    made: list[Wired] = []

    def make(device: LineDevice) -> Wired:
        port = Wired(f'port_{len(made)}', clock)
        port.plug(device)
        made.append(port)
        return port

    def port(name: str, baud: int, **settings: object) -> WiredPort:
        return WiredPort(made, name)

    def select(ports: Sequence[int], _: object, __: object, timeout: float) -> None:
        waits = [made[number].due_in_ns() for number in ports]
        clock.advance(min(max(min(waits), 1000), round(timeout * 1e9)))

    for module in (thorlabs, dataq, text_lines):
        monkeypatch.setattr(module, 'time', clock)
    for opener in (thorlabs, port_source):
        monkeypatch.setattr(opener, 'open_port', port)
    monkeypatch.setattr(thorlabs, 'select', SimpleNamespace(select=select))
    monkeypatch.setattr(acquisition, 'time', clock)
    return make


@pytest.fixture
def run(request: pytest.FixtureRequest) -> Callable[[Rig], Run]:
    def make(rig: Rig) -> Run:
        running = Run(rig)
        request.addfinalizer(running.acquisition.stop)
        return running

    return make


@pytest.fixture
def volts() -> Callable[[list[Arrival]], Any]:
    def of(chunks: list[Arrival]) -> Any:
        raws = [c.raw for c in chunks]
        scale = [1.0 if r.volts_per_count is None else r.volts_per_count for r in raws]
        return np.concatenate([r.readings * s for r, s in zip(raws, scale, strict=True)])

    return of
