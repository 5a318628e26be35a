# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Thorlabs aligners and DATAQ converters: messages written by hand, and simulated devices on lines of our own."""

import contextlib
import itertools
import re
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.devices import PowerUp
from psd_deflection.devices.dataq import SimulatedDataq
from psd_deflection.devices.protocol import apt, dataq
from psd_deflection.devices.protocol.frames import BadFrame
from psd_deflection.devices.registry import make_source
from psd_deflection.devices.source import PortClosedError
from psd_deflection.devices.thorlabs import SharedRig, SimulatedAligner
from psd_deflection.rig.config import Rig, load_rig

# Submessage 3; x = 8191, y = -16384, sum = 32768 counts (5 V); the position outputs do not matter.
REPLY = bytes.fromhex('7208 0c00 81 50  0300 ff1f 00c0 0080 0000 0000')
# 5 V of sum: a difference of 2.5 V is half-way to the edge, which is 5 V to us.
X, Y = 8191 / 32767 * 10.0 * 2.0, -16384 / 32767 * 10.0 * 2.0


def is_reply(reading: object) -> bool:
    return isinstance(reading, apt.QuadrantReadings) and tuple(reading) == pytest.approx((X, Y, 5.0), rel=1e-4)


def test_questions_and_answers_byte_by_byte() -> None:
    assert bytes.fromhex('710803005001') == apt.READINGS_REQUEST
    assert bytes.fromhex('050000005001') == apt.INFO_REQUEST
    (reading,) = apt.AptDecoder().feed(REPLY)
    assert is_reply(reading)
    assert apt.encode_readings(8191, -16384, 32768)[:14] == REPLY[:14]
    (info,) = apt.AptDecoder().feed(apt.encode_info(69251980, 'KPA101'))
    assert info == apt.HardwareInfo(69251980, 'KPA101', '1.0.0')
    assert len(apt.encode_info(1, 'TQD001')) == 90


def test_the_info_of_an_aligner_byte_by_byte() -> None:
    """Serial number, model, type 16, firmware 1.0.0 from its last number on, notes, version, state, channels."""
    body = bytes.fromhex('0df4 2004') + b'KPA101\0\0' + bytes.fromhex('1000 00000100')
    body += b'simulated'.ljust(60, b'\0') + bytes.fromhex('0100 0000 0100')
    assert apt.encode_info(0x0420F40D, 'KPA101') == bytes.fromhex('0600 5400 81 50') + body
    assert apt.encode_info(1, 'KPA101-LONG')[10:18] == b'KPA101-L'
    # What is not as long is none.
    short = bytes.fromhex('0600 5300 81 50') + body[:-1]
    assert apt.AptDecoder().feed(short) == [BadFrame('length does not fit the message', 89)]


def test_ten_volts_are_the_whole_range() -> None:
    assert apt.readings_of(32767, -32767, 65535) == pytest.approx((10.0, -10.0, 10.0), rel=1e-12)
    # Half of the light: the same difference is twice as far out.
    assert apt.readings_of(16384, 0, 32768)[0] == pytest.approx(10.0 * (16384 / 32767) / (32768 / 65535), rel=1e-12)


def test_what_is_no_reading_is_passed_over() -> None:
    other = bytearray(REPLY)
    other[6] = 4
    assert [is_reply(m) for m in apt.AptDecoder().feed(bytes(other) + REPLY)] == [True]


def test_what_is_thrown_away_is_counted() -> None:
    decoder = apt.AptDecoder()
    # Three bytes begin no header; five are too few for one.
    assert (decoder.feed(bytes(8)), decoder.reset(), decoder.feed(REPLY[:10])) == ([], 8, [])
    assert decoder.reset() == 10
    assert [is_reply(m) for m in decoder.feed(REPLY)] == [True]


def test_without_light_no_place_is_made_up() -> None:
    assert apt.readings_of(20000, -20000, 0) == apt.QuadrantReadings(0.0, 0.0, 0.0)
    assert apt.readings_of(3, -3, 300)[:2] == (0.0, 0.0)
    # 0.05 V are 327.7 counts.
    assert apt.readings_of(3, -3, 327)[:2] == (0.0, 0.0)
    assert apt.readings_of(3, -3, 328)[:2] == pytest.approx((300 / 32767 / 0.05005, -300 / 32767 / 0.05005), rel=1e-4)


STREAM = b'\1\2\3' + REPLY + b'\x81\0\2\0\1\x50' + REPLY + bytes.fromhex('7208 0200 81 50 0300') + REPLY * 2


@given(st.lists(st.integers(0, len(STREAM)), max_size=30))
def test_messages_come_out_however_the_stream_was_cut(cuts: list[int]) -> None:
    decoder = apt.AptDecoder()
    places = sorted({0, len(STREAM), *cuts})
    got = [m for a, b in itertools.pairwise(places) for m in decoder.feed(STREAM[a:b])]
    bad = {0: BadFrame('no APT header', 3), 3: BadFrame('length does not fit the message', 8)}
    assert {n: m for n, m in enumerate(got) if not is_reply(m)} == bad
    assert len(got) == 6


@given(st.lists(st.binary(max_size=100), max_size=10))
def test_garbage_raises_nothing_and_is_not_kept(pieces: list[bytes]) -> None:
    decoder = apt.AptDecoder()
    for piece in pieces:
        decoder.feed(piece)
    decoder.reset()
    assert decoder.reset() == 0


@pytest.mark.parametrize(
    ('source', 'port', 'other', 'why'),
    [
        *(('thorlabs', port, {}, 'two ports are needed') for port in ('', '/dev/ttyUSB0', 'a,b,c', 'a,', 'a,a')),
        ('thorlabs', 'a,b', {'thorlabs.x_sign': 0.5}, 'must be 1 or -1'),
        ('dataq', 'x', {'converter.full_scale': 5.0}, r'converter\.full_scale = 10'),
    ],
)
def test_what_cannot_be_read_is_rejected(source: str, port: str, other: dict[str, float], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        make_source(load_rig(overrides={'source': source, 'port': port, **other}))


SLOW: dict[str, object] = {
    'converter.sample_rate_hz': 100.0,
    'block_size': 5,
    'min_samples': 2,
    'source': 'thorlabs',
    'psd_1.zero': [1e-3, 0.5e-3],
}


@pytest.fixture
def pair(wired: Any, unloaded: Any) -> Callable[..., tuple[Any, Any, Rig]]:
    def make(**options: object) -> tuple[Any, Any, Rig]:
        shared = SharedRig(unloaded(load_rig(overrides=SLOW)))
        ports = [wired(SimulatedAligner(shared, psd, answer_ns=500_000)) for psd in (1, 2)]
        rig = load_rig(overrides={**SLOW, 'port': ','.join(str(p.link) for p in ports), **options})
        return ports[0], ports[1], rig

    return make


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_it_reads_the_rig_in_slots_of_its_rate(pair: Any, run: Any, volts: Any, sign: float) -> None:
    _, _, rig = pair(**{'thorlabs.x_sign': sign})
    running = run(rig)
    assert running.acquisition.hello.info['serial'] == '69000001,69000002'
    chunks = running.take(30)
    assert all(c.raw.volts_per_count is None for c in chunks)
    means = volts(chunks).mean(axis=0)
    np.testing.assert_allclose(means, [sign * 2.0, 1.0, 5.0, 0.0, 0.0, 5.0], atol=5e-3)
    numbers = np.concatenate([c.raw.seq for c in chunks])
    times = np.concatenate([c.raw.t_ns for c in chunks])
    # Every sample lies in its own slot: number and time tell the same.
    offsets = times - numbers * 10_000_000
    assert offsets.max() - offsets.min() < 10_000_000
    assert running.acquisition.counters.lost >= int(numbers[-1] - numbers[0]) + 1 - len(numbers)
    state = running.acquisition.source.describe()
    assert state['rate asked for (1/s)'] == '100'
    assert float(state['rate done (1/s)']) > 0


def test_unreachable_rate_is_rejected_with_limit(pair: Any) -> None:
    _, _, rig = pair(**{'converter.sample_rate_hz': 5000.0})
    with pytest.raises(DeviceError, match=r'gives \d+ readings/s, .* = 5000 is out of reach; set it to at most \d+'):
        make_source(rig).open(2.0)


def test_one_that_is_pulled_out_is_lost_time_not_lost_order(pair: Any, run: Any, unloaded: Any) -> None:
    _, second, rig = pair()
    running = run(rig)
    last = max(int(s) for c in running.take(10) for s in c.raw.seq)
    second.unplug()
    running.heard('waiting for it to come back')
    second.plug(SimulatedAligner(SharedRig(unloaded(load_rig(overrides=SLOW))), 2, answer_ns=500_000))
    running.heard('the device is back')
    counters, later = running.acquisition.counters, [last]
    # What was read before it was pulled out comes first.
    while not counters.lost and len(later) < 1000:
        later += [int(s) for c in running.take(10) for s in c.raw.seq]
    assert (np.diff(later) > 0).all()
    assert (counters.disconnects, counters.lost > 0) == (1, True)
    assert counters.restarts == 0


def test_a_port_where_nothing_answers_is_named(wired: Any, unloaded: Any) -> None:
    shared = SharedRig(unloaded(load_rig()))
    good = wired(SimulatedAligner(shared, 1))
    mute = wired(SimulatedAligner(shared, 2, answer_ns=10**12))
    rig = load_rig(overrides={**SLOW, 'port': f'{good.link},{mute.link}'})
    with pytest.raises(DeviceError, match=r'port_1: nothing in 0\.3 s; is it a KPA101'):
        make_source(rig).open(0.3)


@contextlib.contextmanager
def started(rig: Rig) -> Iterator[Any]:
    with contextlib.closing(make_source(rig)) as source:
        source.open(2.0)
        source.start()
        yield source


def test_an_answer_that_does_not_come_is_counted(pair: Any) -> None:
    _, _, rig = pair()
    with started(rig) as source:
        source._ports[1].write = lambda _: None
        reading = source.read(0.1)
    assert reading.events == [BadFrame('no answer in time', 0)]


def test_port_lost_during_read_raises_port_closed(pair: Any) -> None:
    first, _, rig = pair()
    with started(rig) as source:
        first.unplug()
        with pytest.raises(PortClosedError):
            source.read(0.1)


@pytest.mark.parametrize(('size', 'fits'), [(255, True), (256, False)])
def test_a_message_has_255_bytes_at_most(size: int, fits: bool) -> None:
    """One that is of no interest is passed over; what is longer is none."""
    other = struct.pack('<HHBB', 0x1234, size, 0x81, 0x50) + bytes(size)
    got = apt.AptDecoder().feed(other + REPLY)
    assert is_reply(got[-1])
    assert got[:-1] == ([] if fits else [BadFrame('no APT header', len(other))])


# x1 = 1, y1 = -2, sum1 = 16384, x2 = 256, y2 = -32767, sum2 = 16384, then the counter at zero.
SCAN = bytes.fromhex('0100 feff 0040 0001 0180 0040 0080')
COUNTS = (1, -2, 16384, 256, -32767, 16384)


def test_commands_and_counts_are_those_of_the_protocol() -> None:
    assert dataq.VOLTS_PER_COUNT * 2**15 == 10.0
    assert dataq.command('srate 60000') == b'srate 60000\r'
    assert dataq.scan_list(range(6)) == [*(f'slist {n} {n}' for n in range(6)), 'slist 6 10']


@pytest.mark.parametrize(
    ('received', 'asked', 'reply'),
    [
        (b'info 1 2108\r', 'info 1', '2108'),
        (b'\x00info 1 2108\r\x00\x00', 'info 1', '2108'),
        (b'stop\r', 'stop', ''),
        (SCAN * 3 + b'\x0dstop\r', 'stop', ''),
        (SCAN * 3 + b'stop\r', 'stop', ''),
        (b'info 1 21', 'info 1', None),
        (b'info 12 x\r', 'info 1', None),
        (b'', 'stop', None),
    ],
)
def test_a_reply_is_found_behind_scans_and_between_zeros(received: bytes, asked: str, reply: str | None) -> None:
    assert dataq.find_reply(received, asked) == reply


PIECES = st.binary(max_size=30) | st.sampled_from([b'info', b' 1', b'info 1', b' 2108', b'\r', b'\x00'])


@given(st.lists(PIECES, max_size=12))
def test_no_reply_is_made_up_and_the_one_that_follows_is_found(pieces: list[bytes]) -> None:
    received = b''.join(pieces)
    reply = dataq.find_reply(received, 'info 1')
    if reply is not None:
        assert re.search(rb'info 1( [^\r]*)?\s*\r', received.replace(b'\x00', b''))
    assert dataq.find_reply(received + b'\rinfo 1 2108\r', 'info 1') == '2108'


def fed(stream: bytes, cuts: list[int]) -> list[Any]:
    decoder = dataq.ScanDecoder()
    places = sorted({0, len(stream), *(c % (len(stream) + 1) for c in cuts)})
    return [item for a, b in itertools.pairwise(places) for item in decoder.feed(stream[a:b])]


def parted(got: list[Any]) -> tuple[list[Any], list[int]]:
    """The scans, and the sizes of what was none."""
    scans = [item for item in got if not isinstance(item, BadFrame)]
    return scans, [item.size for item in got if isinstance(item, BadFrame)]


@given(st.lists(st.integers(0, 10_000), max_size=20))
def test_scans_come_out_however_the_stream_was_cut(cuts: list[int]) -> None:
    assert fed(SCAN * 20, cuts) == [COUNTS] * 20


@given(st.integers(1, 13), st.lists(st.integers(0, 10_000), max_size=20))
def test_lost_bytes_are_observed_and_the_step_is_found_again(lost: int, cuts: list[int]) -> None:
    stream = SCAN * 5 + SCAN[lost:] + SCAN * 10
    got = fed(stream, cuts)
    assert got == fed(stream, [])
    scans, sizes = parted(got)
    assert (scans, sum(sizes)) == ([COUNTS] * 15, 14 - lost)


@given(st.integers(1, 40), st.lists(st.integers(0, 10_000), max_size=20))
@example(14, [])
@example(15, [])
@example(28, [])
@example(29, [])
def test_bytes_between_scans_cost_no_scan(more: int, cuts: list[int]) -> None:
    """Also if they are as many as a scan has, as where a marker is damaged: four scans in all tell the step."""
    for following in (4 if more % 14 else 3, 10):
        scans, sizes = parted(fed(SCAN * 5 + b'\x11' * more + SCAN * following, cuts))
        # By a scan's length at a time, and then what is left.
        full = (more - 1) // 14
        assert (scans, sizes) == ([COUNTS] * (5 + following), [14] * full + [more - 14 * full])


def test_two_readings_at_the_rail_are_no_marker() -> None:
    """The marker is the negative rail as well: three in a row in one place tell the step, two do not."""
    railed = bytes.fromhex('0100 0080') + SCAN[4:]
    # A byte is lost before the first of two scans whose y1 is at the rail.
    scans, sizes = parted(fed(SCAN * 3 + SCAN[1:] + railed * 2 + SCAN * 6, []))
    assert scans == [*[COUNTS] * 3, *[(1, -32768, *COUNTS[2:])] * 2, *[COUNTS] * 6]
    assert sizes == [13]


@given(st.binary(max_size=300), st.lists(st.integers(0, 10_000), max_size=8))
def test_garbage_raises_nothing_and_the_cuts_do_not_matter(junk: bytes, cuts: list[int]) -> None:
    assert fed(junk, cuts) == fed(junk, [])


@pytest.mark.parametrize(
    ('model', 'hz', 'per_channel', 'srate', 'dec'),
    [
        ('2108', 1000.0, False, 60_000, 1),
        ('2108', 1000.0, True, 8571, 1),
        ('4108', 100.0, False, 60_000, 10),
        ('1110', 1000.0, False, 60_000, 1),
    ],
)
def test_the_rate_is_laid_out_from_the_clock(model: str, hz: float, per_channel: bool, srate: int, dec: int) -> None:
    rate = dataq.plan_rate(hz, dataq.MODELS[model], per_channel)
    assert rate is not None
    assert (rate.srate, rate.dec) == (srate, dec)
    assert rate.hz == pytest.approx(60e6 / (srate * dec) / (7 if per_channel else 1))
    assert rate.hz == pytest.approx(hz, rel=1e-3)


def test_the_models_are_those_of_the_data_sheets() -> None:
    """Analog inputs, a counter, a decimating filter; the highest rate is 60 MHz over the least srate."""
    assert {name: (m.analog, m.counter, m.decimates, 60e6 / m.srate_min) for name, m in dataq.MODELS.items()} == {
        '1100': (4, False, False, 40_000.0),
        '1110': (8, True, False, 160_000.0),
        '1120': (4, True, False, 160_000.0),
        '2108': (8, True, True, 160_000.0),
        '4108': (8, True, True, 160_000.0),
    }


@pytest.mark.parametrize(
    ('model', 'hz', 'possible'),
    [
        *(('2108', 160_000.0, True), ('2108', 161_000.0, False), ('1110', 60e6 / 65_535, True)),
        *(('1110', 60e6 / 65_537, False), ('1110', 500.0, False), ('2108', 1e6, False)),
        *(('2108', 60e6 / 65_537, True), ('2108', 60e6 / (65_535 * 512), True)),
        ('2108', 60e6 / (65_535 * 512.01), False),
    ],
)
def test_srate_and_dec_have_the_limits_of_the_protocol(model: str, hz: float, possible: bool) -> None:
    """srate of 16 bits, dec to 512."""
    assert (dataq.plan_rate(hz, dataq.MODELS[model], False) is not None) == possible


@pytest.mark.parametrize('per_channel', [False, True])
def test_it_reads_the_rig_at_the_rate_of_the_rig(
    wired: Any, run: Any, unloaded: Any, volts: Any, per_channel: bool
) -> None:
    port = wired(SimulatedDataq(unloaded(load_rig()), per_channel=per_channel))
    running = run(load_rig(overrides={'source': 'dataq', 'port': str(port.link)}))
    hello = running.acquisition.hello.info
    assert hello['firmware'].startswith('DATAQ DI-2108')
    assert hello['sample_rate_hz'] == pytest.approx(1000.0, rel=1e-3)
    chunks = running.take(400)
    assert [int(s) for c in chunks for s in c.raw.seq] == list(range(400))
    np.testing.assert_allclose(volts(chunks).mean(axis=0), [0, 0, 5, 0, 0, 5], atol=1e-3)
    counters = running.acquisition.counters
    assert (counters.lost, counters.bad) == (0, 0)
    assert 'lost whole scans are not' in running.acquisition.source.describe()['sample numbers']


class Held(SimulatedDataq):
    """The host is held up behind the 200th scan, in so many trials."""

    trials = 0

    def due_in_ns(self, since_power_up_ns: int) -> int:
        delay = super().due_in_ns(since_power_up_ns)
        if self._scanning and self._sent == 200 and delay > 0 and self.trials:
            self.trials -= 1
            return delay + 200_000_000
        return delay


@pytest.mark.parametrize('trials', [0, 1, 3])
def test_a_busy_host_measures_again(wired: Any, unloaded: Any, trials: int) -> None:
    device = Held(unloaded(load_rig()))
    device.trials = trials
    source = make_source(load_rig(overrides={'source': 'dataq', 'port': str(wired(device).link)}))
    source.open(2.0)
    assert device.trials == 0
    assert float(source.describe()['scan rate at start (1/s)']) == pytest.approx(1000.0, rel=0.1)


@pytest.mark.parametrize(
    ('of_device', 'hz', 'message'),
    [
        ({'power_up': PowerUp(skew_ppm=-3e5)}, 1000.0, r'does 7\d\d\.\d scans/s where 1000\.0 were set'),
        ({'model': '1100'}, 1000.0, '4 analog inputs and no counter'),
        ({'model': '718B'}, 1000.0, "model '718B'; known are 1100"),
        ({'model': '1110'}, 500.0, 'cannot do 500 scans/s'),
    ],
)
def test_a_device_that_will_not_do_is_named(
    wired: Any, unloaded: Any, of_device: dict[str, Any], hz: float, message: str
) -> None:
    rate = {'converter.sample_rate_hz': hz}
    port = wired(SimulatedDataq(unloaded(load_rig(overrides=rate)), **of_device))
    source = make_source(load_rig(overrides={'source': 'dataq', 'port': str(port.link), **rate}))
    with pytest.raises(DeviceError, match=message):
        source.open(2.0)


def test_a_silent_device_is_configured_again(wired: Any, run: Any, unloaded: Any) -> None:
    device = SimulatedDataq(unloaded(load_rig()))
    running = run(load_rig(overrides={'source': 'dataq', 'port': str(wired(device).link)}))
    running.take(40)
    # As a device that lost its supply and has forgotten everything, though its port stays.
    device._obey('stop', 0)
    running.heard('no scans come; waiting for it to come back')
    running.heard('the device is back')
    running.forget()
    running.take(40)


def test_the_simulated_one_says_what_it_is_and_nothing_by_itself(unloaded: Any) -> None:
    device = SimulatedDataq(unloaded(load_rig()))
    assert device.greeting() == device.take(10**9) == b''
    assert device.receive(b'info 0\rinfo', 0) == b'info 0 DATAQ\r\x00'
    assert device.receive(b' 1\r', 0) == b'info 1 2108\r\x00'
    assert device.receive(b'slist 0 10\rsrate 60000\rdec 1\rstart\r', 0).count(b'\r') == 3
    assert (device.take(2_000_000), device.receive(b'info 0\r', 0)) == (struct.pack('<3h', *[-32768] * 3), b'')
    assert device.receive(b'stop\r', 0) == b'stop\r\x00'
