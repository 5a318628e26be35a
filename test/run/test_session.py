# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is asked of a session while its device is there, away, or silent; the kept zero, taken back or passed over."""

import json
import queue
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from msg_adapters import LOAD, MARK, REFERENCE, to_messages
from psd_deflection.base.bounds import RateLimit
from psd_deflection.base.log import ERROR, INFO, WARNING, texts
from psd_deflection.devices.protocol.frames import SampleFrame
from psd_deflection.recordings import cdr
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.records import AppliedLoad, Mark, Record, ReferencePose
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.run import processing
from psd_deflection.run import session as module
from psd_deflection.run.diagnostics import OK, STALE, WARN, HealthReporter
from psd_deflection.run.monitor.metrics import text_of
from psd_deflection.run.monitor.shown import RejectedError, ShownSession
from psd_deflection.run.rate_limited_log import RateLimitedLog
from psd_deflection.run.session import Session
from psd_deflection.run.state import ZeroStore
from test.heard import WAIT_S
from test.run.conftest import Estimates, ScriptedDevice

Sample = Callable[..., SampleFrame]


class Running:
    """A session on ``device``, past its first estimates."""

    def __init__(self, device: ScriptedDevice, sample: Sample, folder: Path) -> None:
        self.logged: queue.SimpleQueue[str] = queue.SimpleQueue()
        values = {'port': str(device.link), 'keep_zero': False, 'link.length': 0.5, 'bag_dir': str(folder)}
        self.session = Session(load_rig(overrides=values), texts(self.logged.put))
        estimates = Estimates(5)
        self.session.processing.sinks.append(estimates)
        self.session.start()
        device.send_frames(*(sample(seq) for seq in range(200)))
        assert estimates.enough.wait(WAIT_S)

    def heard(self, text: str) -> None:
        """Wait for a line with ``text``; each has at most 160 characters, without its paths."""
        line = ''
        while text not in line:
            line = self.logged.get(timeout=WAIT_S)
            assert len(re.sub(r'/\S+', '', line)) <= 160, line


@pytest.fixture
def running(
    device: ScriptedDevice, sample: Sample, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Running]:
    # However busy the machine is: only what a test does makes a device silent or a request late.
    monkeypatch.setattr(module, 'SILENT_S', 1e3)
    monkeypatch.setattr(processing, 'REQUEST_TIMEOUT_S', WAIT_S)
    run = Running(device, sample, tmp_path / 'recordings')
    yield run
    run.session.close()


def observed_session(running: Running) -> tuple[Session, Estimates]:
    """Its session, and what comes to it as an input."""
    observed = Estimates()
    running.session.input_sinks.append(observed)
    return running.session, observed


def test_no_zero_is_taken_of_a_device_that_is_away(running: Running, device: ScriptedDevice) -> None:
    assert running.session.zero() is not None
    device.unplug()
    running.heard('waiting for it to come back')
    with pytest.raises(TimeoutError, match='no data flows'):
        running.session.zero()


def test_a_zero_that_was_taken_under_a_load_is_reported(running: Running) -> None:
    session = running.session
    session.note_load(0.0, -10.0, 0.0)
    assert session.zero() is not None
    running.heard('the zero was taken under a load (load noted: Fx 0 N, Fy -10 N, Tz 0 N·m): take the zero again')
    # A minute ago it had hung as well: before the zero. Without a load there is nothing to tell.
    session.load = None
    session.note_load(0.0, -20.0, 0.0, ago_s=60.0)
    running.heard('the load acted already when the zero was taken, ')
    session.note_load(0.0, 0.0, 0.0)
    assert session.zero() is not None
    session.note_load(0.0, -30.0, 0.0)
    # It came after the click on a zero that was long under way.
    session.load = AppliedLoad(session.acquisition.now_ns() + 10**12, 0.0, -30.0, 0.0)
    assert session.zero() is not None
    session.reject_input(LOAD, 'the end')
    reported = []
    while 'rejected: the end' not in (text := running.logged.get(timeout=WAIT_S)):
        reported.append(text)
    assert not [text for text in reported if 'zero again' in text]


def test_metrics_count_what_came_was_lost_and_was_rejected(running: Running) -> None:
    running.session.reject_input(LOAD, 'a number is not finite')
    running.session.processing.request(lambda: None)
    families = text_string_to_metric_families(text_of(ShownSession(running.session).metrics()))
    metrics = {(s.name, *s.labels.values()): s.value for family in families for s in family.samples}
    assert metrics[('psd_deflection_samples_total',)] == running.session.acquisition.counters.samples > 0
    assert metrics[('psd_deflection_estimates_total',)] >= 5.0
    assert metrics[('psd_deflection_messages_rejected_total', LOAD)] == 1.0
    assert metrics[('psd_deflection_recording',)] == 0.0
    assert not any('celsius' in key[0] or 'watch' in key[0] for key in metrics)


def test_diagnostics_report_no_dots_while_the_device_is_away(running: Running, device: ScriptedDevice) -> None:
    def description_of_dots() -> list[tuple[int, str]]:
        report = health.report(time.time_ns())
        return [(e.level, e.message) for e in report.entries if e.name.startswith('psd_deflection: psd_')]

    health = HealthReporter(running.session)
    assert STALE not in dict(description_of_dots())
    device.unplug()
    running.heard('waiting for it to come back')
    description_of_dots()
    assert description_of_dots() == [(STALE, 'no samples')] * 2


def test_a_step_of_the_system_clock_moves_no_stamp(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    acquisition, real = running.session.acquisition, time.time_ns
    before = acquisition.now_ns()
    monkeypatch.setattr(time, 'time_ns', lambda: real() - 3600 * 10**9)
    assert before <= acquisition.now_ns() < before + 600 * 10**9
    assert acquisition.system_clock_step_ns() == pytest.approx(-3600e9, abs=1e9)


def test_stamps_late_by_more_than_5_ms_are_a_warning(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    state = running.session.acquisition.clock_state()._replace(residual_ns=0.0)
    for late_ns, level in ((4_900_000, OK), (5_100_000, WARN)):
        clock = state._replace(round_trip_ns=late_ns)
        monkeypatch.setattr(running.session.acquisition, 'clock_state', lambda clock=clock: clock)
        entries = {e.name: e.level for e in HealthReporter(running.session).report(0).entries}
        assert entries['psd_deflection: clock'] == level


def test_zero_of_long_silent_device_is_rejected(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, 'SILENT_S', -1e3)
    with pytest.raises(TimeoutError, match='no data flows'):
        running.session.zero()


def test_annotated_load_holds_for_the_next_recording(running: Running, device: ScriptedDevice, sample: Sample) -> None:
    session, observed = observed_session(running)
    first = session.note_load(0.0, -10.0, 0.5)
    running.heard('load noted: Fx 0 N, Fy -10 N, Tz 0.5 N·m')
    before = session.acquisition.now_ns()
    folder = session.record(True).result(WAIT_S)
    assert folder is not None
    more = session.note_load(1.0, -10.0, 0.0, add=True)
    device.send_frames(*(sample(seq) for seq in range(200, 300)))
    assert session.record(False).result(WAIT_S) == folder
    loads = open_recording(folder).loads()
    # What hung there when the recording began is in it, before its first sample.
    assert [load[1:] for load in loads] == [(0.0, -10.0, 0.5), (1.0, -20.0, 0.5)]
    assert first.t_ns < before <= loads[0].t_ns <= loads[1].t_ns
    assert loads[1] == more == session.load
    assert [r for r in observed.records if isinstance(r, AppliedLoad)] == [first, *loads]


def test_past_load_is_stamped_with_its_own_time(running: Running, device: ScriptedDevice, sample: Sample) -> None:
    session = running.session
    folder = session.record(True).result(WAIT_S)
    assert folder is not None
    asked_ns = session.acquisition.now_ns()
    first = session.note_load(0.0, -10.0, 0.0, ago_s=5.0)
    running.heard('Fy -10 N, Tz 0 N·m, since 5.00 s ago')
    assert 0 <= first.t_ns - (asked_ns - 5_000_000_000) < session.acquisition.now_ns() - asked_ns + 1
    words = r'the present load began 5\.\d\d s ago, so this one cannot have begun 9\.00 s'
    with pytest.raises(ValueError, match=words):
        session.note_load(0.0, -20.0, 0.0, ago_s=9.0)
    assert session.load == first
    # From the page, as far as the daemon knows when the dots moved.
    shown = ShownSession(session)
    assert shown.step() == ''
    with pytest.raises(RejectedError, match='not noted: the dots have not stepped in the last 60 s'):
        shown.load(0.0, -20.0, 0.0, False, None, 0.0)
    with pytest.raises(RejectedError, match='not noted: the present load began'):
        shown.load(0.0, -20.0, 0.0, False, 9.0, 0.0)
    device.send_frames(*(sample(seq) for seq in range(200, 300)))
    assert session.record(False).result(WAIT_S) == folder
    recording = open_recording(folder)
    assert recording.loads() == [first]
    (message,) = recording.messages([LOAD])
    assert message.log_time >= asked_ns


def test_a_request_that_came_late_is_of_the_time_it_was_made(running: Running) -> None:
    session, observed = observed_session(running)
    shown = ShownSession(session)
    before = session.acquisition.now_ns()
    shown.mark('bumped it', 8.0)
    shown.load(0.0, -10.0, 0.0, False, 0.0, 6.0)
    # Made before the load above and heard after it: it comes after it all the same.
    shown.load(0.0, 0.0, 0.0, False, 0.0, 7.0)
    passed = session.acquisition.now_ns() - before
    mark, load, later = observed.records
    assert isinstance(mark, Mark)
    assert isinstance(load, AppliedLoad)
    assert isinstance(later, AppliedLoad)
    assert 0 <= mark.t_ns - (before - 8_000_000_000) <= passed
    assert 0 <= load.t_ns - (before - 6_000_000_000) <= passed
    assert later.t_ns == load.t_ns + 1


def test_a_mark_is_recorded_when_it_arrives(running: Running, device: ScriptedDevice, sample: Sample) -> None:
    session, observed = observed_session(running)
    folder = session.record(True).result(WAIT_S)
    assert folder is not None
    device.send_frames(*(sample(seq) for seq in range(200, 300)))
    first = session.note_mark(' bumped it ')
    running.heard('mark: bumped it')
    (message,) = to_messages(Mark(0, 'at rest'))
    last = session.take_input(MARK, cdr.encode(message.type, message.fields))
    assert session.record(False).result(WAIT_S) == folder
    assert [mark.text for mark in open_recording(folder).marks()] == ['bumped it', 'at rest']
    assert open_recording(folder).marks() == [first, last] == observed.records


def test_invalid_or_frequent_mark_is_rejected(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    session, observed = observed_session(running)
    for text in ('', 'x' * 201, 'a\x1b[31m', '\ud800'):
        with pytest.raises(ValueError, match='a mark'):
            session.note_mark(text)
    assert session.take_input(MARK, b'too short') is None
    running.heard('rejected')
    session.note_mark('good')
    monkeypatch.setattr(session, '_mark_rate', RateLimit(0))
    with pytest.raises(ValueError, match='more than 10 marks a second'):
        session.note_mark('one more')
    session.processing.request(lambda: None)
    assert session.rejected[MARK] >= 6
    assert [mark.text for mark in observed.records if isinstance(mark, Mark)] == ['good']


def test_an_input_that_is_no_number_is_recorded_and_not_shown(running: Running) -> None:
    session, observed = observed_session(running)

    def give(pose: ReferencePose) -> Record | None:
        (message,) = to_messages(pose)
        return session.take_input(REFERENCE, cdr.encode(message.type, message.fields))

    good = ReferencePose(1_700_000_000_000_000_000, 1e-3, -2e-3, 0.0)
    assert give(good) == good
    assert give(good._replace(dx=float('nan'))) is None
    assert session.take_input(REFERENCE, b'too short') is None
    # A publisher that sends no stamp means now.
    now = give(good._replace(t_ns=0))
    assert isinstance(now, ReferencePose)
    assert now.t_ns > good.t_ns
    assert observed.records == [good, now]
    session.processing.request(lambda: None)
    assert session.rejected == {REFERENCE: 2}
    entry = HealthReporter(session).report(0).entries[0]
    assert dict(entry.values)[f'messages rejected: {REFERENCE}'] == '2'
    assert entry.level == WARN
    assert entry.message.startswith(f'{REFERENCE}: rejected: ')


def test_rejected_count_is_reported_after_last_message(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """The health is asked once a second, whatever the run publishes."""
    times: queue.SimpleQueue[float] = queue.SimpleQueue()
    monkeypatch.setattr(RateLimitedLog, 'settle', lambda _, now_s: times.put(now_s))
    HealthReporter(running.session).report(1)
    assert times.get(timeout=WAIT_S) <= time.monotonic()


ZERO = {'psd_1.zero': [1e-4, -2e-4], 'psd_2.zero': [3e-5, 0.0]}


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    monkeypatch.setenv('XDG_STATE_HOME', str(tmp_path / 'state'))
    return load_rig()


def test_kept_zero_applies_only_to_the_same_device(rig: Rig) -> None:
    assert ZeroStore(rig, 'A-1').save(replace_values(rig, ZERO)) == ''
    back, message, _ = ZeroStore(rig, 'A-1').load(rig)
    assert 'zero of the last run' in message
    assert {name: back.values[name] for name in ZERO} == ZERO
    assert back.psds[0].zero == (1e-4, -2e-4)
    assert ZeroStore(rig, 'B-2').load(rig) == (rig, '', INFO)


@pytest.mark.parametrize(
    ('first', 'other'), [('Rig \u00c4', 'Rig \u00d6'), ('a' * 64 + 'x', 'a' * 64 + 'y'), ('', 'unknown'), ('A', 'A.')]
)
def test_two_serial_numbers_never_share_a_zero(rig: Rig, first: str, other: str) -> None:
    assert ZeroStore(rig, first).save(replace_values(rig, ZERO)) == ''
    assert ZeroStore(rig, other).load(rig) == (rig, '', INFO)
    assert ZeroStore(rig, first).load(rig)[0].values['psd_1.zero'] == ZERO['psd_1.zero']


@pytest.mark.parametrize(
    ('changed', 'serial', 'words'),
    [({}, 'B', 'that of another device'), ({'psd_1.zero': [5e-4, 0.0]}, 'A', 'the rig file holds')],
)
def test_zero_of_another_device_or_rig_file_is_passed_over(
    tmp_path: Path, changed: dict[str, object], serial: str, words: str
) -> None:
    named = {'zero_file': str(tmp_path / 'zero.json')}
    rig = load_rig(overrides=named)
    assert ZeroStore(rig, 'A').save(replace_values(rig, ZERO)) == ''
    now = load_rig(overrides={**named, **changed})
    back, message, level = ZeroStore(now, serial).load(now)
    assert (back is now, words in message, level) == (True, True, WARNING)


@pytest.mark.parametrize('serial', ['../../evil', '/etc/passwd', '..', '', None, 'a' * 500, 'x\x00y', 7])
def test_no_serial_number_leads_out_of_the_folder(rig: Rig, tmp_path: Path, serial: object) -> None:
    store = ZeroStore(rig, serial)
    assert store.path.parent == tmp_path / 'state' / 'psd_deflection'
    assert len(store.path.name) < 100
    assert store.save(rig) == ''
    assert store.path.resolve().is_relative_to(tmp_path / 'state')


def passed_over(store: ZeroStore, rig: Rig, why: str) -> None:
    back, message, _ = store.load(rig)
    assert back is rig
    assert f'{store.path}: the kept zero cannot be used (' in message
    assert why in message
    assert message.endswith('; the rig file holds')


@pytest.mark.parametrize(
    ('content', 'why'),
    [
        (b'', 'Expecting value'),
        (b'[]', 'not what ~/zero writes'),
        (b'{"psd_1.zero": [0, 0], "psd_2.zero": [0, 0]}', 'not what ~/zero writes'),
        (b'\xff\xfe', 'Expecting value'),
        (b'[' * 5000, ''),
        (b' ' * 20_000, 'more than 10000 bytes'),
    ],
)
def test_a_bad_file_never_stops_a_run(rig: Rig, content: bytes, why: str) -> None:
    store = ZeroStore(rig, 'A')
    store.path.parent.mkdir(parents=True)
    store.path.write_bytes(content)
    passed_over(store, rig, why)


@pytest.mark.parametrize('zero', [[9, 9], 'x', [float('nan'), 0], [0], None, {}, [0, 0, 0], [True, 0]])
def test_a_kept_zero_is_checked_like_any_parameter(rig: Rig, zero: object) -> None:
    store = ZeroStore(rig, 'A')
    assert store.save(replace_values(rig, ZERO)) == ''
    stored = json.loads(store.path.read_text())
    assert store.load(rig)[0] is not rig
    store.path.write_text(json.dumps({**stored, 'psd_1.zero': zero}))
    passed_over(store, rig, 'psd_1.zero')


def test_a_kept_zero_names_its_device_or_is_reported(tmp_path: Path) -> None:
    named = load_rig(overrides={'zero_file': str(tmp_path / 'zero.json')})
    assert ZeroStore(named, 'A').save(named) == ''
    assert json.loads((tmp_path / 'zero.json').read_text())['serial'] == 'A'
    rig = load_rig(overrides={'zero_file': str(tmp_path / 'zero.json' / 'zero.json')})
    store = ZeroStore(rig, 'A')
    log = Mock()
    store.keep(rig, log)
    assert store.join(WAIT_S)
    log.assert_called_once_with(store.save(rig), ERROR)
    assert 'cannot be kept' in store.save(rig)
