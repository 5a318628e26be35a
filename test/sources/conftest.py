"""Simulated devices on pseudo-terminals, served by threads, pulled out and plugged in by the test."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psd_deflection.config import Rig
from psd_deflection.io.simulated_device import LineDevice, PseudoTerminal, serve
from psd_deflection.records import FloatArray
from psd_deflection.runner.acquisition import Acquisition, Chunk


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


class Run:
    """The reader on a rig, and what it said."""

    def __init__(self, rig: Rig) -> None:
        self.said: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.acquisition = Acquisition(rig, self.said.put)
        self.acquisition.open()
        self.acquisition.start()

    def take(self, n: int) -> list[Chunk]:
        """The next chunks until ``n`` samples have come."""
        chunks: list[Chunk] = []
        while sum(len(c.raw.seq) for c in chunks) < n:
            item = self.acquisition.queue.get(timeout=20.0)
            if isinstance(item, Chunk):
                chunks.append(item)
        return chunks

    def heard(self, text: str) -> str:
        while True:
            message = self.said.get(timeout=20.0)
            if text in message:
                return message


@pytest.fixture(scope='session')
def unloaded() -> Callable[[int, int], FloatArray]:
    return no_load


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Callable[[LineDevice], Served]]:
    made: list[Served] = []

    def make(device: LineDevice) -> Served:
        one = Served(tmp_path / f'port_{len(made)}')
        one.plug(device)
        made.append(one)
        return one

    yield make
    for one in made:
        one.unplug()


@pytest.fixture
def run() -> Iterator[Callable[[Rig], Run]]:
    started: list[Run] = []

    def make(rig: Rig) -> Run:
        one = Run(rig)
        started.append(one)
        return one

    yield make
    for one in started:
        one.acquisition.stop()


@pytest.fixture
def volts() -> Callable[[list[Chunk]], Any]:
    def of(chunks: list[Chunk]) -> Any:
        raws = [c.raw for c in chunks]
        scale = [1.0 if r.volts_per_count is None else r.volts_per_count for r in raws]
        return np.concatenate([r.readings * s for r, s in zip(raws, scale, strict=True)])

    return of
