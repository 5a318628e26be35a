# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The recorder against a disk that fills, rejects, or is slow."""

import errno
import os
import queue
import shutil
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rosbags.rosbag2 import Reader

from msg_adapters import to_messages
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.files import HeldFolder
from psd_deflection.base.log import texts
from psd_deflection.recordings import cdr
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.repair import recover
from psd_deflection.records import ParameterChange, SampleBlock
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run import recorder as module
from psd_deflection.run.recorder import Recorder
from test.heard import WAIT_S
from test.recordings.making import block

MB = 1_000_000


class Disk:
    """What ``shutil.disk_usage`` says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free = 10_000 * MB
        self.grows = 0
        self.asked = threading.Semaphore(0)
        monkeypatch.setattr(shutil, 'disk_usage', self.usage)

    def usage(self, path: Path) -> Any:
        self.asked.release()
        return SimpleNamespace(total=100_000 * MB, used=0, free=self.free)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


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
    run.put(module.CHECK_EVERY)
    assert disk.asked.acquire(timeout=WAIT_S)
    disk.free = 150 * MB
    run.put(2 * module.CHECK_EVERY)
    text = run.heard()
    assert 'the disk has 150 MB left, less than disk_reserve = 200 MB; it is complete up to here' in text
    assert text.count('\n') == 0
    assert run.recorder.folder is None
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
    run.put(module.CHECK_EVERY)
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
        run.put(module.CHECK_EVERY)
    else:
        # It is told of no recording that is not there.
        assert run.recorder.close() is None
    assert 'was deleted or moved' in run.heard()
    assert [p.name for p in target.iterdir()] == ['metadata.yaml']
    assert (target / 'metadata.yaml').read_text() == 'theirs'
    assert open_recording(tmp_path / 'elsewhere').complete


def test_no_error_ends_a_recording_in_silence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise KeyError('no such type')

    run = Run(rig_for(tmp_path))
    run.put(3)
    monkeypatch.setattr('psd_deflection.recordings.write.bag_writer.BagWriter.write_encoded', fails)
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
    run.put(module.CHECK_EVERY - 1)
    disk.free = 150 * MB
    run.put(1)
    assert 'deleted, the disk has 150 MB left' in run.heard()
    assert run.stop() == run.folder
    assert run.recorder.files_deleted == 1
    assert mine.exists()
    assert run.indices() == list(range(50, module.CHECK_EVERY))
    with Reader(run.folder) as reader:
        assert reader.message_count == module.CHECK_EVERY - 50 + len(list(run.folder.glob('*.mcap')))


def test_with_nothing_to_delete_it_ends(tmp_path: Path, disk: Disk) -> None:
    run = Run(rig_for(tmp_path, disk_reserve=200 * MB, disk_full='delete_oldest'))
    disk.free = 150 * MB
    run.put(module.CHECK_EVERY)
    assert 'no older file of this recording' in run.heard()


def test_failing_disk_ends_recording_with_advice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(rig_for(tmp_path))

    def reject(fd: int) -> None:
        raise OSError(errno.EIO, 'Input/output error')

    monkeypatch.setattr(os, 'fsync', reject)
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

    limit = 2 * module.QUEUED_PER_BLOCK
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
    assert run.indices() == list(range(limit + 1))
    assert [c.block for c in recording.changes] == [7]


def test_flushed_messages_survive_a_missing_end(tmp_path: Path) -> None:
    """A chunk ends by itself where nothing more comes."""
    run = Run(rig_for(tmp_path))
    run.put(3)
    file = run.folder / f'{run.folder.name}_0.mcap'
    watch = threading.Event()
    found: list[SampleBlock] = []
    for _ in range(3000):
        (tmp_path / 'left.mcap').write_bytes(file.read_bytes())
        recording = open_recording(tmp_path / 'left.mcap')
        if recording.topics():
            found = list(recording.blocks())
            break
        watch.wait(0.02)
    assert [b.index for b in found] == [0, 1, 2]
    run.stop()


def test_a_recording_stays_in_its_folder(tmp_path: Path) -> None:
    run = Run(rig_for(tmp_path))
    assert run.folder.parent == tmp_path / 'bags'
    assert run.start(rig_for(tmp_path)) == run.folder
    run.stop()
