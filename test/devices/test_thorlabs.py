# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Thorlabs aligners: messages written by hand, and the simulated pair on lines of our own."""

import itertools
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.devices.protocol.apt import (
    INFO_REQUEST,
    READINGS_REQUEST,
    AptDecoder,
    HardwareInfo,
    QuadrantReadings,
    encode_info,
    encode_readings,
    readings_of,
)
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
    return (
        isinstance(reading, QuadrantReadings)
        and reading.x == pytest.approx(X, rel=1e-4)
        and reading.y == pytest.approx(Y, rel=1e-4)
        and reading.total == pytest.approx(5.0, rel=1e-4)
    )


def test_questions_and_answers_byte_by_byte() -> None:
    assert bytes.fromhex('710803005001') == READINGS_REQUEST
    assert bytes.fromhex('050000005001') == INFO_REQUEST
    (reading,) = AptDecoder().feed(REPLY)
    assert is_reply(reading)
    assert encode_readings(8191, -16384, 32768)[:14] == REPLY[:14]
    (info,) = AptDecoder().feed(encode_info(69251980, 'KPA101'))
    assert info == HardwareInfo(69251980, 'KPA101', '1.0.0')
    assert len(encode_info(1, 'TQD001')) == 90


def test_the_info_of_an_aligner_byte_by_byte() -> None:
    """Serial number, model, type 16, firmware 1.0.0 from its last number on, notes, version, state, channels."""
    body = bytes.fromhex('0df4 2004') + b'KPA101\0\0' + bytes.fromhex('1000 00000100')
    body += b'simulated'.ljust(60, b'\0') + bytes.fromhex('0100 0000 0100')
    assert encode_info(0x0420F40D, 'KPA101') == bytes.fromhex('0600 5400 81 50') + body
    assert encode_info(1, 'KPA101-LONG')[10:18] == b'KPA101-L'
    # What is not as long is none.
    short = bytes.fromhex('0600 5300 81 50') + body[:-1]
    assert AptDecoder().feed(short) == [BadFrame('length does not fit the message', 89)]


def test_ten_volts_are_the_whole_range() -> None:
    assert readings_of(32767, -32767, 65535) == pytest.approx((10.0, -10.0, 10.0), rel=1e-12)
    # Half of the light: the same difference is twice as far out.
    assert readings_of(16384, 0, 32768)[0] == pytest.approx(10.0 * (16384 / 32767) / (32768 / 65535), rel=1e-12)


def test_what_is_no_reading_is_passed_over() -> None:
    other = bytearray(REPLY)
    other[6] = 4
    assert [is_reply(m) for m in AptDecoder().feed(bytes(other) + REPLY)] == [True]


def test_what_is_thrown_away_is_counted() -> None:
    decoder = AptDecoder()
    # Three bytes begin no header; five are too few for one.
    assert decoder.feed(bytes(8)) == []
    assert decoder.reset() == 8
    assert decoder.feed(REPLY[:10]) == []
    assert decoder.reset() == 10
    assert [is_reply(m) for m in decoder.feed(REPLY)] == [True]


def test_without_light_no_place_is_made_up() -> None:
    assert readings_of(20000, -20000, 0) == QuadrantReadings(0.0, 0.0, 0.0)
    assert readings_of(3, -3, 300)[:2] == (0.0, 0.0)
    # 0.05 V are 327.7 counts.
    assert readings_of(3, -3, 327)[:2] == (0.0, 0.0)
    assert readings_of(3, -3, 328)[:2] == pytest.approx((300 / 32767 / 0.05005, -300 / 32767 / 0.05005), rel=1e-4)


STREAM = (
    b'\x01\x02\x03' + REPLY + b'\x81\x00\x02\x00\x01\x50' + REPLY + bytes.fromhex('7208 0200 81 50 0300') + REPLY * 2
)


@given(st.lists(st.integers(0, len(STREAM)), max_size=30))
def test_messages_come_out_however_the_stream_was_cut(cuts: list[int]) -> None:
    decoder = AptDecoder()
    places = sorted({0, len(STREAM), *cuts})
    got = [m for a, b in itertools.pairwise(places) for m in decoder.feed(STREAM[a:b])]
    assert [type(m) for m in got] == [
        *(BadFrame, QuadrantReadings, QuadrantReadings, BadFrame, QuadrantReadings, QuadrantReadings),
    ]
    assert all(is_reply(m) for m in got if isinstance(m, QuadrantReadings))
    assert got[0] == BadFrame('no APT header', 3)
    assert got[3] == BadFrame('length does not fit the message', 8)


@given(st.lists(st.binary(max_size=100), max_size=10))
def test_garbage_raises_nothing_and_is_not_kept(pieces: list[bytes]) -> None:
    decoder = AptDecoder()
    for piece in pieces:
        decoder.feed(piece)
    decoder.reset()
    assert decoder.reset() == 0


@pytest.mark.parametrize('port', ['', '/dev/ttyUSB0', 'a,b,c', 'a,', 'a,a'])
def test_two_ports_are_needed(port: str) -> None:
    with pytest.raises(ConfigError, match='two ports are needed'):
        make_source(load_rig(overrides={'source': 'thorlabs', 'port': port}))


def test_a_sign_is_a_sign() -> None:
    with pytest.raises(ConfigError, match='must be 1 or -1'):
        make_source(load_rig(overrides={'source': 'thorlabs', 'port': 'a,b', 'thorlabs.x_sign': 0.5}))


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
    later = [int(s) for c in running.take(10) for s in c.raw.seq]
    assert min(later) > last
    counters = running.acquisition.counters
    assert counters.disconnects == 1
    assert counters.lost > 0
    assert counters.restarts == 0


def test_a_port_where_nothing_answers_is_named(wired: Any, unloaded: Any) -> None:
    shared = SharedRig(unloaded(load_rig()))
    good = wired(SimulatedAligner(shared, 1))
    mute = wired(SimulatedAligner(shared, 2, answer_ns=10**12))
    rig = load_rig(overrides={**SLOW, 'port': f'{good.link},{mute.link}'})
    with pytest.raises(DeviceError, match=r'port_1: nothing in 0\.3 s; is it a KPA101'):
        make_source(rig).open(0.3)


def test_an_answer_that_does_not_come_is_counted(pair: Any) -> None:
    _, _, rig = pair()
    source = make_source(rig)
    source.open(2.0)
    source.start()
    source._ports[1].write = lambda _: None  # type: ignore[attr-defined]
    reading = source.read(0.1)
    source.close()
    assert reading.events == [BadFrame('no answer in time', 0)]


def test_port_lost_during_read_raises_port_closed(pair: Any) -> None:
    first, _, rig = pair()
    source = make_source(rig)
    source.open(2.0)
    source.start()
    first.unplug()
    with pytest.raises(PortClosedError):
        source.read(0.1)
    source.close()


@pytest.mark.parametrize(('size', 'fits'), [(255, True), (256, False)])
def test_a_message_has_255_bytes_at_most(size: int, fits: bool) -> None:
    """One that is of no interest is passed over; what is longer is none."""
    other = struct.pack('<HHBB', 0x1234, size, 0x81, 0x50) + bytes(size)
    got = AptDecoder().feed(other + REPLY)
    assert is_reply(got[-1])
    assert got[:-1] == ([] if fits else [BadFrame('no APT header', len(other))])
