# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The watch in a run: what it says, and the recording that it keeps."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_adapters import LOAD, to_messages
from psd_deflection.base.log import null_log, texts
from psd_deflection.devices.protocol.frames import SampleFrame
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings import cdr
from psd_deflection.recordings.observation import read_observation
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed_estimates, rig_at_start
from psd_deflection.records import AppliedLoad, DeflectionEstimate, FloatArray, RawChunk, SampleBlock
from psd_deflection.rig.config import load_rig
from psd_deflection.run import watcher as module
from psd_deflection.run.diagnostics import OK, WARN, HealthReporter
from psd_deflection.run.fanout import Fanout
from psd_deflection.run.session import Session
from psd_deflection.run.watcher import Watcher, WatcherSink
from test.heard import WAIT_S, until
from test.run.conftest import Estimates, ScriptedDevice

pytestmark = pytest.mark.slow
START_NS = 1_700_000_000_000_000_000


class Chain:
    """A pipeline, a fan-out and a watcher, as a session has them."""

    def __init__(self, folder: Path | None, **values: Any) -> None:
        folders = {} if folder is None else {'watch_dir': str(folder)}
        rig = load_rig(overrides={'watch': 'on', 'solvers': ['exact'], **folders, **values})
        self.logged: list[str] = []
        self.poses: dict[int, tuple[float, float, float]] = {}
        self.pipeline = Pipeline(rig)
        self.watcher = Watcher(self.pipeline, texts(self.logged.append), {'serial': 'abc'}, '/arm/psd_estimator')
        self.fanout = Fanout()
        if self.watcher.keeps:
            self.fanout.sinks.append(WatcherSink(self.watcher))
        self._rig = RigSimulator(rig, 3)
        self._seq = 0
        self._volts = rig.converter.volts_per_count

    def load(self, fx: float, fy: float, tz: float) -> None:
        load = AppliedLoad(START_NS + self._seq * 1_000_000, fx, fy, tz)
        (message,) = to_messages(load)
        self.watcher.put_message(LOAD, message.type, cdr.encode(message.type, message.fields), load.t_ns)
        self.watcher.put(load)

    def feed(self, seconds: float, moved: tuple[float, ...] = (0.0,) * 6) -> None:
        """Samples of the unloaded rig, with ``moved`` (6,) V besides."""
        counts = self._rig.step(np.zeros((round(1000 * seconds), 3))).counts + np.rint(
            np.array(moved) / self._volts
        ).astype(np.int32)
        for start in range(0, len(counts), 200):
            seq = np.arange(self._seq, self._seq + 200, dtype=np.int64)
            self._seq += 200
            chunk = RawChunk(
                seq, START_NS + seq * 1_000_000, counts[start : start + 200], np.zeros(200, np.uint8), self._volts
            )
            for record in self.pipeline.process(chunk):
                if isinstance(record, DeflectionEstimate):
                    self.poses[record.t_ns] = record.pose
                elif isinstance(record, SampleBlock):
                    self._samples = record
                self.fanout.put(record)
                self.watcher.put(record)

    def block(self, t_ns: int) -> None:
        """The last samples again, as those of this time."""
        self.watcher.put(replace(self._samples, t_ns=np.array([t_ns])))

    def bump(self) -> None:
        """Eight seconds under no load, then six after x1 has moved."""
        self.load(0.0, 0.0, 0.0)
        self.feed(8.0)
        self.feed(6.0, BUMP)


BUMP = (0.01, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_an_alarm_is_handed_on(tmp_path: Path) -> None:
    output = tmp_path / 'alarms'
    chain = Chain(None, watch_command=f'sh -c "cat >> {output}"')
    chain.feed(1.0)
    chain.load(0.0, 0.0, 0.0)
    chain.feed(10.0)
    chain.feed(10.0, BUMP)
    assert chain.watcher.close(WAIT_S) == ''
    reported = json.loads(output.read_text())
    assert (reported['channel'], reported['device'], reported['node']) == ('x1', 'abc', '/arm/psd_estimator')
    values = dict(chain.watcher.entry().values)
    assert (values['alarms handed on'], values['alarms not handed on']) == ('1', '0')


def volts_of(folder: Path) -> FloatArray:
    return read_observation(folder).volts


def test_the_minutes_around_an_alarm_are_kept_ready_for_discover(tmp_path: Path) -> None:
    chain = Chain(tmp_path)
    chain.feed(1.0)
    chain.load(0.0, 0.0, 0.0)
    chain.feed(10.0)
    assert chain.watcher.entry().level == OK
    assert not list(tmp_path.iterdir())
    chain.feed(10.0, BUMP)
    assert chain.watcher.watch.alarm is not None
    for after in (59, 61):
        assert (chain.watcher.folder, not list(tmp_path.iterdir())) == (None, True)
        chain.block(chain.watcher.watch.alarm.observed_ns + after * 1_000_000_000)
    until(lambda: chain.watcher.folder is not None)
    assert chain.watcher.close(60.0) == ''
    (folder,) = tmp_path.iterdir()
    assert folder == chain.watcher.folder
    entry = chain.watcher.entry()
    assert entry.level == WARN
    values = dict(entry.values)
    assert values['channel'] == 'x1'
    assert float(values['shift (um)']) == pytest.approx(5.0, abs=0.3)
    assert values['kept'] == str(folder)
    assert chain.logged[0].startswith('watch: since 2023-11-1')
    assert str(folder) in chain.logged[1]
    observation = read_observation(folder)
    # From the first whole block on.
    assert 20.9 < observation.duration <= 21.0
    assert np.ptp(observation.loads) == 0.0
    assert float(np.nanmean(volts_of(folder)[-1000:, 0]) - np.nanmean(volts_of(folder)[:1000, 0])) == pytest.approx(
        0.01, abs=5e-4
    )
    recording = open_recording(folder)
    assert recording.hello == {'serial': 'abc'}
    again = replayed_estimates(recording, rig_at_start(recording))
    assert len(again.t_ns) > 800
    assert [chain.poses[t] for t in again.t_ns.tolist()] == [tuple(p) for p in again.pose.tolist()]


def test_what_is_still_to_be_kept_is_kept_at_the_end(tmp_path: Path) -> None:
    chain = Chain(tmp_path / 'deep' / 'below')
    chain.feed(0.2)
    chain.bump()
    assert (chain.watcher.watch.alarms, chain.watcher.close(60.0)) == (1, '')
    assert chain.watcher.folder is not None
    assert 13.0 < read_observation(chain.watcher.folder).duration < 15.0


def test_nothing_is_written_unasked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    chain = Chain(None)
    chain.bump()
    assert (chain.watcher.watch.alarms, chain.watcher.close(1.0)) == (1, '')
    assert chain.watcher.folder is None
    assert not list(tmp_path.iterdir())
    assert len(chain.logged) == 1


def test_a_disk_without_room_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage
    monkeypatch.setattr(shutil, 'disk_usage', lambda path: usage(path)._replace(free=1_000_000))
    chain = Chain(tmp_path)
    chain.bump()
    assert chain.watcher.close(60.0) == ''
    assert not list(tmp_path.iterdir())
    assert 'disk_reserve' in chain.logged[-1]
    assert 'disk_reserve' in chain.watcher.failure


def a_load(t_ns: int) -> tuple[str, str, bytes, int]:
    (message,) = to_messages(AppliedLoad(t_ns, 0.0, -1.0, 0.0))
    return LOAD, message.type, cdr.encode(message.type, message.fields), t_ns


def test_input_flood_without_device_is_bounded(tmp_path: Path) -> None:
    chain = Chain(tmp_path, watch_memory=1_000_000)
    chain.feed(1.0)
    topic, kind, message, _ = a_load(START_NS)
    most = 0
    # A minute of the clock of the inputs, no block in it.
    for n in range(600_000):
        chain.watcher.put_message(topic, kind, message, START_NS + 1_000_000_000 + n * 100_000)
        if n % 1000 == 0:
            most = max(most, chain.watcher.held_bytes)
    assert 0 < most <= 1_000_000
    assert [line for line in chain.logged if 'watch_memory' in line] == [
        'watch: 1 MB are full (watch_memory): what is kept begins later than watch_minutes says'
    ]
    assert int(dict(chain.watcher.entry().values)['dropped from memory, because it was full']) > 0


def test_of_a_full_memory_the_oldest_30_s_are_dropped(tmp_path: Path) -> None:
    chain = Chain(tmp_path, watch_memory=1_000_000)
    chain.feed(0.2)
    topic, kind, message, _ = a_load(START_NS)
    held = []
    for second in range(1, 200):
        t_ns = START_NS + second * 1_000_000_000
        chain.block(t_ns)
        chain.watcher.put_message(topic, kind, message.ljust(10_000), t_ns)
        held.append(chain.watcher.held_bytes)
    size, *_ = steps = np.diff(held)
    # Without what was fed before the first of them.
    assert steps[steps < 0][1:].tolist() == [-29 * size] * 3


def test_nothing_is_held_of_a_device_that_has_been_away_for_long(tmp_path: Path) -> None:
    chain = Chain(tmp_path, watch_minutes=0.5)
    chain.feed(1.0)
    for n in range(90):
        chain.watcher.put_message(*a_load(START_NS + n * 1_000_000_000))
    assert chain.watcher.held_bytes > 0
    chain.watcher.put_message(*a_load(START_NS + 100_000_000_000))
    assert chain.watcher.held_bytes == 0
    assert not chain.logged


def test_run_kept_of_full_memory_replays_as_computed(tmp_path: Path) -> None:
    chain = Chain(tmp_path, watch_memory=1_000_000)
    chain.feed(1.0)
    chain.load(0.0, 0.0, 0.0)
    chain.feed(14.0)
    for n in range(10_000):
        chain.watcher.put_message(*a_load(START_NS + 15_000_000_000 + n))
    assert any('watch_memory' in line for line in chain.logged)
    chain.feed(3.0)
    chain.feed(6.0, BUMP)
    assert (chain.watcher.watch.alarms, chain.watcher.close(60.0)) == (1, '')
    assert chain.watcher.folder is not None
    assert chain.watcher.held_bytes == 0
    recording = open_recording(chain.watcher.folder)
    again = replayed_estimates(recording, rig_at_start(recording))
    assert len(again.t_ns) > 300
    assert [chain.poses[t] for t in again.t_ns.tolist()] == [tuple(p) for p in again.pose.tolist()]


def keep(folder: Path, name: str, age: int, *extra: str) -> Path:
    """A recording of the watch of 1000 bytes, made ``age`` seconds ago."""
    made = folder / name
    made.mkdir(parents=True)
    for file in (f'{name}_0.mcap', *extra):
        (made / file).write_bytes(bytes(1000))
    os.utime(made, ns=(START_NS - age * 10**9,) * 2)
    return made


def an_alarm(chain: Chain) -> Path:
    chain.bump()
    assert chain.watcher.close(60.0) == ''
    assert chain.watcher.folder is not None
    return chain.watcher.folder


def test_the_oldest_of_what_was_kept_is_deleted_and_nothing_else(tmp_path: Path) -> None:
    older = [keep(tmp_path, f'watch_2023_{n}', 100 - n) for n in range(5)]
    recorded = keep(tmp_path, 'psd_20230101_000000', 1000)
    annotated = keep(tmp_path, 'watch_2022', 2000, 'what I saw.txt')
    elsewhere = keep(tmp_path / 'deep', 'watch_2021', 3000)
    (tmp_path / 'watch_2020').symlink_to(elsewhere)
    chain = Chain(tmp_path, watch_dir_max_recordings=3)
    chain.feed(0.2)
    folder = an_alarm(chain)
    assert [path.exists() for path in older] == [False, False, False, True, True]
    assert all(path.exists() for path in (folder, recorded, annotated, elsewhere / 'watch_2021_0.mcap'))
    reported = [line for line in chain.logged if 'deleted' in line]
    assert len(reported) == 3
    assert reported[0].startswith(f'watch: {older[0]}: deleted, the oldest')


def test_what_was_kept_is_bounded_in_bytes(tmp_path: Path) -> None:
    big = keep(tmp_path, 'watch_big', 5)
    (big / 'watch_big_0.mcap').write_bytes(bytes(2_000_000))
    os.utime(big, ns=(START_NS,) * 2)
    chain = Chain(tmp_path, watch_dir_max_bytes=1_500_000)
    chain.feed(0.2)
    folder = an_alarm(chain)
    assert not big.exists()
    assert folder.exists()


def test_a_session_feeds_its_watch_and_reports_it(device: ScriptedDevice, sample: Callable[..., SampleFrame]) -> None:
    rig = load_rig(overrides={'port': str(device.link), 'keep_zero': False, 'realtime': False, 'watch': 'on'})
    session = Session(rig, null_log)
    try:
        estimates = Estimates(5)
        session.processing.sinks.append(estimates)
        session.start()
        device.send_frames(*(sample(seq) for seq in range(200)))
        assert estimates.enough.wait(WAIT_S)
        session.note_load(0.0, -3.0, 0.0)
        assert session.watcher is not None
        watch = session.watcher.watch
        held = session.processing.request(lambda: watch.load)
        assert held is not None
        assert held.fy == -3.0
        (entry,) = (e for e in HealthReporter(session).report(0).entries if e.name == module.NAME)
        assert dict(entry.values)['watched'] == 'no window yet'
    finally:
        session.close()


@pytest.mark.parametrize(('given', 'value'), [(True, 'on'), ('off', 'off'), (False, 'off')])
def test_the_watch_is_switched_by_one_parameter(given: object, value: str) -> None:
    assert load_rig(overrides={'watch': given}).acquisition.watch == value
