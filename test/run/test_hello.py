# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The gate for what a device says of itself, at the start and when it starts anew."""

import contextlib
import json
import math
import time
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.base.errors import DeviceError
from psd_deflection.base.log import null_log, texts
from psd_deflection.cli.main import main
from psd_deflection.devices.protocol.frames import HelloFrame, SampleFrame
from psd_deflection.devices.protocol.words import MAX_TEXT
from psd_deflection.devices.source import Received, Source
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.records import CHANNELS, channel_names
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run import acquisition as module
from psd_deflection.run import processing
from psd_deflection.run.acquisition import Acquisition
from psd_deflection.run.arrivals import Arrival
from psd_deflection.run.hello import AnotherDeviceError, HelloGate
from psd_deflection.run.session import Session
from test.heard import WAIT_S
from test.run.conftest import HELLO, Estimates, ScriptedDevice

pytestmark = pytest.mark.slow
VOLTS = 10.0 / 32768
GOOD = HELLO.info
HUGE = 10**308 * 10


def info(**changes: object) -> dict[str, object]:
    return {k: v for k, v in (GOOD | changes).items() if v is not ...}


def sealed(payload: bytes) -> bytes:
    """A frame of these bytes, with its check."""
    encoded: bytes = cobs.encode(payload + zlib.crc32(payload).to_bytes(4, 'little'))
    return b'\x00' + encoded + b'\x00'


def gate(first: Mapping[str, object] | None = None, *, volts: bool = False) -> HelloGate:
    made = HelloGate(load_rig())
    if first is not None:
        made.take(HelloFrame(1, dict(first)), 'port', volts=volts)
    return made


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'sample_rate_hz': HUGE}, "sample_rate_hz 'a whole number of 1027 bits', the rig file says 1000"),
        ({'sample_rate_hz': math.nan}, "sample_rate_hz 'nan', the rig file says 1000"),
        ({'sample_rate_hz': math.inf}, "sample_rate_hz 'inf'"),
        ({'sample_rate_hz': 1001.1}, 'sample_rate_hz 1001.1, the rig file says 1000'),
        ({'sample_rate_hz': True}, 'sample_rate_hz True'),
        ({'sample_rate_hz': [1000]}, r'sample_rate_hz \[1000\]'),
        ({'sample_rate_hz': ...}, 'sample_rate_hz None'),
        ({'volts_per_count': 1.0011 * VOLTS}, 'volts_per_count 0.0003055'),
        ({'volts_per_count': None}, 'volts_per_count None, needed is a number'),
        ({'volts_per_count': ...}, 'volts_per_count None, needed is a number'),
        ({'volts_per_count': HUGE}, "volts_per_count 'a whole number"),
        ({'volts_per_count': math.nan}, "volts_per_count 'nan'"),
        ({'serial': ...}, 'serial None, needed is a text'),
        ({'serial': 7}, 'serial 7, needed is a text'),
        ({'firmware': ...}, 'firmware None, needed is a text'),
        ({'firmware': ['a']}, r"firmware \['a'\], needed is a text"),
        ({'channels': {'x1': 1}}, 'channels'),
    ],
)
def test_what_does_not_fit_is_rejected_at_the_start_and_later(changes: dict[str, object], message: str) -> None:
    for before in (gate(), gate(GOOD)):
        hello = before.hello
        with pytest.raises(DeviceError, match=f'port: HELLO has {message}') as error:
            before.take(HelloFrame(1, info(**changes)), 'port', volts=False)
        assert len(str(error.value)) < 400
        assert (before.hello, before.volts_per_count) == (hello, VOLTS)


def test_volts_only_if_the_source_says_so() -> None:
    assert gate(info(volts_per_count=None), volts=True).volts_per_count is None
    with pytest.raises(DeviceError, match='needed is null, since its samples are volts'):
        gate(GOOD, volts=True)


def test_another_serial_number_is_another_device() -> None:
    taken = gate(GOOD)
    with pytest.raises(AnotherDeviceError, match="serial number 'T-2' and not 'T-1'"):
        taken.take(HelloFrame(1, info(serial='T-2', channels=[])), 'port', volts=False)
    assert taken.hello == HelloFrame(1, GOOD)


def test_the_scale_stays_and_other_keys_may_change() -> None:
    taken = gate(GOOD)
    with pytest.raises(DeviceError, match=r'volts_per_count 0.0003054.* now and had 0.00030517.* before'):
        taken.take(HelloFrame(1, info(volts_per_count=1.0009 * VOLTS)), 'port', volts=False)
    assert taken.volts_per_count == VOLTS
    taken.take(HelloFrame(1, info(firmware='newer', uptime=5, sample_rate_hz=1000.9)), 'port', volts=False)
    assert taken.hello is not None
    assert taken.hello.info['uptime'] == 5


def test_words_are_printable_and_bounded() -> None:
    hello = gate(info(serial='\ud800\x1b[31m', firmware='x' * 1000, note={'\x07': '\x1b]0;t\x07'})).hello
    assert hello is not None
    assert (hello.info['serial'], len(str(hello.info['firmware']))) == ('\\ud800\\x1b[31m', MAX_TEXT)
    assert hello.info['note'] == {'\\x07': '\\x1b]0;t\\x07'}
    json.dumps(hello.info, ensure_ascii=False).encode()


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters()) | st.just(HUGE),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.sampled_from([*GOOD, 'other']), VALUES, max_size=6), st.booleans(), st.booleans())
def test_any_hello_is_taken_or_rejected_with_a_device_error(changes: dict[str, Any], volts: bool, first: bool) -> None:
    before = gate(info(volts_per_count=None) if volts else GOOD, volts=volts) if first else gate()
    scale = before.volts_per_count
    with contextlib.suppress(DeviceError):
        before.take(HelloFrame(1, info(**changes)), 'port', volts=volts)
    if before.hello is not None:
        json.dumps(before.hello.info, allow_nan=False, ensure_ascii=False).encode()
    if first:
        assert before.volts_per_count == scale


class Quiet(Source):
    """Says ``answers`` when it is opened, the last one again and again; the test feeds it."""

    def __init__(self, *answers: Mapping[str, object]) -> None:
        self.name = 'quiet'
        self.answers = [dict(a) for a in answers]
        self.closed = 0

    def open(self, timeout: float) -> HelloFrame:
        return HelloFrame(1, self.answers.pop(0) if len(self.answers) > 1 else self.answers[0])

    def start(self) -> None: ...

    def read(self, timeout: float) -> Received:
        return Received([], time.monotonic_ns(), 0)

    def close(self) -> None:
        self.closed += 1

    def describe(self) -> dict[str, str]:
        return {}


def opened(monkeypatch: pytest.MonkeyPatch, source: Source, message: list[str], rig: Rig | None = None) -> Acquisition:
    monkeypatch.setattr(module, 'make_source', lambda rig: source)
    acquisition = Acquisition(load_rig() if rig is None else rig, texts(message.append))
    acquisition.open()
    return acquisition


def sample(seq: int, t_us: int | None = None) -> SampleFrame:
    return SampleFrame(0, seq, seq * 1000 if t_us is None else t_us, (0, 0, 16384, 0, 0, 16384))


def stamps(acquisition: Acquisition) -> list[int]:
    out: list[int] = []
    while not acquisition.queue.empty():
        item = acquisition.queue.get()
        if isinstance(item, Arrival):
            out += item.raw.t_ns.tolist()
    return out


def test_a_flood_of_hellos_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[str] = []
    acquisition = opened(monkeypatch, Quiet(GOOD), logged)
    for k in range(3000):
        acquisition.feed([HelloFrame(1, info(sample_rate_hz=k % 500))], k * 1_000_000)
    assert len(logged) == 1
    assert 'sample_rate_hz 0, the rig file says 1000' in logged[0]
    assert 'kept to the first HELLO' in logged[0]


def test_the_scale_of_samples_does_not_change_in_mid_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[str] = []
    acquisition = opened(monkeypatch, Quiet(GOOD), logged)
    other = HelloFrame(1, info(volts_per_count=1.0009 * VOLTS))
    for k in range(40):
        acquisition.feed([sample(k), other], k * 1_000_000)
    chunks = [acquisition.queue.get() for _ in range(2)]
    assert [c.raw.volts_per_count for c in chunks if isinstance(c, Arrival)] == [VOLTS, VOLTS]
    assert len(logged) == 1


def test_another_device_in_mid_stream_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Quiet(GOOD)
    acquisition = opened(monkeypatch, source, [])
    with pytest.raises(AnotherDeviceError):
        acquisition.feed([sample(0), HelloFrame(1, info(serial='T-2')), sample(1)], 0)
    assert acquisition.counters.samples == 1


def test_a_number_that_stands_still_floods_neither_log_nor_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[str] = []
    acquisition = opened(monkeypatch, Quiet(GOOD), logged)
    for k in range(1200):
        acquisition.feed([sample(20, 20_000 + 1000 * k)], k * 1_000_000)
    assert logged == []
    assert (acquisition.counters.restarts, acquisition.counters.repeated) == (0, 1199)
    assert acquisition.queue.empty()


def test_frequent_device_restarts_are_reported_rarely(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[str] = []
    acquisition = opened(monkeypatch, Quiet(GOOD), logged)
    for k in range(1000):
        acquisition.feed([sample(10_000 - 200 * (k % 2), 1000 * k)], k * 1_000_000)
    assert acquisition.counters.restarts > 100
    assert len([line for line in logged if 'started anew' in line]) <= module.NEWS + 1


def test_stopped_clock_is_reported_and_host_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[str] = []
    acquisition = opened(monkeypatch, Quiet(GOOD), logged)
    late = []
    for k in range(19_000):
        now = 10**12 + k * 1_000_000
        acquisition.feed([sample(k, min(k, 1000) * 1000)], now)
        late += [now + acquisition.to_ros_ns - t for t in stamps(acquisition)[-1:]]
    assert len(late) >= 950
    assert max(late) < 80_000_000
    assert acquisition.counters.clock_jumps > 100
    assert any('clock stands still' in line for line in logged)
    assert len(logged) <= 2 * (module.NEWS + 3)


@pytest.mark.parametrize('rate', ['1' + 309 * '0', 'NaN', '1e999'])
def test_no_rate_on_the_wire_ends_the_reader(device: Any, rig: Rig, rate: str) -> None:
    text = json.dumps(info(sample_rate_hz=12345)).replace('12345', rate)
    device.answer = sealed(b'\x10\x01' + text.encode())
    with pytest.raises(DeviceError, match='sample_rate_hz'):
        Acquisition(rig, null_log).open()


THREE = {**GOOD, 'psds': 3, 'channels': list(channel_names(3))}


@pytest.mark.parametrize(
    ('third', 'hello', 'message'),
    [
        (True, GOOD, 'HELLO has psds 2, the rig file has 3 PSDs'),
        (False, THREE, 'HELLO has psds 3, the rig file has 2 PSDs'),
        (True, {**THREE, 'psds': True}, 'HELLO has psds True'),
        (True, {**THREE, 'psds': 3.0}, 'HELLO has psds 3.0'),
        (True, {**THREE, 'psds': 'three'}, "HELLO has psds 'three'"),
        (True, {**THREE, 'channels': list(CHANNELS)}, 'HELLO has channels'),
    ],
)
def test_a_device_with_other_psds_than_the_rig_file_is_rejected(
    third: bool, hello: dict[str, object], message: str
) -> None:
    rig = load_rig(overrides={'psd_3.center': [0.08, 0.0]} if third else {})
    with pytest.raises(DeviceError, match=message):
        HelloGate(rig).take(HelloFrame(1, hello), 'port', volts=False)


def test_a_device_with_as_many_psds_is_taken() -> None:
    taken = HelloGate(load_rig(overrides={'psd_3.center': [0.08, 0.0]}))
    taken.take(HelloFrame(1, THREE), 'port', volts=False)
    assert taken.hello == HelloFrame(1, THREE)


Sample = Callable[..., SampleFrame]
STARTS = [(3000, 205), (2**31 + 7, 193), (5, 200), (4_000_000_000, 120), (3_999_999_870, 110)]
"""First number and samples of each run of the device: most begin or end amid a block, the last one ends with one."""
SENT = sum(n for _, n in STARTS)
BLOCKS = Counter((run, number // 20) for run, (first, n) in enumerate(STARTS) for number in range(first, first + n))
ESTIMATES = sum(samples >= load_rig().estimator.min_samples for samples in BLOCKS.values())


@pytest.fixture
def bag(device: ScriptedDevice, sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(processing, 'REQUEST_TIMEOUT_S', WAIT_S)
    values = {'port': str(device.link), 'bag_dir': str(tmp_path / 'bags'), 'keep_zero': False, 'realtime': False}
    session = Session(load_rig(overrides={**values, 'record': True, 'disk_reserve': 1_000_000}), null_log)
    estimates = Estimates(ESTIMATES)
    session.processing.sinks.append(estimates)
    session.start()
    for first, count in STARTS:
        # The clock of the device starts anew with it.
        device.send_frames(*(sample(first + k, 1000 * k) for k in range(count)))
    assert estimates.enough.wait(WAIT_S)
    folder = session.close()
    counters = session.acquisition.counters
    assert (counters.samples, counters.lost, counters.restarts) == (SENT, 0, len(STARTS) - 1)
    assert folder is not None
    return folder


def test_a_restart_is_recorded_and_no_command_invents_a_loss(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command, more in (('info', ()), ('replay', ('--compare',)), ('plot', ('--out', str(bag.parent / 'a.svg')))):
        assert main([command, str(bag), *more, '--json']) == 0
        tree = json.loads(capsys.readouterr().out)
        assert tree['lost'] == 0
        assert command != 'info' or (tree['samples'], tree['restarts']) == (SENT, 4)
    assert main(['convert', str(bag), '--out', str(bag.parent / 'again.mcap')]) == 0
    capsys.readouterr()
    assert main(['info', str(bag.parent / 'again.mcap')]) == 0
    text = capsys.readouterr().out
    assert f'{SENT} present, 0 lost' in text
    assert 'restarts     4 of the device' in text
    # Numbers that belong to no sample are few: other readers see less than two blocks of them at each restart.
    assert np.diff(open_recording(bag).samples['seq']).max() < 40
