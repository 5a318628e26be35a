# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How a run ends, and its thread: parts that hang are not waited for long, losses and late requests are told."""

import errno
import io
import json
import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest
import yaml

from psd_deflection.base.errors import EXIT_STATUSES, RecordingError, SamplesDroppedError
from psd_deflection.base.log import texts
from psd_deflection.cli._display import Display, live_line
from psd_deflection.cli.main import main
from psd_deflection.devices.protocol.frames import SampleFrame
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.records import DeflectionEstimate, RawChunk, Record
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.run import processing as module
from psd_deflection.run import realtime, recorder
from psd_deflection.run import session as session_module
from psd_deflection.run.arrivals import Arrival, Ended, ItemQueue
from psd_deflection.run.diagnostics import HealthReporter
from psd_deflection.run.headless import run_headless, run_until_signal
from psd_deflection.run.monitor.start import start_views
from psd_deflection.run.processing import Processing
from psd_deflection.run.realtime import Signals, StopRequestedError
from psd_deflection.run.session import Session
from test.heard import WAIT_S, until

ALLOWED_S = 2.0
Sample = Callable[..., SampleFrame]
Capsys = pytest.CaptureFixture[str]


class Hanging:
    """A thread that never ends, and the time for which it was waited for."""

    ident = native_id = 1
    name = 'a part'

    def __init__(self) -> None:
        self.waited_s = 0.0

    def is_alive(self) -> bool:
        return True

    def join(self, timeout: float | None = None) -> None:
        assert timeout is not None
        self.waited_s += timeout


@pytest.mark.slow
@pytest.mark.parametrize(
    ('part', 'reported'),
    [
        ('acquisition', 'the source hangs; it is not waited for'),
        ('processing', 'the last block is not waited for'),
        ('recorder', 'the run ends before its bag is closed: 0 messages are not written.'),
    ],
)
def test_part_that_hangs_delays_end_by_two_seconds(
    device: Any, rig: Rig, tmp_path: Path, part: str, reported: str
) -> None:
    logged: list[str] = []
    rig = replace_values(rig, {'bag_dir': str(tmp_path), 'record': True, 'realtime': False, 'keep_zero': False})
    session = Session(rig, texts(logged.append))
    session.start()
    owner = cast(Any, getattr(session, part))
    hanging = Hanging()
    if part == 'recorder':
        [(take, thread)] = owner._writers.items()
        owner._writers[take] = hanging
    else:
        thread = owner._thread
        owner._thread = hanging
    session.close()
    assert 0.0 < hanging.waited_s <= ALLOWED_S
    assert any(reported in text for text in logged)
    # What was said to hang did not: it ends as it would have.
    thread.join(WAIT_S)
    assert not thread.is_alive()
    session.acquisition.source.close()


class Held:
    """A sink that takes nothing until it is let go."""

    def __init__(self) -> None:
        self.holds = threading.Event()
        self.go = threading.Event()

    def put(self, record: Record) -> None:
        self.holds.set()
        assert self.go.wait(WAIT_S)


def run_of(rig: Rig, folder: Path, message: list[str], **values: object) -> tuple[Session, Held]:
    given = {'bag_dir': str(folder), 'record': True, 'realtime': False, 'keep_zero': False, 'block_size': 20, **values}
    session, held = Session(replace_values(rig, cast(Any, given)), texts(message.append)), Held()
    session.processing.sinks.append(held)
    session.start()
    return session, held


def ended_with(session: Session) -> list[BaseException]:
    return [] if session.failed is None else [session.failed]


def test_samples_without_room_are_reported_and_counted(
    device: Any, rig: Rig, tmp_path: Path, sample: Sample, capsys: Capsys
) -> None:
    logged: list[str] = []
    session, held = run_of(rig, tmp_path, logged, queue_blocks=2)
    device.send_frames(*(sample(seq) for seq in range(20)))
    assert held.holds.wait(WAIT_S)
    device.send_frames(*(sample(seq) for seq in range(20, 400)))
    until(lambda: session.acquisition.counters.samples == 400)
    held.go.set()
    until(lambda: session.acquisition.queue.empty())
    device.send_frames(*(sample(seq) for seq in range(400, 440)))
    until(lambda: session.acquisition.counters.samples == 440 and session.acquisition.queue.empty())
    (line,) = (line for line in logged if 'dropped here' in line)
    so_far = r'this machine is too slow: \d+ samples dropped here so far \(2 blocks wait, queue_blocks\)'
    assert re.fullmatch(so_far, line)
    # About 340: a starved reader hands over parts of a block, or the last one when there is room again.
    dropped = session.acquisition.counters.queue_dropped
    assert 300 < dropped < 400
    values = {k: v for e in HealthReporter(session).report(0).entries for k, v in e.values}
    assert values['dropped by a full queue'] == str(dropped)
    assert not ended_with(session)
    folder = session.close()
    assert folder is not None
    (failed,) = ended_with(session)
    assert isinstance(failed, SamplesDroppedError)
    why = f'samples were read and not processed ({dropped} while it ran, 0 at the end): this machine is too slow'
    assert str(failed) == f'{dropped} {why}'
    assert failed.exit_status == 9
    assert 9 in EXIT_STATUSES
    recording = open_recording(folder)
    taken = sum(len(block.seq) for block in recording.blocks())
    assert taken + dropped == 440
    assert recording.dropped_here == (dropped, 0)
    custom = yaml.safe_load((folder / 'metadata.yaml').read_text())['rosbag2_bagfile_information']['custom_data']
    assert json.loads(custom['psd_deflection.dropped_here']) == {'samples': str(dropped), 'messages': '0'}
    assert main(['info', str(folder)]) == 0
    shown = capsys.readouterr().out
    assert f'{dropped} samples, 0 messages: the host that recorded was too slow' in shown
    assert f'{taken} present, ' in shown
    assert session.acquisition.counters.lost == 0


def test_a_disk_that_fills_gives_a_true_sentence_and_status(
    device: Any, rig: Rig, tmp_path: Path, sample: Sample, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    usage = shutil.disk_usage(tmp_path)
    full = usage._replace(free=0)
    monkeypatch.setattr(recorder, 'CHECK_EVERY', 20)
    monkeypatch.setattr(shutil, 'disk_usage', lambda _: full if sent else usage)
    sent: list[SampleFrame] = []
    display = Display()

    def feed(session: Session) -> bool:
        display.watch(session)
        if not sent:
            sent.extend(sample(seq) for seq in range(100))
            device.send_frames(*sent)
        return bool(session.recorder.failure)

    values = {'port': rig.acquisition.port, 'bag_dir': str(tmp_path), 'record': True, 'keep_zero': False}
    begin = partial(Session, load_rig(overrides={**values, 'realtime': False}), display.log)
    early = pytest.raises(RecordingError, match=r'ended early: .* the disk has 0 MB left')
    with early as ended, display.report_recorded():
        run_until_signal(begin, feed)
    assert ended.value.exit_status == 4
    (folder,) = tmp_path.glob('psd_*')
    assert f'recorded {folder}; it ended early\n  replay it:  ' in capsys.readouterr().err
    assert main(['replay', str(folder), '--compare']) == 0


@pytest.mark.slow
def test_samples_behind_part_that_hangs_are_counted(
    device: Any, rig: Rig, tmp_path: Path, sample: Sample, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(realtime, 'HELD_S', 0.0)
    logged: list[str] = []
    session, held = run_of(rig, tmp_path, logged)
    device.send_frames(*(sample(seq) for seq in range(20)))
    assert held.holds.wait(WAIT_S)
    device.send_frames(*(sample(seq) for seq in range(20, 100)))
    until(lambda: session.acquisition.counters.samples == 100)
    session.close()
    for lost in ('the last 80 samples were read and not processed', 'the last block is not waited for'):
        assert f'pipeline is held up in run.processing.give: {lost}' in logged
    assert not any('subscriber' in line or 'the disk' in line for line in logged)
    assert '80 samples were read and not processed (0 while it ran, 80 at the end)' in str(session.failed)
    (folder,) = tmp_path.glob('psd_*')
    assert open_recording(folder).dropped_here == (80, 0)
    held.go.set()
    session.processing.join(WAIT_S)
    assert not session.alive


def test_a_run_that_is_behind_gets_three_seconds(
    device: Any, rig: Rig, tmp_path: Path, sample: Sample, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, held = run_of(rig, tmp_path, [])
    device.send_frames(*(sample(seq) for seq in range(20)))
    assert held.holds.wait(WAIT_S)
    waited: list[float] = []
    with monkeypatch.context() as slow:
        slow.setattr(session_module, 'time', Mock(wraps=time, monotonic=lambda: sum(waited)))
        slow.setattr(session.processing, 'join', waited.append)
        slow.setattr(session.acquisition.queue, 'qsize', lambda: 1000 - len(waited))
        session.close()
    assert sum(waited) == pytest.approx(3.0, abs=0.6)
    held.go.set()
    session.processing.join(WAIT_S)


def test_a_run_that_lost_nothing_here_ends_well(device: Any, rig: Rig, tmp_path: Path, sample: Sample) -> None:
    session, held = run_of(rig, tmp_path, [])
    held.go.set()
    device.send_frames(*(sample(seq) for seq in range(100)))
    until(lambda: session.acquisition.counters.samples == 100)
    folder = session.close()
    assert session.failed is None
    assert folder is not None
    assert open_recording(folder).dropped_here == (0, 0)
    assert 'dropped_here' not in (folder / 'metadata.yaml').read_text()


def signal_once_greeted(device: Any, number: signal.Signals) -> None:
    """Send it to this process once somebody has asked the device who it is."""

    def end() -> None:
        device.greeted.wait(60.0)
        os.kill(os.getpid(), number)

    threading.Thread(target=end, daemon=True).start()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_waiting_for_a_silent_device(
    device: Any, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    device.answer = b''
    monkeypatch.setattr('psd_deflection.run.acquisition.SILENCE_S', 60.0)
    # Under nohup the tests themselves are started with SIGHUP ignored.
    before = signal.signal(number, signal.SIG_DFL)
    signal_once_greeted(device, number)
    try:
        assert run_headless({'port': str(device.link)}, Display().log, lambda session: None, start_views) == 0
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, before)


def test_a_signal_ends_the_waiting_for_one_that_is_away(device: Any, sample: Any) -> None:
    """The port is back and nothing answers: the daemon hears it out, and stops when it is told."""

    def look(session: Session) -> None:
        if session.acquisition.counters.samples < 20:
            device.send_frames(*[sample(s) for s in range(len(sent), len(sent) + 20)])
            sent.extend(range(20))
        elif not away:
            away.append(True)
            device.unplug()
        elif session.acquisition.away and not shown:
            shown.append(live_line(session, 0.0))
            device.answer = b''
            device.plug()
            signal_once_greeted(device, signal.SIGINT)

    sent, away, shown = list[int](), list[bool](), list[str]()
    values: dict[str, object] = {'port': str(device.link), 'keep_zero': False, 'realtime': False}
    assert run_headless(values, Display().log, look, start_views) == 0
    assert 'no samples: the device is away' in shown[0]


def test_what_runs_is_not_torn() -> None:
    signals = Signals()
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        assert signals.stop
        with pytest.raises(StopRequestedError):
            signals.interruptible(lambda: None)
    finally:
        signals.restore_handlers()


def test_a_hang_up_that_is_to_be_passed_over_is() -> None:
    """``nohup``."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        signals = Signals()
        os.kill(os.getpid(), signal.SIGHUP)
        assert not signals.stop
        signals.restore_handlers()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_display_survives_a_closed_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    display, gone = Display(), io.StringIO()
    monkeypatch.setattr(gone, 'write', Mock(side_effect=OSError(errno.EIO, 'Input/output error')))
    monkeypatch.setattr('sys.stderr', gone)
    display.log('unheard')
    heard = io.StringIO()
    monkeypatch.setattr('sys.stderr', heard)
    display.log('heard')
    assert heard.getvalue() == 'heard\n'


MS = 1_000_000
COUNTS = np.tile(np.array([0, 0, 16384, 0, 0, 16384], np.int16), (20, 1))


def chunk(index: int, read_ns: int) -> Arrival:
    seq = np.arange(20 * index, 20 * index + 20)
    return Arrival(RawChunk(seq, seq * MS, COUNTS, np.zeros(20, np.uint8), 10.0 / 32768), read_ns)


@pytest.fixture
def items() -> ItemQueue:
    return ItemQueue()


class HeldRequest:
    """A request that the pipeline's thread is in the middle of until ``go_on`` is set."""

    def __init__(self) -> None:
        self.begun, self.go_on = threading.Event(), threading.Event()

    def __call__(self) -> str:
        self.begun.set()
        assert self.go_on.wait(WAIT_S)
        return 'done'


def test_a_request_that_was_given_up_is_never_carried_out(items: ItemQueue, monkeypatch: pytest.MonkeyPatch) -> None:
    processing, held, done = Processing(items, Pipeline(load_rig()), texts(print)), HeldRequest(), list[str]()
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
    processing, held = Processing(items, Pipeline(load_rig()), texts(print)), HeldRequest()

    def impatient(asked: Collection[Future[Any]], timeout: float) -> Any:
        assert timeout == 2.0
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
    reject = Mock(side_effect=TimeoutError('its own'))
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
