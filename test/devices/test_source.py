# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Sources by name, plug-ins included, and what the reader makes of a source's own kinds of time."""

import queue
import threading
import time
from collections.abc import Mapping
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.base.log import null_log, texts
from psd_deflection.devices import registry as _registry
from psd_deflection.devices.contract_frames import ContractFrames
from psd_deflection.devices.protocol.frames import BadFrame, HelloFrame
from psd_deflection.devices.pseudo_terminal import PseudoTerminal
from psd_deflection.devices.registry import make_source, source_names
from psd_deflection.devices.source import Clock, PortClosedError, Received, Sample, Source, SourceEndedError
from psd_deflection.records import CHANNELS
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run.acquisition import Acquisition
from psd_deflection.run.arrivals import Arrival, Ended, Item
from test.heard import WAIT_S

pytestmark = pytest.mark.slow
VOLTS = (0.1, 0.2, 5.0, 0.3, 0.4, 5.0)


class Scripted(Source):
    """Gives ``script`` reading by reading; an exception in it is raised."""

    volts = True

    def __init__(self, rig: Rig) -> None:
        self.name = 'scripted'
        self.script: list[list[Any] | Exception] = []
        self.calls: list[str] = []

    def open(self, timeout: float) -> HelloFrame:
        self.calls.append('open')
        info: dict[str, object] = {'serial': 'S-1', 'firmware': 'test', 'sample_rate_hz': 1000.0}
        return HelloFrame(1, info | {'channels': list(CHANNELS), 'volts_per_count': None})

    def start(self) -> None:
        self.calls.append('start')

    def read(self, timeout: float) -> Received:
        if not self.script:
            raise SourceEndedError('at its end')
        step = self.script.pop(0)
        if isinstance(step, Exception):
            raise step
        return Received(step, time.monotonic_ns(), len(step))

    def close(self) -> None:
        self.calls.append('close')

    def describe(self) -> Mapping[str, str]:
        return {'source': 'scripted'}


class NotASource:
    pass


@pytest.fixture(autouse=True)
def plug_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    here = EntryPoints(
        [
            EntryPoint('scripted', f'{__name__}:Scripted', _registry.GROUP),
            EntryPoint('broken', f'{__name__}.nowhere:Nothing', _registry.GROUP),
            EntryPoint('odd', f'{__name__}:NotASource', _registry.GROUP),
        ]
    )

    def load(point: EntryPoint) -> Any:
        return globals()[point.attr]

    monkeypatch.setattr(EntryPoint, 'load', load)
    monkeypatch.setattr(_registry, 'entry_points', lambda group: here)


def acquisition_of(
    script: list[list[Any] | Exception], clock: Clock = Clock.HOST, numbered: bool = True
) -> Acquisition:
    source = Scripted(load_rig())
    source.script, source.clock, source.numbered = script, clock, numbered
    with patch('psd_deflection.run.acquisition.make_source', lambda rig: source):
        return Acquisition(load_rig(), null_log)


def run(acquisition: Acquisition) -> list[Item]:
    acquisition.open()
    acquisition.start()
    items: list[Item] = []
    while not items or not isinstance(items[-1], Ended):
        items.append(acquisition.queue.get(timeout=WAIT_S))
    acquisition.stop()
    return items


def chunks(items: list[Item]) -> list[Arrival]:
    return [i for i in items if isinstance(i, Arrival)]


def test_a_source_is_ours_or_that_of_an_entry_point() -> None:
    assert isinstance(make_source(load_rig(overrides={'port': 'x'})), ContractFrames)
    assert isinstance(make_source(load_rig(overrides={'source': 'scripted'})), Scripted)
    assert source_names()[0] == 'serial'
    assert 'scripted' in source_names()


@pytest.mark.parametrize(
    ('name', 'message'),
    [
        ('serail', 'did you mean serial'),
        ('broken', 'cannot be loaded'),
        ('odd', 'neither a psd_deflection.devices.Device nor derived from Source'),
    ],
)
def test_a_name_that_makes_no_source_is_rejected(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        make_source(load_rig(overrides={'source': name}))
    assert f"source = '{name}'" in str(error.value)


def test_recorded_times_and_volts_go_through_as_they_are() -> None:
    t = [10**18 + 1_000_000 * i + 7 for i in range(20)]
    acquisition = acquisition_of([[Sample(0, i, t[i], VOLTS) for i in range(20)]], Clock.RECORDED)
    (chunk,) = chunks(run(acquisition))
    assert chunk.raw.t_ns.tolist() == t
    assert chunk.raw.volts_per_count is None
    assert chunk.raw.readings.dtype == np.float32
    np.testing.assert_array_equal(chunk.raw.readings[3], np.array(VOLTS, np.float32))


def test_times_of_the_host_are_moved_to_ros_time_by_one_constant() -> None:
    t = [5_000_000 * i for i in range(40)]
    acquisition = acquisition_of([[Sample(0, i, t[i], VOLTS) for i in range(40)]])
    taken = np.concatenate([c.raw.t_ns for c in chunks(run(acquisition))])
    assert np.diff(taken).tolist() == [5_000_000] * 39
    assert abs(int(taken[0]) - (time.time_ns() - time.monotonic_ns())) < 10**9


def test_device_without_numbers_returns_in_new_block() -> None:
    script: list[list[Any] | Exception] = [
        [Sample(0, i, i * 1000, VOLTS) for i in range(30)],
        PortClosedError('scripted: gone'),
        [Sample(0, i, i * 1000, VOLTS) for i in range(20)],
    ]
    acquisition = acquisition_of(script, Clock.COUNTED, numbered=False)
    items = run(acquisition)
    assert [int(s) for c in chunks(items) for s in c.raw.seq] == [*range(30), *range(40, 60)]
    counters = acquisition.counters
    assert (counters.disconnects, counters.restarts, counters.lost, counters.repeated) == (1, 1, 0, 0)
    source = acquisition.source
    assert isinstance(source, Scripted)
    assert source.calls == ['open', 'start', 'close', 'open', 'start', 'close']


def test_failing_device_is_waited_for_like_lost_port() -> None:
    acquisition = acquisition_of([DeviceError('scripted: says nothing we know'), [Sample(0, 0, 0, VOLTS)]])
    assert len(chunks(run(acquisition))) == 1
    assert acquisition.counters.disconnects == 1
    assert acquisition.failed is None


@pytest.mark.filterwarnings('ignore::pytest.PytestUnhandledThreadExceptionWarning')
def test_a_source_that_breaks_ends_the_run_as_an_error() -> None:
    acquisition = acquisition_of([[Sample(0, 0, 0, VOLTS)], ZeroDivisionError('in a plug-in')])
    assert len(chunks(run(acquisition))) == 1
    assert isinstance(acquisition.failed, ZeroDivisionError)


def test_a_source_gives_its_own_reasons_for_bad_frames() -> None:
    acquisition = acquisition_of([[BadFrame('five fields', 9), BadFrame('five fields', 9)]])
    run(acquisition)
    assert acquisition.counters.bad_frames == {'five fields': 2}


def test_a_device_that_goes_away_before_it_starts_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    acquisition = acquisition_of([[Sample(0, i, i * 1000, VOLTS) for i in range(20)]])
    starts = [DeviceError('scripted: did not confirm')]

    def start(self: Scripted) -> None:
        if starts:
            raise starts.pop()

    monkeypatch.setattr(Scripted, 'start', start)
    assert [int(s) for c in chunks(run(acquisition)) for s in c.raw.seq] == list(range(20))
    assert acquisition.counters.disconnects == 1


@pytest.mark.parametrize('gives_up', [True, False])
def test_a_run_that_ends_waits_for_no_source(monkeypatch: pytest.MonkeyPatch, gives_up: bool) -> None:
    """One that waits for its device is told to give up; one that hangs is left behind."""
    monkeypatch.setattr('psd_deflection.run.acquisition.GIVE_UP_TIMES', 1000 if gives_up else 1)
    waiting, over = threading.Event(), threading.Event()

    class Patient(Scripted):
        def reopen(self) -> HelloFrame | None:
            waiting.set()
            over.wait()
            raise DeviceError('scripted: given up')

        def give_up(self) -> None:
            if gives_up:
                over.set()

    logged: list[str] = []
    acquisition = Acquisition(load_rig(overrides={'source': 'scripted'}), texts(logged.append))
    acquisition.source = source = Patient(load_rig())
    source.script = [PortClosedError('scripted: gone')]
    acquisition.open()
    acquisition.start()
    assert waiting.wait(WAIT_S)
    acquisition.stop()
    assert isinstance(acquisition.queue.get(timeout=WAIT_S), Ended)
    hangs = ['scripted: the source hangs; it is not waited for']
    assert logged[logged.index('scripted: gone; waiting for it to come back') + 1 :] == ([] if gives_up else hangs)
    over.set()


@pytest.mark.parametrize('name', ['serial', 'lines', 'dataq', 'thorlabs'])
def test_each_of_ours_gives_up_waiting(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However long it would wait for a device that says nothing."""
    for waits in ('text_lines.BOOT_S', 'dataq.STOP_S'):
        monkeypatch.setattr(f'psd_deflection.devices.{waits}', 1e6)
    ports = [PseudoTerminal(tmp_path / f'port_{i}') for i in range(2)]
    port = ','.join(p.name for p in ports) if name == 'thorlabs' else ports[0].name
    source = make_source(load_rig(overrides={'source': name, 'port': port}))
    outcome: queue.SimpleQueue[Exception] = queue.SimpleQueue()

    def wait() -> None:
        try:
            source.open(1e6)
        except DeviceError as error:
            outcome.put(error)

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    for _ in range(1000):
        source.give_up()
        thread.join(0.05)
        if not thread.is_alive():
            break
    assert 'given up' in str(outcome.get(timeout=WAIT_S))
    for opened in ports:
        opened.close()
