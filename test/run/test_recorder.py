# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The recorder against a disk that fills, rejects, is slow or hangs: estimates flow on, every request is answered."""

import errno
import io
import json
import os
import queue
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from rosbags.rosbag2 import Reader

from msg_adapters import to_messages
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.files import HeldFolder
from psd_deflection.base.log import texts
from psd_deflection.cli.main import main
from psd_deflection.devices.protocol.frames import SampleFrame
from psd_deflection.recordings import cdr
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.repair import recover
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import DeflectionEstimate, ParameterChange, Record, SampleBlock
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run import recorder as recorder_module
from psd_deflection.run import session as session_module
from psd_deflection.run.diagnostics import WARN, HealthReporter
from psd_deflection.run.recorder import CHECK_EVERY, QUEUED_PER_BLOCK, Recorder
from psd_deflection.run.session import Session
from test.heard import WAIT_S, until
from test.recordings.making import block
from test.run.conftest import ScriptedDevice

MB = 1_000_000


class Disk:
    """What ``shutil.disk_usage`` says."""

    def __init__(self) -> None:
        self.free = 10_000 * MB
        self.asked = threading.Semaphore(0)

    def usage(self, path: Path) -> Any:
        self.asked.release()
        return SimpleNamespace(total=100_000 * MB, used=0, free=self.free)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    made = Disk()
    monkeypatch.setattr(shutil, 'disk_usage', made.usage)
    return made


class Run:
    def __init__(self, rig: Rig, queue_blocks: int = 1000) -> None:
        self.logged: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.recorder = Recorder(queue_blocks, texts(self.logged.put), lambda action: action())
        self.folder = self.start(rig)
        self.count = 0

    def start(self, rig: Rig) -> Path:
        folder = self.recorder.start(rig, None, lambda _: None).result(WAIT_S)
        assert folder is not None
        return folder

    def stop(self) -> Path | None:
        return self.recorder.stop().result(WAIT_S)

    def put(self, blocks: int) -> None:
        for _ in range(blocks):
            for topic, kind, t_ns, fields in to_messages(block(self.count)):
                self.recorder.put(topic, kind, cdr.encode(kind, fields), t_ns)
            self.count += 1

    def heard(self) -> str:
        return self.logged.get(timeout=WAIT_S)

    def indices(self) -> list[int]:
        return [b.index for b in open_recording(self.folder).blocks()]


def rig_for(tmp_path: Path, **changes: object) -> Rig:
    return load_rig(None, {'bag_dir': str(tmp_path / 'bags'), **changes})


def test_a_disk_that_is_nearly_full_ends_the_recording_whole(tmp_path: Path, disk: Disk) -> None:
    run = Run(rig_for(tmp_path, disk_reserve=200 * MB))
    run.put(CHECK_EVERY)
    assert disk.asked.acquire(timeout=WAIT_S)
    disk.free = 150 * MB
    run.put(2 * CHECK_EVERY)
    text = run.heard()
    assert (
        'the disk has 150 MB left, less than disk_reserve = 200 MB; the bag is closed and complete up to this time'
        in text
    )
    assert (text.count('\n'), run.recorder.folder) == (0, None)
    assert run.recorder.failure in text
    with Reader(run.folder) as reader:
        assert reader.message_count == run.recorder.written + 1
    run.put(1)
    with pytest.raises(RecordingError, match=r'150 MB left, .*; make room, or record elsewhere'):
        run.start(rig_for(tmp_path, disk_reserve=200 * MB))
    disk.free = 300 * MB
    second = run.start(rig_for(tmp_path, disk_reserve=200 * MB))
    assert second != run.folder
    assert run.recorder.failure == ''
    run.stop()


@pytest.mark.parametrize('how', ['deleted', 'moved'])
def test_a_recording_that_is_taken_away_ends_with_one_line(tmp_path: Path, how: str) -> None:
    run = Run(rig_for(tmp_path))
    run.put(1)
    if how == 'deleted':
        shutil.rmtree(run.folder)
    else:
        run.folder.rename(tmp_path / 'elsewhere')
    run.put(CHECK_EVERY)
    text = run.heard()
    assert '_0.mcap: was deleted or moved while it was recorded; start another recording' in text
    assert run.recorder.failure in text
    assert run.recorder.folder is None
    if how == 'moved':
        assert [b.index for b in open_recording(tmp_path / 'elsewhere').blocks()][:1] == [0]
        assert (tmp_path / 'elsewhere' / 'metadata.yaml').is_file()
    assert run.start(rig_for(tmp_path)).is_dir()
    run.stop()


@pytest.mark.parametrize('noticed', ['while it runs', 'at its end'])
def test_nothing_is_written_through_link_at_folder(tmp_path: Path, noticed: str) -> None:
    run = Run(rig_for(tmp_path))
    run.put(1)
    run.folder.rename(tmp_path / 'elsewhere')
    target = tmp_path / 'not ours'
    target.mkdir()
    (target / 'metadata.yaml').write_text('theirs')
    run.folder.symlink_to(target)
    if noticed == 'while it runs':
        run.put(CHECK_EVERY)
    else:
        # It is told of no recording that is not there.
        assert run.recorder.close() is None
    assert 'was deleted or moved' in run.heard()
    assert [p.name for p in target.iterdir()] == ['metadata.yaml']
    assert (target / 'metadata.yaml').read_text() == 'theirs'
    assert open_recording(tmp_path / 'elsewhere').complete


def test_no_error_ends_a_recording_in_silence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(rig_for(tmp_path))
    run.put(3)
    monkeypatch.setattr(BagWriter, 'write_encoded', Mock(side_effect=KeyError('no such type')))
    run.put(1)
    assert "KeyError: 'no such type'" in run.heard()
    assert run.recorder.folder is None
    assert run.recorder.failure
    # It is closed, so that whoever repairs it is not told that it is still being made.
    recover(run.folder)


def test_a_folder_that_cannot_be_made_says_the_way_out(tmp_path: Path) -> None:
    (tmp_path / 'bags').write_text('a file')
    with pytest.raises(RecordingError, match=r'cannot be made \(Not a directory\); .*record elsewhere'):
        Run(rig_for(tmp_path))


def test_the_oldest_file_is_deleted_where_that_was_asked_for(
    tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def after_deletion(folder: HeldFolder, name: str) -> None:
        disk.free += 100 * MB * name.endswith('.mcap')
        remove(folder, name)

    remove = HeldFolder.remove
    monkeypatch.setattr(HeldFolder, 'remove', after_deletion)
    mine = tmp_path / 'bags' / 'other' / 'other_0.mcap'
    mine.parent.mkdir(parents=True)
    mine.write_text('not of this recording')
    rig = rig_for(tmp_path, disk_reserve=200 * MB, disk_full='delete_oldest', bag_max_duration=1.0)
    run = Run(rig)
    run.put(CHECK_EVERY - 1)
    disk.free = 150 * MB
    run.put(1)
    assert 'deleted, the disk has 150 MB left' in run.heard()
    assert (run.stop(), run.recorder.files_deleted) == (run.folder, 1)
    assert mine.exists()
    assert run.indices() == list(range(50, CHECK_EVERY))
    with Reader(run.folder) as reader:
        assert reader.message_count == CHECK_EVERY - 50 + len(list(run.folder.glob('*.mcap')))


def test_files_older_than_bag_keep_are_deleted(tmp_path: Path) -> None:
    run = Run(rig_for(tmp_path, bag_keep=1.39))
    run.put(CHECK_EVERY)
    assert run.heard().endswith('_0.mcap: deleted, it ended more than bag_keep = 1.39 s ago')
    run.stop()
    # Files of ten blocks: a seventh of 1.39 s is just less.
    assert (run.recorder.files_deleted, run.indices()) == (18, list(range(180, CHECK_EVERY)))
    assert open_recording(run.folder).warnings == []


def test_with_nothing_to_delete_it_ends(tmp_path: Path, disk: Disk) -> None:
    run = Run(rig_for(tmp_path, disk_reserve=200 * MB, disk_full='delete_oldest'))
    disk.free = 150 * MB
    run.put(CHECK_EVERY)
    assert 'no older file of this recording' in run.heard()


def test_failing_disk_ends_recording_with_advice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(rig_for(tmp_path))
    monkeypatch.setattr(os, 'fsync', Mock(side_effect=OSError(errno.EIO, 'Input/output error')))
    run.put(60)
    text = run.heard()
    assert 'Input/output error' in text
    assert f'psd-deflection recover {run.folder}' in text
    monkeypatch.undo()
    assert run.stop() is None


def test_a_slow_disk_holds_up_nothing_and_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, waiting = threading.Event(), threading.Event()
    fsync = os.fsync

    def slow(fd: int) -> None:
        waiting.set()
        go_on.wait()
        fsync(fd)

    limit = 2 * QUEUED_PER_BLOCK
    run = Run(rig_for(tmp_path), queue_blocks=2)
    monkeypatch.setattr(os, 'fsync', slow)
    run.put(1)
    # The idle flush writes what is there; then the disk stands still.
    assert waiting.wait(WAIT_S)
    run.put(limit + 80)

    assert run.recorder.dropped == 80
    run.recorder.put_change(ParameterChange(0, 7, (('sum_min', 1.0),)))
    go_on.set()
    run.stop()
    recording = open_recording(run.folder)
    assert (run.indices(), [c.block for c in recording.changes]) == (list(range(limit + 1)), [7])


def test_flushed_messages_survive_a_missing_end(tmp_path: Path) -> None:
    """A chunk ends by itself where nothing more comes."""
    run = Run(rig_for(tmp_path))
    run.put(3)
    file = run.folder / f'{run.folder.name}_0.mcap'
    watch = threading.Event()
    blocks: list[SampleBlock] = []
    for _ in range(3000):
        (tmp_path / 'left.mcap').write_bytes(file.read_bytes())
        recording = open_recording(tmp_path / 'left.mcap')
        if recording.topics():
            blocks = list(recording.blocks())
            break
        watch.wait(0.02)
    assert [b.index for b in blocks] == [0, 1, 2]
    run.stop()


def test_a_recording_stays_in_its_folder(tmp_path: Path) -> None:
    run = Run(rig_for(tmp_path))
    assert (run.folder.parent, run.start(rig_for(tmp_path))) == (tmp_path / 'bags', run.folder)
    run.stop()


Sample = Callable[..., SampleFrame]
BLOCKS = 50
"""A second of them: recorded, they fill a chunk and more."""


class HangingDisk:
    """Where recordings are made; hangs in the call that is ``hangs_at`` until ``go_on`` is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.hangs_at = ''
        self.reached = threading.Event()
        self.go_on = threading.Event()
        hanging_disk, real_create, real_fsync = self, HeldFolder.create, os.fsync

        class Stream(io.BufferedWriter):
            def write(self, content: Any) -> int:
                hanging_disk.call('write')
                return super().write(content)

            def close(self) -> None:
                hanging_disk.call('close')
                super().close()

        def created(folder: HeldFolder, name: str) -> Any:
            if not name.endswith('.mcap'):
                return real_create(folder, name)
            hanging_disk.call('open')
            real_create(folder, name).close()
            return Stream(io.FileIO(folder.path / name, 'ab'))

        def synced(fd: int) -> None:
            hanging_disk.call('fsync')
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

    def await_reached(self) -> None:
        assert self.reached.wait(WAIT_S)


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
def hanging_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[HangingDisk]:
    # However busy the machine is: only what a test does makes a device silent.
    monkeypatch.setattr(session_module, 'SILENT_S', 1e3)
    disk = HangingDisk(monkeypatch)
    yield disk
    disk.go_on.set()
    for thread in threading.enumerate():
        if thread.name in ('recorder', 'zero'):
            thread.join(WAIT_S)


@pytest.fixture
def live(hanging_disk: HangingDisk, device: ScriptedDevice, sample: Sample, tmp_path: Path) -> Iterator[Live]:
    made = Live(device, sample, tmp_path / 'bags')
    made.session.start()
    made.flow()
    yield made
    hanging_disk.go_on.set()
    made.session.close()


def recorders() -> list[threading.Thread]:
    return [t for t in threading.enumerate() if t.name == 'recorder']


def blocks_of(folder: Path) -> list[int]:
    recording = open_recording(folder)
    assert recording.complete
    return [block.index for block in recording.blocks()]


@pytest.mark.parametrize('where', ['open', 'write', 'fsync'])
def test_estimates_flow_while_disk_hangs_at_start(live: Live, hanging_disk: HangingDisk, where: str) -> None:
    hanging_disk.hang(where)
    first = live.session.record(True)
    hanging_disk.await_reached()
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
    hanging_disk.go_on.set()
    folder = first.result(WAIT_S)
    assert folder is not None
    assert (second.result(WAIT_S), live.session.recorder.folder) == (folder, folder)
    live.flow()
    assert (live.record(False), blocks_of(folder)) == (folder, list(range(3 * BLOCKS, 4 * BLOCKS)))
    assert main(['replay', str(folder), '--compare']) == 0


@pytest.mark.slow
@pytest.mark.parametrize('where', ['write', 'fsync'])
def test_estimates_flow_while_the_disk_hangs_in_a_recording(live: Live, hanging_disk: HangingDisk, where: str) -> None:
    folder = live.record(True)
    hanging_disk.hang(where)
    live.flow()
    hanging_disk.await_reached()
    live.flow()
    ended = live.session.record(False)
    live.flow()
    assert not ended.done()
    hanging_disk.go_on.set()
    assert (ended.result(WAIT_S), live.heard('recording ended')) == (folder, f'recording ended: {folder}')
    assert blocks_of(folder) == list(range(BLOCKS, 3 * BLOCKS))


@pytest.mark.slow
def test_estimates_flow_while_disk_hangs_at_end(live: Live, hanging_disk: HangingDisk) -> None:
    first = live.record(True)
    live.flow()
    hanging_disk.hang('close')
    ended = live.session.record(False)
    hanging_disk.await_reached()
    live.flow()
    second = live.record(True)
    assert second != first
    live.flow()
    assert live.record(False) == second
    assert not ended.done()
    hanging_disk.go_on.set()
    assert (ended.result(WAIT_S), blocks_of(first)) == (first, list(range(BLOCKS, 2 * BLOCKS)))
    assert blocks_of(second) == list(range(3 * BLOCKS, 4 * BLOCKS))


def test_stop_reports_a_recording_that_cannot_be_closed(
    live: Live, hanging_disk: HangingDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    live.record(True)
    live.flow()
    monkeypatch.setattr(os, 'fsync', Mock(side_effect=OSError(errno.EIO, 'Input/output error')))
    with pytest.raises(RecordingError, match=r'Input/output error.*psd-deflection recover'):
        live.session.record(False).result(WAIT_S)


def test_self_ended_recording_is_not_taken_for_running(
    live: Live, hanging_disk: HangingDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = live.record(True)
    hanging_disk.hang('close')
    with monkeypatch.context() as broken:
        broken.setattr(BagWriter, 'write_encoded', Mock(side_effect=KeyError('no such type')))
        live.flow()
        hanging_disk.await_reached()
    assert live.session.recorder.folder is None
    second = live.record(True)
    assert second != first
    live.flow()
    hanging_disk.go_on.set()
    live.heard('no such type')
    assert live.session.recorder.folder == second


def test_a_start_that_hangs_can_be_ended(live: Live, hanging_disk: HangingDisk, tmp_path: Path) -> None:
    hanging_disk.hang('fsync')
    started = live.session.record(True)
    hanging_disk.await_reached()
    assert live.session.record(False).result(WAIT_S) is None
    with pytest.raises(RecordingError, match='ended before the disk answered; nothing was recorded'):
        started.result(WAIT_S)
    again = live.session.record(True)
    hanging_disk.go_on.set()
    folder = again.result(WAIT_S)
    assert folder is not None
    live.flow()
    assert (live.record(False), list((tmp_path / 'bags').iterdir())) == (folder, [folder])


def test_a_start_that_hangs_does_not_hold_up_the_end_of_the_run(live: Live, hanging_disk: HangingDisk) -> None:
    hanging_disk.hang('fsync')
    started = live.session.record(True)
    hanging_disk.await_reached()
    live.session.close()
    with pytest.raises(RecordingError, match='nothing was recorded'):
        started.result(WAIT_S)
    with pytest.raises(RecordingError, match='the run has ended'):
        live.session.record(True).result(WAIT_S)
    assert not hanging_disk.go_on.is_set()


@pytest.mark.slow
def test_starts_and_stops_without_end_use_few_threads(live: Live, hanging_disk: HangingDisk) -> None:
    hanging_disk.hang('open')
    before = threading.active_count()
    rejections = []
    for _ in range(50):
        started = live.session.record(True)
        live.session.record(False).result(WAIT_S)
        rejections.append(str(started.exception(WAIT_S)))
    assert threading.active_count() - before <= recorder_module.MOST_THREADS
    assert rejections[-1] == f'not recorded: {recorder_module.MOST_THREADS} recordings wait for the disk already'
    hanging_disk.go_on.set()


@pytest.mark.slow
@pytest.mark.parametrize('asked_for', [False, True])
def test_recording_holds_up_the_end_for_limited_time(
    live: Live, hanging_disk: HangingDisk, monkeypatch: pytest.MonkeyPatch, asked_for: bool
) -> None:
    monkeypatch.setattr(recorder_module, 'JOIN_S', 0.01)
    folder = live.record(True)
    hanging_disk.hang('close')
    if asked_for:
        live.session.record(False)
    live.session.close()
    reported = live.heard('the run ends before its bag is closed: 0 messages are not written')
    assert reported.startswith(f'{folder}: ')
    assert not hanging_disk.go_on.is_set()


@pytest.fixture
def stalled(
    hanging_disk: HangingDisk, device: ScriptedDevice, sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Live:
    """A run that has begun with a recording for which the disk hangs."""
    monkeypatch.setattr(session_module, 'OPEN_S', 0.01)
    made = Live(device, sample, tmp_path / 'bags', record=True)
    hanging_disk.hang('open')
    made.session.start()
    return made


def test_a_disk_that_hangs_does_not_hold_up_the_start_of_a_run(hanging_disk: HangingDisk, stalled: Live) -> None:
    stalled.heard('the disk does not answer; the recording begins when it does')
    stalled.flow()
    hanging_disk.go_on.set()
    stalled.heard('recording to')
    stalled.flow()
    folder = stalled.session.close()
    assert folder is not None
    assert blocks_of(folder) == list(range(BLOCKS, 2 * BLOCKS))


def test_a_late_disk_error_is_reported(hanging_disk: HangingDisk, stalled: Live, tmp_path: Path) -> None:
    hanging_disk.await_reached()
    (folder,) = (tmp_path / 'bags').iterdir()
    folder.rmdir()
    hanging_disk.go_on.set()
    assert 'No such file' in stalled.heard('not recorded: ')
    assert 'No such file' in stalled.session.recorder.failure
    stalled.flow()
    stalled.session.close()


def test_a_disk_that_rejects_at_once_ends_the_start(device: ScriptedDevice, sample: Sample, tmp_path: Path) -> None:
    (tmp_path / 'bags').write_text('a file')
    made = Live(device, sample, tmp_path / 'bags', record=True)
    with pytest.raises(RecordingError, match='cannot be made'):
        made.session.start()
    made.session.close()
    assert not made.session.processing.alive


def test_recording_without_pipeline_leaves_nothing(tmp_path: Path) -> None:
    rig = load_rig(overrides={'bag_dir': str(tmp_path / 'bags')})
    recorder = Recorder(10, texts(print), Mock(side_effect=TimeoutError('no data flows')))
    started: Future[Path | None] = recorder.start(rig, None, lambda _: None)
    with pytest.raises(TimeoutError, match='no data flows'):
        started.result(WAIT_S)
    assert not recorder.opening
    for thread in recorders():
        thread.join(WAIT_S)
    assert list((tmp_path / 'bags').iterdir()) == []


def test_estimates_flow_while_the_disk_hangs_at_a_zero(live: Live, hanging_disk: HangingDisk, tmp_path: Path) -> None:
    hanging_disk.hang('fsync')
    assert live.session.zero() is not None
    hanging_disk.await_reached()
    live.flow()
    live.session.change({'psd_1.zero': (3e-4, 0.0)})
    live.session.change({'psd_1.zero': (1e-4, -2e-4)})
    live.flow()
    hanging_disk.go_on.set()

    def stored() -> object:
        path = tmp_path / 'zero.json'
        return json.loads(path.read_text())['psd_1.zero'] if path.exists() else None

    until(lambda: stored() == [1e-4, -2e-4])
    live.session.close()
    assert stored() == [1e-4, -2e-4]


@pytest.mark.slow
def test_zero_holds_up_the_end_for_limited_time(
    live: Live, hanging_disk: HangingDisk, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(session_module, 'KEEP_S', 0.01)
    hanging_disk.hang('fsync')
    assert live.session.zero() is not None
    hanging_disk.await_reached()
    live.session.close()
    assert live.heard('the zero may not be kept').startswith(str(tmp_path / 'zero.json'))
    assert not hanging_disk.go_on.is_set()
