# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A disk that hangs: estimates flow on meanwhile, and every request gets a true answer."""

import io
import json
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from psd_deflection.base.errors import RecordingError
from psd_deflection.base.files import HeldFolder
from psd_deflection.base.log import texts
from psd_deflection.cli.main import main
from psd_deflection.devices.protocol.frames import SampleFrame
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.records import DeflectionEstimate, Record
from psd_deflection.rig.config import load_rig
from psd_deflection.run import recorder as recorder_module
from psd_deflection.run import session as session_module
from psd_deflection.run.diagnostics import WARN, HealthReporter
from psd_deflection.run.recorder import Recorder
from psd_deflection.run.session import Session
from test.heard import WAIT_S, until
from test.run.conftest import ScriptedDevice

Sample = Callable[..., SampleFrame]
BLOCKS = 50
"""A second of them: recorded, they fill a chunk and more."""


class Disk:
    """Where recordings are made; hangs in the call that is ``hangs_at`` until ``go_on`` is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.hangs_at = ''
        self.reached = threading.Event()
        self.go_on = threading.Event()
        disk, real_create, real_fsync = self, HeldFolder.create, os.fsync

        class Stream(io.BufferedWriter):
            def write(self, content: Any) -> int:
                disk.call('write')
                return super().write(content)

            def close(self) -> None:
                disk.call('close')
                super().close()

        def created(folder: HeldFolder, name: str) -> Any:
            if not name.endswith('.mcap'):
                return real_create(folder, name)
            disk.call('open')
            real_create(folder, name).close()
            return Stream(io.FileIO(folder.path / name, 'ab'))

        def synced(fd: int) -> None:
            disk.call('fsync')
            real_fsync(fd)

        monkeypatch.setattr(HeldFolder, 'create', created)
        monkeypatch.setattr(os, 'fsync', synced)

    def call(self, what: str) -> None:
        if what == self.hangs_at:
            self.hangs_at = ''
            self.reached.set()
            assert self.go_on.wait(WAIT_S)

    def hang(self, what: str) -> None:
        self.reached.clear()
        self.go_on.clear()
        self.hangs_at = what

    def is_reached(self) -> bool:
        return self.reached.wait(WAIT_S)


class Live:
    """A session on ``device`` that has not started; :meth:`flow` is a second of its stream."""

    def __init__(self, device: ScriptedDevice, sample: Sample, bags: Path, **parameters: Any) -> None:
        self.logged: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.estimates = threading.Semaphore(0)
        values = {'port': str(device.link), 'bag_dir': str(bags), 'zero_file': str(bags.parent / 'zero.json')}
        self.session = Session(load_rig(overrides={**values, 'realtime': False, **parameters}), texts(self.logged.put))
        self.session.processing.sinks.append(self)
        self._device, self._sample, self._sent = device, sample, 0

    def put(self, record: Record) -> None:
        if isinstance(record, DeflectionEstimate) and record.primary:
            self.estimates.release()

    def flow(self) -> None:
        """A second of samples goes in, and their estimates come out of the pipeline's thread."""
        first, self._sent = self._sent, self._sent + 20 * BLOCKS
        for seq in range(first, self._sent, 100):
            self._device.send_frames(*(self._sample(s) for s in range(seq, seq + 100)))
        for _ in range(BLOCKS):
            assert self.estimates.acquire(timeout=WAIT_S)

    def heard(self, text: str) -> str:
        while text not in (line := self.logged.get(timeout=WAIT_S)):
            pass
        return line

    def record(self, wanted: bool) -> Path:
        folder = self.session.record(wanted).result(WAIT_S)
        assert folder is not None
        return folder


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    # However busy the machine is: only what a test does makes a device silent.
    monkeypatch.setattr(session_module, 'SILENT_S', 1e3)
    one = Disk(monkeypatch)
    yield one
    one.go_on.set()
    for thread in threading.enumerate():
        if thread.name in ('recorder', 'zero'):
            thread.join(WAIT_S)


@pytest.fixture
def live(disk: Disk, device: ScriptedDevice, sample: Sample, tmp_path: Path) -> Iterator[Live]:
    one = Live(device, sample, tmp_path / 'bags')
    one.session.start()
    one.flow()
    yield one
    disk.go_on.set()
    one.session.close()


def recorders() -> list[threading.Thread]:
    return [t for t in threading.enumerate() if t.name == 'recorder']


def blocks_of(folder: Path) -> list[int]:
    recording = open_recording(folder)
    assert recording.complete
    return [block.index for block in recording.blocks()]


@pytest.mark.parametrize('where', ['open', 'write', 'fsync'])
def test_estimates_flow_while_disk_hangs_at_start(live: Live, disk: Disk, where: str) -> None:
    disk.hang(where)
    first = live.session.record(True)
    assert disk.is_reached()
    live.flow()
    second = live.session.record(True)
    assert not first.done()
    assert live.session.recorder.opening
    health = HealthReporter(live.session).report(time.time_ns()).entries[-1]
    assert (health.level, health.message) == (WARN, 'a recording was asked for; the disk has not answered yet')
    # Other requests are carried out, and what they change is in the recording that begins later.
    assert live.session.zero() is not None
    live.session.change({'psd_1.zero': (1e-4, -2e-4)})
    live.flow()
    assert not first.done()
    disk.go_on.set()
    folder = first.result(WAIT_S)
    assert folder is not None
    assert second.result(WAIT_S) == folder
    assert live.session.recorder.folder == folder
    live.flow()
    assert live.record(False) == folder
    assert blocks_of(folder) == list(range(3 * BLOCKS, 4 * BLOCKS))
    assert main(['replay', str(folder), '--compare']) == 0


@pytest.mark.slow
@pytest.mark.parametrize('where', ['write', 'fsync'])
def test_estimates_flow_while_the_disk_hangs_in_a_recording(live: Live, disk: Disk, where: str) -> None:
    folder = live.record(True)
    disk.hang(where)
    live.flow()
    assert disk.is_reached()
    live.flow()
    ended = live.session.record(False)
    live.flow()
    assert not ended.done()
    disk.go_on.set()
    assert ended.result(WAIT_S) == folder
    assert live.heard('recording ended') == f'recording ended: {folder}'
    assert blocks_of(folder) == list(range(BLOCKS, 3 * BLOCKS))


@pytest.mark.slow
def test_estimates_flow_while_disk_hangs_at_end(live: Live, disk: Disk) -> None:
    first = live.record(True)
    live.flow()
    disk.hang('close')
    ended = live.session.record(False)
    assert disk.is_reached()
    live.flow()
    second = live.record(True)
    assert second != first
    live.flow()
    assert live.record(False) == second
    assert not ended.done()
    disk.go_on.set()
    assert ended.result(WAIT_S) == first
    assert blocks_of(first) == list(range(BLOCKS, 2 * BLOCKS))
    assert blocks_of(second) == list(range(3 * BLOCKS, 4 * BLOCKS))


def test_stop_reports_a_recording_that_cannot_be_closed(
    live: Live, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reject(fd: int) -> None:
        raise OSError(5, 'Input/output error')

    live.record(True)
    live.flow()
    monkeypatch.setattr(os, 'fsync', reject)
    with pytest.raises(RecordingError, match=r'Input/output error.*psd-deflection recover'):
        live.session.record(False).result(WAIT_S)


def test_self_ended_recording_is_not_taken_for_running(live: Live, disk: Disk, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(*_: object) -> None:
        raise KeyError('no such type')

    first = live.record(True)
    disk.hang('close')
    with monkeypatch.context() as broken:
        broken.setattr('psd_deflection.recordings.write.bag_writer.BagWriter.write_encoded', gone)
        live.flow()
        assert disk.is_reached()
    assert live.session.recorder.folder is None
    second = live.record(True)
    assert second != first
    live.flow()
    disk.go_on.set()
    live.heard('no such type')
    assert live.session.recorder.folder == second


def test_a_start_that_hangs_can_be_ended(live: Live, disk: Disk, tmp_path: Path) -> None:
    disk.hang('fsync')
    started = live.session.record(True)
    assert disk.is_reached()
    assert live.session.record(False).result(WAIT_S) is None
    with pytest.raises(RecordingError, match='ended before the disk answered; nothing was recorded'):
        started.result(WAIT_S)
    again = live.session.record(True)
    disk.go_on.set()
    folder = again.result(WAIT_S)
    assert folder is not None
    live.flow()
    assert live.record(False) == folder
    assert list((tmp_path / 'bags').iterdir()) == [folder]


def test_a_start_that_hangs_does_not_hold_up_the_end_of_the_run(live: Live, disk: Disk) -> None:
    disk.hang('fsync')
    started = live.session.record(True)
    assert disk.is_reached()
    live.session.close()
    with pytest.raises(RecordingError, match='nothing was recorded'):
        started.result(WAIT_S)
    with pytest.raises(RecordingError, match='the run has ended'):
        live.session.record(True).result(WAIT_S)
    assert not disk.go_on.is_set()


@pytest.mark.slow
def test_starts_and_stops_without_end_use_few_threads(live: Live, disk: Disk) -> None:
    disk.hang('open')
    before = threading.active_count()
    rejections = []
    for _ in range(50):
        started = live.session.record(True)
        live.session.record(False).result(WAIT_S)
        rejections.append(str(started.exception(WAIT_S)))
    assert threading.active_count() - before <= recorder_module.MOST_THREADS
    assert rejections[-1] == f'not recorded: {recorder_module.MOST_THREADS} recordings wait for the disk already'
    disk.go_on.set()


@pytest.mark.slow
@pytest.mark.parametrize('asked_for', [False, True])
def test_recording_holds_up_the_end_for_limited_time(
    live: Live, disk: Disk, monkeypatch: pytest.MonkeyPatch, asked_for: bool
) -> None:
    monkeypatch.setattr(recorder_module, 'JOIN_S', 0.01)
    folder = live.record(True)
    disk.hang('close')
    if asked_for:
        live.session.record(False)
    live.session.close()
    reported = live.heard('it is not waited for, and 0 messages are not written')
    assert reported.startswith(f'{folder}: ')
    assert not disk.go_on.is_set()


def test_a_disk_that_hangs_does_not_hold_up_the_start_of_a_run(
    disk: Disk, device: ScriptedDevice, sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session_module, 'OPEN_S', 0.01)
    one = Live(device, sample, tmp_path / 'bags', record=True)
    disk.hang('open')
    one.session.start()
    one.heard('the disk does not answer; the recording begins when it does')
    one.flow()
    disk.go_on.set()
    one.heard('recording to')
    one.flow()
    folder = one.session.close()
    assert folder is not None
    assert blocks_of(folder) == list(range(BLOCKS, 2 * BLOCKS))


def test_a_late_disk_error_is_reported(
    disk: Disk, device: ScriptedDevice, sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session_module, 'OPEN_S', 0.01)
    (tmp_path / 'bags').mkdir()
    one = Live(device, sample, tmp_path / 'bags', record=True)
    disk.hang('open')
    one.session.start()
    assert disk.is_reached()
    (folder,) = (tmp_path / 'bags').iterdir()
    folder.rmdir()
    disk.go_on.set()
    assert 'No such file' in one.heard('not recorded: ')
    assert 'No such file' in one.session.recorder.failure
    one.flow()
    one.session.close()


def test_a_disk_that_rejects_at_once_ends_the_start(device: ScriptedDevice, sample: Sample, tmp_path: Path) -> None:
    (tmp_path / 'bags').write_text('a file')
    one = Live(device, sample, tmp_path / 'bags', record=True)
    with pytest.raises(RecordingError, match='cannot be made'):
        one.session.start()
    one.session.close()
    assert not one.session.processing.alive


def test_recording_without_pipeline_leaves_nothing(tmp_path: Path) -> None:
    def busy(action: Callable[[], None]) -> None:
        raise TimeoutError('no data flows')

    rig = load_rig(overrides={'bag_dir': str(tmp_path / 'bags')})
    recorder = Recorder(10, texts(print), busy)
    started: Future[Path | None] = recorder.start(rig, None, lambda _: None)
    with pytest.raises(TimeoutError, match='no data flows'):
        started.result(WAIT_S)
    assert not recorder.opening
    for thread in recorders():
        thread.join(WAIT_S)
    assert list((tmp_path / 'bags').iterdir()) == []


def test_estimates_flow_while_the_disk_hangs_at_a_zero(live: Live, disk: Disk, tmp_path: Path) -> None:
    disk.hang('fsync')
    assert live.session.zero() is not None
    assert disk.is_reached()
    live.flow()
    live.session.change({'psd_1.zero': (3e-4, 0.0)})
    live.session.change({'psd_1.zero': (1e-4, -2e-4)})
    live.flow()
    disk.go_on.set()

    def kept() -> object:
        path = tmp_path / 'zero.json'
        return json.loads(path.read_text())['psd_1.zero'] if path.exists() else None

    until(lambda: kept() == [1e-4, -2e-4])
    live.session.close()
    assert kept() == [1e-4, -2e-4]


@pytest.mark.slow
def test_zero_holds_up_the_end_for_limited_time(
    live: Live, disk: Disk, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(session_module, 'KEEP_S', 0.01)
    disk.hang('fsync')
    assert live.session.zero() is not None
    assert disk.is_reached()
    live.session.close()
    assert live.heard('the zero may not be kept').startswith(str(tmp_path / 'zero.json'))
    assert not disk.go_on.is_set()
