# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reader against a device whose every byte the test writes; pings, when they are due and whose answer counts."""

import itertools
import queue
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from psd_deflection.base.errors import DeviceError
from psd_deflection.base.log import INFO, WARNING, null_log
from psd_deflection.devices import contract_frames, port_source
from psd_deflection.devices.ports import SerialPort
from psd_deflection.devices.protocol.frames import HelloFrame, PongFrame, SampleFrame, encode
from psd_deflection.devices.source import Clock, Event, PortClosedError, Received, Sample, Source, SourceEndedError
from psd_deflection.records import CLOCK_SQUEEZED, CLOCK_STEP, RESTART
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run import acquisition as module
from psd_deflection.run.acquisition import Acquisition
from psd_deflection.run.arrivals import Annotation, Arrival, Ended, Item, Restarted
from psd_deflection.run.hello import PING_S, UNANSWERED, Pinger
from test.heard import WAIT_S
from test.run.conftest import HELLO

pytestmark = pytest.mark.slow
SILENCE_S = module.SILENCE_S


def take(acquisition: Acquisition, n: int) -> list[Item]:
    """The next items until ``n`` samples have come."""
    items: list[Item] = []
    while sum(len(i.raw.seq) for i in items if isinstance(i, Arrival)) < n:
        items.append(acquisition.queue.get(timeout=WAIT_S))
    return items


def numbers(items: list[Item]) -> list[int]:
    return [int(s) for i in items if isinstance(i, Arrival) for s in i.raw.seq]


class Run:
    def __init__(self, rig: Rig) -> None:
        self.logged: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()
        self.acquisition = Acquisition(rig, lambda text, level=INFO: self.logged.put((text, level)))
        self.acquisition.open()
        self.acquisition.start()

    def heard(self, text: str) -> str:
        """Wait for a message that holds ``text``; ``level`` is its severity then."""
        message = ''
        while text not in message:
            message, self.level = self.logged.get(timeout=WAIT_S)
        return message


@pytest.fixture
def run(device: Any, rig: Rig) -> Iterator[Run]:
    started = Run(rig)
    yield started
    started.acquisition.stop()


def test_samples_come_as_blocks_with_their_own_times(device: Any, run: Run, sample: Any) -> None:
    device.send_frames(*[sample(s) for s in range(40)])
    items = take(run.acquisition, 40)
    assert numbers(items) == list(range(40))
    chunks = [i.raw for i in items if isinstance(i, Arrival)]
    assert {int(s) // 20 for s in chunks[0].seq} == {0}
    t = [int(t) for c in chunks for t in c.t_ns]
    assert all(abs(b - a - 1_000_000) < 3000 for a, b in itertools.pairwise(t))
    assert run.acquisition.hello is not None
    assert run.acquisition.hello.info['serial'] == 'T-1'


def test_joining_within_a_block_starts_with_the_next_block(device: Any, run: Run, sample: Any) -> None:
    device.send_frames(*[sample(s) for s in range(33, 60)])
    assert (numbers(take(run.acquisition, 20)), run.acquisition.counters.lost) == (list(range(40, 60)), 0)


def test_garbage_gaps_repeats_and_flags_are_counted(device: Any, run: Run, sample: Any) -> None:
    device.send_frames(*[sample(s) for s in range(5)])
    device.send(b'\x00garbage\x00\x05rubbish\x00')
    device.send_frames(sample(5), sample(5), sample(4), sample(9, flags=2), *[sample(s) for s in range(10, 20)])
    assert numbers(take(run.acquisition, 17)) == [0, 1, 2, 3, 4, 5, *range(9, 20)]
    counters = run.acquisition.counters
    assert (counters.lost, counters.repeated, counters.device_dropped, counters.bad) == (3, 2, 1, 2)


def test_a_device_restart_continues_with_a_new_block(device: Any, run: Run, sample: Any) -> None:
    device.send_frames(*[sample(s) for s in range(4000, 4030)], *[sample(s) for s in range(20)])
    items = take(run.acquisition, 50)
    assert numbers(items) == [*range(4000, 4030), *range(4040, 4060)]
    (restart,) = [i for i in items if isinstance(i, Restarted)]
    assert restart.change is not None
    assert (restart.change.block, dict(restart.change.values)) == (202, {RESTART: (4029, 4040)})
    assert run.acquisition.counters.restarts == 1
    t = [int(t) for i in items if isinstance(i, Arrival) for t in i.raw.t_ns]
    assert all(b > a for a, b in itertools.pairwise(t))


def test_reader_waits_for_an_unplugged_device_and_resumes(
    device: Any, run: Run, sample: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits, wait = set[float | None](), threading.Event.wait

    def recorded_wait(event: threading.Event, seconds: float | None = None) -> bool:
        waits.add(seconds)
        return wait(event, seconds)

    device.send_frames(*[sample(s) for s in range(25)])
    take(run.acquisition, 20)
    monkeypatch.setattr(threading.Event, 'wait', recorded_wait)
    device.unplug()
    run.heard('waiting for it to come back')
    device.plug()
    run.heard('the device is back')
    assert 0.2 in waits
    assert device.greeted.wait(WAIT_S)
    device.send_frames(*[sample(s) for s in range(1000, 1020)])
    items = take(run.acquisition, 25)
    assert numbers(items) == [*range(20, 25), *range(1000, 1020)]
    assert (run.acquisition.counters.disconnects, run.acquisition.counters.lost) == (1, 975)


def test_a_full_queue_drops_the_newest_and_counts(device: Any, rig: Rig, sample: Any) -> None:
    run = Run(load_rig(overrides={'port': rig.acquisition.port, 'queue_blocks': 2}))
    device.send_frames(*[sample(s) for s in range(100)], HelloFrame(1, {'serial': 'T-1'}))
    # The odd HELLO is rejected with a message: by then all samples before it were handled.
    run.heard('kept to the first HELLO')
    run.acquisition.stop()
    items: list[Item] = []
    while not items or not isinstance(items[-1], Ended):
        items.append(run.acquisition.queue.get(timeout=WAIT_S))
    assert (numbers(items), run.acquisition.counters.queue_dropped) == (list(range(40)), 60)


def test_a_note_of_the_time_map_takes_no_block_s_room(sample: Any) -> None:
    acquisition = Acquisition(load_rig(overrides={'queue_blocks': 2}), null_log)
    acquisition.feed([sample(s) for s in range(20)], 10**9)
    # 0.3 s of samples within a millisecond: the map steps.
    acquisition.feed([sample(s) for s in range(20, 320)], 10**9 + 10**6)
    acquisition.feed([sample(s) for s in range(320, 340)], 10**9 + 21 * 10**6)
    items = [acquisition.queue.get() for _ in range(acquisition.queue.qsize())]
    assert any(isinstance(item, Annotation) for item in items)
    assert numbers(items) == list(range(40))


def test_stop_hands_over_what_was_read(device: Any, rig: Rig, sample: Any) -> None:
    run = Run(rig)
    device.send_frames(*[sample(s) for s in range(7)])
    assert numbers(take(run.acquisition, 7)) == list(range(7))
    run.acquisition.stop()
    assert isinstance(run.acquisition.queue.get(timeout=WAIT_S), Ended)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.binary(max_size=60), max_size=8))
def test_no_garbage_stops_the_reader(device: Any, rig: Rig, sample: Any, junk: list[bytes]) -> None:
    run = Run(rig)
    try:
        for piece in junk:
            device.send(piece + b'\x00')
        device.send_frames(*[sample(s) for s in range(20)])
        assert numbers(take(run.acquisition, 20))[-20:] == list(range(20))
    finally:
        run.acquisition.stop()


@pytest.fixture
def short_wait(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr(module, 'SILENCE_S', 0.2)
    return module


def not_opened(rig: Rig, why: str) -> None:
    with pytest.raises(DeviceError, match=why):
        Acquisition(rig, null_log).open()


@pytest.mark.parametrize(
    ('name', 'why'),
    [
        ('nowhere', r'nowhere: no such port; .*psd-deflection devices'),
        ('tty*', r'tty\*: no port of such a name .*psd-deflection devices'),
        ('file.txt', r'file\.txt: not a serial port'),
        ('', r'[^:]*: not a serial port$'),
    ],
)
def test_a_port_that_is_none_is_named(tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / 'file.txt').write_text('x')
    not_opened(load_rig(overrides={'port': str(tmp_path / name)}), why)


def test_a_port_in_use_is_named(run: Run, rig: Rig) -> None:
    not_opened(rig, 'another program has the port open')


def test_a_silent_device_is_named(device: Any, rig: Rig, short_wait: ModuleType) -> None:
    device.answer = b''
    not_opened(rig, r'no frame in 0.2 s; is the device powered')


def read_rest(monkeypatch: pytest.MonkeyPatch, answer: bytes) -> None:
    """The time to wait for a HELLO is over once ``answer`` was read."""
    heard = bytearray()

    class Listener(SerialPort):
        def read(self, timeout: float) -> bytes:
            piece = super().read(timeout)
            heard.extend(piece)
            return piece

    def port(name: str, baud: int, **settings: object) -> SerialPort:
        return Listener(name, baud)

    monkeypatch.setattr(port_source, 'open_port', port)
    clock = SimpleNamespace(monotonic=lambda: 1e6 if heard.endswith(answer) else 0.0)
    monkeypatch.setattr(contract_frames, 'time', clock)


def test_a_device_that_talks_something_else_is_named(device: Any, rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    device.answer = b'$GPGGA,123519,4807.038,N\r\n'
    read_rest(monkeypatch, device.answer)
    not_opened(rig, r'26 bytes but no frame .* baud rate')


def test_samples_without_hello_are_named(device: Any, rig: Rig, sample: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    device.answer = b'\x00' + encode(sample(1)) + encode(sample(2))
    read_rest(monkeypatch, device.answer)
    not_opened(rig, 'samples come but no HELLO')


@pytest.mark.parametrize(
    ('version', 'info', 'message'),
    [
        (2, {}, 'protocol version 2, this is version 1'),
        (1, {'sample_rate_hz': 500.0}, 'sample_rate_hz 500.0, the rig file says 1000'),
        (1, {'channels': ['x1', 'y1']}, 'channels'),
        (1, {'volts_per_count': 'many'}, "volts_per_count 'many'"),
        (1, {'volts_per_count': 0.001}, 'the rig file gives 0.000305176'),
        (1, {'volts_per_count': True}, 'volts_per_count True'),
    ],
)
def test_a_device_that_does_not_fit_is_named(
    device: Any, rig: Rig, hello: HelloFrame, version: int, info: dict[str, object], message: str
) -> None:
    device.answer = encode(HelloFrame(version, {**hello.info, **info}))
    not_opened(rig, f'{re.escape(rig.acquisition.port)}.*{message}')


def test_every_lost_sample_has_a_cause(device: Any, run: Run, sample: Any) -> None:
    device.send_frames(*[sample(s) for s in range(10)])
    device.send_frames(sample(13, flags=2), sample(14))
    damaged = bytearray(encode(sample(15)) + encode(sample(16)))
    damaged[5] ^= 0x10
    damaged[40] ^= 0x10
    device.send(bytes(damaged))
    device.send_frames(sample(17), *[sample(s) for s in range(22, 40)])
    take(run.acquisition, 31)
    counters = run.acquisition.counters
    by_cause = {'dropped by the device': 3, 'damaged on the wire': 2, 'on the wire, without a trace': 4}
    assert (dict(counters.lost_by), counters.lost, counters.bad) == (by_cause, 9, 2)


def test_renamed_device_is_recovered_by_serial_number(device: Any, tmp_path: Path, sample: Any) -> None:
    device.answer = encode(HelloFrame(1, {**HELLO.info, 'serial': 'MINE'}))
    run = Run(load_rig(overrides={'port': str(tmp_path / 'port*'), 'serial_number': 'MINE'}))
    try:
        device.send_frames(*[sample(s) for s in range(20)])
        take(run.acquisition, 20)
        device.unplug()
        run.heard('waiting for it to come back')
        # Another device takes the old name, ours comes back under a new one.
        other = type(device)(tmp_path / 'port')
        other.answer = encode(HelloFrame(1, {**HELLO.info, 'serial': 'OTHER'}))
        device.link = tmp_path / 'port_b'
        device.plug()
        assert 'port_b: the device is back' in run.heard('the device is back')
        device.send_frames(*[sample(s) for s in range(1000, 1020)])
        assert numbers(take(run.acquisition, 20)) == list(range(1000, 1020))
        assert dict(run.acquisition.counters.lost_by) == {'while the port was away': 980}
        other.unplug()
    finally:
        run.acquisition.stop()


def test_another_device_on_the_same_port_is_not_taken(device: Any, run: Run) -> None:
    device.unplug()
    run.heard('waiting for it to come back')
    device.answer = encode(HelloFrame(1, {**HELLO.info, 'serial': 'OTHER'}))
    device.plug()
    assert "serial number 'OTHER' and not 'T-1'" in run.heard('another device answers')
    device.unplug()
    device.answer = encode(HELLO)
    device.plug()
    run.heard('the device is back')


def test_wanted_serial_number_holds_for_first_device(device: Any, rig: Rig) -> None:
    other = load_rig(overrides={'port': rig.acquisition.port, 'serial_number': 'X'})
    not_opened(other, "serial number 'T-1' and not 'X'")


def test_a_silent_device_is_woken(device: Any, run: Run, short_wait: ModuleType, sample: Any) -> None:
    assert device.greeted.wait(WAIT_S)
    device.greeted.clear()
    run.heard('no sample for 0.2 s')
    assert device.greeted.wait(WAIT_S)
    device.send(b'\x01rubbish without an end\x00' * 3)
    device.send_frames(*[sample(s) for s in range(20)])
    assert numbers(take(run.acquisition, 20)) == list(range(20))
    assert run.acquisition.counters.silences >= 1


@pytest.mark.parametrize(('at', 'jump_us'), [(40, 10**9), (47, 10**9), (40, -(10**7)), (53, -(10**7))])
def test_a_device_clock_jump_is_reported_and_stamps_increase(
    device: Any, run: Run, sample: Any, at: int, jump_us: int
) -> None:
    clock = [10**8 + s * 1000 + (jump_us if s >= at else 0) for s in range(80)]
    device.send_frames(*[sample(s, t_us=clock[s]) for s in range(40)])
    before = take(run.acquisition, 40)
    device.send_frames(*[sample(s, t_us=clock[s]) for s in range(40, 80)])
    run.heard("the device's clock jumped")
    assert run.level == WARNING
    items = before + take(run.acquisition, 40)
    t = [int(t) for i in items if isinstance(i, Arrival) for t in i.raw.t_ns]
    assert all(b > a for a, b in itertools.pairwise(t))
    # The jump itself is 10 or 1000 s; what passes between the two halves is the machine's.
    assert t[-1] - t[0] < 8 * 10**9
    assert (run.acquisition.counters.clock_jumps, numbers(items)) == (1, list(range(80)))


class Fed:
    """An acquisition that is fed with what the test makes up; what it hands over, by sample number.

    ``t_ns``: stamp less the time at which the test sampled it. ``steps``, ``squeezed``: what is noted for the
    recording, with the number of the last sample before it.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.acquisition = Acquisition(load_rig(), lambda text, _level=0: self.lines.append(text))
        self.off_ns: dict[int, int] = {}
        self.steps: list[tuple[int, float]] = []
        self.squeezed = 0.0

    def read(self, now_ms: int, samples: list[SampleFrame]) -> None:
        # What has waited comes in reads of 4096 bytes.
        for n in range(0, len(samples), 150):
            self.acquisition.feed(samples[n : n + 150], now_ms * 10**6 + n * 10_000)
            self._take()

    def _take(self) -> None:
        while not self.acquisition.queue.empty():
            item = self.acquisition.queue.get()
            if isinstance(item, Arrival):
                times = item.raw.t_ns - self.acquisition.to_ros_ns
                self.off_ns |= {int(k): int(t) - int(k) * 10**6 for k, t in zip(item.raw.seq, times, strict=True)}
            elif isinstance(item, Annotation):
                ((name, value),) = item.change.values
                if name == CLOCK_STEP:
                    self.steps.append((max(self.off_ns), float(value)))  # type: ignore[arg-type]
                else:
                    assert name == CLOCK_SQUEEZED
                    self.squeezed += float(value)  # type: ignore[arg-type]


@pytest.mark.parametrize('late_s', [0.1, 1.5, 10.0])
def test_a_line_that_is_late_at_first_is_reported_and_recorded(late_s: float, sample: Any) -> None:
    """All bytes come late for three seconds. No sample is missing, and each stamp is right or noted."""
    fed, sent, late_ms = Fed(), 0, round(late_s * 1000)
    for now_ms in range(late_ms + 10, late_ms + 6000, 10):
        # What was sent when the line recovers comes with the first that is in time.
        to = now_ms - late_ms if now_ms < late_ms + 3000 else now_ms
        fed.read(now_ms, [sample(k, t_us=10**6 + 1000 * k) for k in range(sent, to)])
        sent = to
    assert list(fed.off_ns) == list(range(min(fed.off_ns), max(fed.off_ns) + 1))
    ((_, step),) = fed.steps
    assert step == pytest.approx(-late_s, abs=0.011)
    assert fed.squeezed == pytest.approx(1000 * late_s, abs=25)
    wrong = [k for k, off_ns in fed.off_ns.items() if abs(off_ns) > 5_000_000]
    assert wrong == list(range(min(fed.off_ns), max(wrong) + 1))
    # What has waited takes a hundredth of its time to come.
    assert max(wrong) == pytest.approx(3000 + late_ms, abs=25 + 0.01 * late_ms)
    assert any(f'{late_ms}' in line and 'too late' in line for line in fed.lines), fed.lines
    assert any(f'{fed.squeezed:.0f} samples have stamps 1 ns apart' in line for line in fed.lines)


@pytest.mark.parametrize('rate', [2.0, 1.05, 0.98, 0.5])
def test_a_clock_that_changes_its_rate_has_each_step_noted(rate: float, sample: Any) -> None:
    """After ten seconds; every stamp is off by no more than the next step says."""
    fed = Fed()
    for now_ms in range(10, 25_000, 10):
        clock = [round(k * 1000 + max(k - 10_000, 0) * 1000 * (rate - 1.0)) for k in range(now_ms - 10, now_ms)]
        fed.read(now_ms, [sample(k, t_us=t_us) for k, t_us in zip(range(now_ms - 10, now_ms), clock, strict=True)])
    assert len(fed.steps) >= 5
    assert all((step < 0.0) == (rate > 1.0) for _, step in fed.steps)
    first = 0
    for last, step in fed.steps:
        assert max(abs(fed.off_ns[k]) for k in range(first, last + 1)) < 1e9 * abs(step) + 5e6
        first = last + 1
    assert any('the time map steps' in line for line in fed.lines)


class MadeUp(Source):
    def open(self, timeout: float) -> HelloFrame:
        return HELLO

    def start(self) -> None: ...

    def close(self) -> None: ...

    def describe(self) -> dict[str, str]:
        return {}


class Clockwork(MadeUp):
    """1000 samples a second by a clock of its own, which goes on when the reader waits or rests."""

    def __init__(self, clock: Clock) -> None:
        self.name, self.clock = 'clockwork', clock
        self.passed_s = 0.0
        self.given = 0
        self.reads: list[int] = []
        self.rests: list[float] = []

    def sleep(self, rest: float) -> None:
        self.passed_s += rest
        self.rests.append(rest)

    def read(self, timeout: float) -> Received:
        self.asked_s = timeout
        if self.given >= 40:
            raise SourceEndedError('forty are enough')
        self.passed_s = max(self.passed_s, 1e-3 * (self.given + 1))
        there = round(self.passed_s * 1e3)
        events: list[Event] = [Sample(0, n, n * 1000, (0, 0, 16384, 0, 0, 16384)) for n in range(self.given, there)]
        self.reads.append(there - self.given)
        self.given = there
        return Received(events, round(self.passed_s * 1e9), len(events))


@pytest.mark.parametrize('clock', [Clock.DEVICE, Clock.HOST])
def test_samples_gather_except_the_last_of_a_block(rig: Rig, monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
    source = Clockwork(clock)
    monkeypatch.setattr(module, 'make_source', lambda rig: source)
    monkeypatch.setattr(module, 'time', SimpleNamespace(**{**vars(time), 'sleep': source.sleep}))
    run = Run(rig)
    assert (numbers(take(run.acquisition, 40)), source.asked_s) == (list(range(40)), 0.1)
    run.acquisition.stop()
    if clock is Clock.HOST:
        # Whose samples are as old as their reading.
        assert source.reads == [1] * 40
        return
    assert len(source.reads) <= 20
    assert max(source.rests) <= module.GATHER_S
    # The estimate waits for the last sample of a block: it is read as it comes, alone.
    read_with = [size for size in source.reads for _ in range(size)]
    assert (read_with[19], read_with[39]) == (1, 1)


class Asked(MadeUp):
    """A sample and a ping's turn every half second, by its own clock."""

    def __init__(self, reads: int) -> None:
        self.name, self.clock = 'asked', Clock.DEVICE
        self.now_ns = self._given = 0
        self._reads = reads
        self._cookies: list[int] = []

    def read(self, timeout: float) -> Received:
        if self._given == self._reads:
            raise SourceEndedError('enough')
        self.now_ns += 500_000_000
        t_us = self.now_ns // 1000
        events: list[Event] = [Sample(0, 500 * self._given, t_us, (0, 0, 16384, 0, 0, 16384))]
        events += [PongFrame(cookie, t_us) for cookie in self._cookies]
        self._cookies.clear()
        self._given += 1
        return Received(events, self.now_ns, len(events))

    def ping(self, cookie: int) -> bool:
        self._cookies.append(cookie)
        return True


def pinged(source: Asked, monkeypatch: pytest.MonkeyPatch) -> Acquisition:
    """After the source has ended."""
    monkeypatch.setattr(module, 'make_source', lambda rig: source)
    clock = {'monotonic': lambda: source.now_ns / 1e9, 'monotonic_ns': lambda: source.now_ns}
    monkeypatch.setattr(module, 'time', SimpleNamespace(**{**vars(time), **clock}))
    acquisition = Acquisition(load_rig(), null_log)
    acquisition.open()
    acquisition.start()
    while not isinstance(acquisition.queue.get(timeout=WAIT_S), Ended):
        pass
    acquisition.stop()
    return acquisition


def test_pings_bound_the_delay_and_2_s_without_samples_count(monkeypatch: pytest.MonkeyPatch) -> None:
    acquisition = pinged(Asked(30), monkeypatch)
    # The last one was asked when nothing more came.
    assert (acquisition.counters.pings, acquisition.counters.pongs) == (30, 29)
    assert acquisition.clock_state().round_trip_ns == 500_000_000
    # Nothing comes for 6 s, half a second a read.
    read = Asked.read
    monkeypatch.setattr(module, 'SILENCE_S', SILENCE_S)
    monkeypatch.setattr(Asked, 'read', lambda source, seconds: read(source, seconds)._replace(events=[], size=0))
    assert pinged(Asked(12), monkeypatch).counters.silences == 2


@pytest.fixture
def asked_source() -> Mock:
    made = Mock(spec=Source)
    made.ping.return_value = True
    return made


def cookie_of(asked_source: Mock) -> int:
    (cookie,) = asked_source.ping.call_args.args
    return int(cookie)


def test_one_is_due_at_once_and_the_next_at_a_random_time(asked_source: Mock) -> None:
    waits = []
    for _ in range(50):
        pinger = Pinger()
        assert pinger.is_due(0.0)
        assert pinger.ask(asked_source, 10.0, 0)
        assert not pinger.is_due(10.0 + 0.99 * PING_S[0])
        assert pinger.is_due(10.0 + 1.01 * PING_S[1])
        waits.append(next(k for k in range(1000) if pinger.is_due(10.0 + k * 1e-3)))
    assert len(set(waits)) > 10


def test_late_answer_returns_send_time_of_question(asked_source: Mock) -> None:
    pinger = Pinger()
    pinger.ask(asked_source, 0.0, 111)
    first = cookie_of(asked_source)
    pinger.ask(asked_source, 1.0, 222)
    # Seconds late: how late the line is.
    assert pinger.answered(first) == 111
    assert pinger.answered(first) is None
    assert pinger.answered(cookie_of(asked_source)) == 222
    assert pinger.answered(cookie_of(asked_source)) is None
    assert pinger.answered(0) is None


def test_device_with_unanswered_pings_is_asked_no_more(asked_source: Mock) -> None:
    pinger = Pinger()
    for k in range(UNANSWERED):
        assert pinger.is_due(float(k))
        pinger.ask(asked_source, float(k), k)
    assert not pinger.is_due(1e9)


def test_one_answer_makes_up_for_those_before(asked_source: Mock) -> None:
    pinger = Pinger()
    for k in range(UNANSWERED - 1):
        pinger.ask(asked_source, float(k), k)
    assert pinger.answered(cookie_of(asked_source)) is not None
    pinger.ask(asked_source, 100.0, 0)
    assert pinger.is_due(200.0)


def test_a_source_that_cannot_be_asked_is_asked_once(asked_source: Mock) -> None:
    asked_source.ping.return_value = False
    pinger = Pinger()
    assert not pinger.ask(asked_source, 0.0, 0)
    assert not pinger.is_due(1e9)


def test_a_port_that_goes_away_meanwhile_is_the_callers_to_see(asked_source: Mock) -> None:
    asked_source.ping.side_effect = PortClosedError('gone')
    with pytest.raises(PortClosedError):
        Pinger().ask(asked_source, 0.0, 0)
