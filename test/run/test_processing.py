# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pipeline's thread: requests that come late, and how long blocks took."""

import threading
from collections.abc import Collection
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import numpy as np
import pytest

from psd_deflection.base.log import texts
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import DeflectionEstimate, RawChunk, Record
from psd_deflection.rig.config import load_rig
from psd_deflection.run import processing as module
from psd_deflection.run.arrivals import Arrival, Ended, ItemQueue
from psd_deflection.run.processing import Processing
from test.heard import WAIT_S

MS = 1_000_000
COUNTS = np.tile(np.array([0, 0, 16384, 0, 0, 16384], np.int16), (20, 1))


def chunk(index: int, read_ns: int) -> Arrival:
    seq = np.arange(20 * index, 20 * index + 20)
    return Arrival(RawChunk(seq, seq * MS, COUNTS, np.zeros(20, np.uint8), 10.0 / 32768), read_ns)


@pytest.fixture
def items() -> ItemQueue:
    return ItemQueue()


class Held:
    """A request that the pipeline's thread is in the middle of until ``go_on`` is set."""

    def __init__(self) -> None:
        self.begun, self.go_on = threading.Event(), threading.Event()

    def __call__(self) -> str:
        self.begun.set()
        assert self.go_on.wait(WAIT_S)
        return 'done'


def test_a_request_that_was_given_up_is_never_carried_out(items: ItemQueue, monkeypatch: pytest.MonkeyPatch) -> None:
    processing, held, done = Processing(items, Pipeline(load_rig()), texts(print)), Held(), list[str]()
    processing.start()
    with ThreadPoolExecutor(1) as other:
        first = other.submit(processing.request, held)
        assert held.begun.wait(WAIT_S)
        with monkeypatch.context() as hasty:
            hasty.setattr(module, 'REQUEST_TIMEOUT_S', 0.01)
            with pytest.raises(TimeoutError, match='no data flows'):
                processing.request(lambda: done.append('too late'))
        held.go_on.set()
        assert first.result(WAIT_S) == 'done'
    processing.request(lambda: done.append('in time'))
    items.put(Ended())
    processing.join(WAIT_S)
    assert done == ['in time']


def test_a_request_that_was_begun_is_waited_for(items: ItemQueue, monkeypatch: pytest.MonkeyPatch) -> None:
    processing, held = Processing(items, Pipeline(load_rig()), texts(print)), Held()

    def impatient(asked: Collection[Future[Any]], timeout: float) -> Any:
        if not held.go_on.is_set():
            # The first time: its time is up in the middle of it.
            assert held.begun.wait(WAIT_S)
            held.go_on.set()
            return wait((Future(),), 0.0)
        return wait(asked, WAIT_S)

    monkeypatch.setattr(module, 'wait', impatient)
    processing.start()
    assert processing.request(held) == 'done'
    items.put(Ended())
    processing.join(WAIT_S)


def test_errors_of_a_request_come_through(items: ItemQueue) -> None:
    def reject() -> None:
        raise TimeoutError('its own')

    processing = Processing(items, Pipeline(load_rig()), texts(print))
    with pytest.raises(TimeoutError, match='its own'):
        processing.request(reject)
    processing.start()
    with pytest.raises(TimeoutError, match='its own'):
        processing.request(reject)
    items.put(Ended())
    processing.join(WAIT_S)


class Clock:
    """Stands at ``now`` but for the sinks: block i is with them at ``ends[i]``."""

    def __init__(self, ends: list[int]) -> None:
        self.now = 0
        self._ends = iter(ends)

    def __call__(self) -> int:
        return self.now

    def put(self, record: Record) -> None:
        if isinstance(record, DeflectionEstimate) and record.primary:
            self.now = next(self._ends)


def after(items: ItemQueue, read_and_end_ms: list[tuple[int, int]]) -> tuple[Processing, Clock]:
    """Processing and its clock after blocks that were read and had gone to the sinks at these times."""
    clock = Clock([end * MS for _, end in read_and_end_ms])
    processing = Processing(items, Pipeline(load_rig()), texts(print), clock)
    processing.sinks.append(clock)
    assert processing.latency() is None
    for index, (read, _) in enumerate(read_and_end_ms):
        items.put(chunk(index, read * MS))
    items.put(Ended())
    processing.start()
    processing.join(WAIT_S)
    assert processing.failed is None
    return processing, clock


def reported(processing: Processing) -> tuple[float, float] | None:
    latency = processing.latency()
    return (round(latency.median * 1e3), round(latency.worst * 1e3)) if latency is not None else None


def test_latency_is_last_byte_to_last_sink(items: ItemQueue) -> None:
    processing, clock = after(items, [(100, 400), (600, 900), (1290, 1300), (1330, 1350)])
    assert reported(processing) == (300, 300)
    clock.now = 1450 * MS
    assert reported(processing) == (20, 300)
    clock.now = 2000 * MS
    assert reported(processing) == (20, 20)
    clock.now = 3000 * MS
    assert reported(processing) is None
