# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""DATAQ converters: replies and scans written by hand, and the simulated device on a line of our own."""

import itertools
import re
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.devices import PowerUp
from psd_deflection.devices.dataq import SimulatedDataq
from psd_deflection.devices.protocol.dataq import (
    MODELS,
    VOLTS_PER_COUNT,
    ScanDecoder,
    command,
    find_reply,
    plan_rate,
    scan_list,
)
from psd_deflection.devices.protocol.frames import BadFrame
from psd_deflection.devices.registry import make_source
from psd_deflection.rig.config import load_rig

# x1 = 1, y1 = -2, sum1 = 16384, x2 = 256, y2 = -32767, sum2 = 16384, then the counter at zero.
SCAN = bytes.fromhex('0100 feff 0040 0001 0180 0040 0080')
COUNTS = (1, -2, 16384, 256, -32767, 16384)


def test_ten_volts_are_half_of_16_bits() -> None:
    assert VOLTS_PER_COUNT * 2**15 == 10.0


def test_commands_end_in_a_carriage_return() -> None:
    assert command('srate 60000') == b'srate 60000\r'
    assert scan_list(range(6)) == [
        'slist 0 0', 'slist 1 1', 'slist 2 2', 'slist 3 3', 'slist 4 4', 'slist 5 5', 'slist 6 10',
    ]  # fmt: skip


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
    assert find_reply(received, asked) == reply


@given(
    st.lists(
        st.binary(max_size=30) | st.sampled_from([b'info', b' 1', b'info 1', b' 2108', b'\r', b'\x00']), max_size=12
    )
)
def test_no_reply_is_made_up_and_the_one_that_follows_is_found(pieces: list[bytes]) -> None:
    received = b''.join(pieces)
    reply = find_reply(received, 'info 1')
    if reply is not None:
        assert re.search(rb'info 1( [^\r]*)?\s*\r', received.replace(b'\x00', b''))
    assert find_reply(received + b'\rinfo 1 2108\r', 'info 1') == '2108'


def fed(stream: bytes, cuts: list[int]) -> list[Any]:
    decoder = ScanDecoder()
    places = sorted({0, len(stream), *(c % (len(stream) + 1) for c in cuts)})
    return [item for a, b in itertools.pairwise(places) for item in decoder.feed(stream[a:b])]


@given(st.lists(st.integers(0, 10_000), max_size=20))
def test_scans_come_out_however_the_stream_was_cut(cuts: list[int]) -> None:
    assert fed(SCAN * 20, cuts) == [COUNTS] * 20


@given(st.integers(1, 13), st.lists(st.integers(0, 10_000), max_size=20))
def test_lost_bytes_are_observed_and_the_step_is_found_again(lost: int, cuts: list[int]) -> None:
    stream = SCAN * 5 + SCAN[lost:] + SCAN * 10
    got = fed(stream, cuts)
    assert got == fed(stream, [])
    assert [g for g in got if not isinstance(g, BadFrame)] == [COUNTS] * 15
    assert sum(g.size for g in got if isinstance(g, BadFrame)) == 14 - lost


@given(st.integers(1, 40), st.lists(st.integers(0, 10_000), max_size=20))
@example(14, [])
@example(15, [])
@example(28, [])
@example(29, [])
def test_bytes_between_scans_cost_no_scan(more: int, cuts: list[int]) -> None:
    """Also if they are as many as a scan has, as where a marker is damaged: four scans in all tell the step."""
    for following in (4 if more % 14 else 3, 10):
        got = fed(SCAN * 5 + b'\x11' * more + SCAN * following, cuts)
        assert [g for g in got if not isinstance(g, BadFrame)] == [COUNTS] * (5 + following)
        # By a scan's length at a time, and then what is left.
        full = (more - 1) // 14
        assert [g.size for g in got if isinstance(g, BadFrame)] == [14] * full + [more - 14 * full]


def test_two_readings_at_the_rail_are_no_marker() -> None:
    """The marker is the negative rail as well: three in a row in one place tell the step, two do not."""
    railed = bytes.fromhex('0100 0080') + SCAN[4:]
    # A byte is lost before the first of two scans whose y1 is at the rail.
    stream = SCAN * 3 + SCAN[1:] + railed * 2 + SCAN * 6
    got = fed(stream, [])
    assert [g.size for g in got if isinstance(g, BadFrame)] == [13]
    assert [g for g in got if not isinstance(g, BadFrame)] == [COUNTS] * 3 + [(1, -32768, *COUNTS[2:])] * 2 + [
        COUNTS
    ] * 6


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
    rate = plan_rate(hz, MODELS[model], per_channel)
    assert rate is not None
    assert (rate.srate, rate.dec) == (srate, dec)
    assert rate.hz == pytest.approx(60e6 / (srate * dec) / (7 if per_channel else 1))
    assert rate.hz == pytest.approx(hz, rel=1e-3)


def test_a_rate_that_the_model_cannot_do_has_no_setting() -> None:
    assert plan_rate(500.0, MODELS['1110'], False) is None
    assert plan_rate(1e6, MODELS['2108'], False) is None


def test_the_models_are_those_of_the_data_sheets() -> None:
    """Analog inputs, a counter, a decimating filter; the highest rate is 60 MHz over the least srate."""
    assert {name: (m.analog, m.counter, m.decimates, 60e6 / m.srate_min) for name, m in MODELS.items()} == {
        '1100': (4, False, False, 40_000.0),
        '1110': (8, True, False, 160_000.0),
        '1120': (4, True, False, 160_000.0),
        '2108': (8, True, True, 160_000.0),
        '4108': (8, True, True, 160_000.0),
    }


@pytest.mark.parametrize(
    ('model', 'hz', 'possible'),
    [
        ('2108', 160_000.0, True),
        ('2108', 161_000.0, False),
        ('1110', 60e6 / 65_535, True),
        ('1110', 60e6 / 65_537, False),
        ('2108', 60e6 / 65_537, True),
        ('2108', 60e6 / (65_535 * 512), True),
        ('2108', 60e6 / (65_535 * 512.01), False),
    ],
)
def test_srate_and_dec_have_the_limits_of_the_protocol(model: str, hz: float, possible: bool) -> None:
    """srate of 16 bits, dec to 512."""
    assert (plan_rate(hz, MODELS[model], False) is not None) == possible


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
        due = super().due_in_ns(since_power_up_ns)
        if self._scanning and self._sent == 200 and due > 0 and self.trials:
            self.trials -= 1
            return due + 200_000_000
        return due


@pytest.mark.parametrize('trials', [0, 1, 3])
def test_a_busy_host_measures_again(wired: Any, unloaded: Any, trials: int) -> None:
    device = Held(unloaded(load_rig()))
    device.trials = trials
    source = make_source(load_rig(overrides={'source': 'dataq', 'port': str(wired(device).link)}))
    source.open(2.0)
    assert device.trials == 0
    assert float(source.describe()['scan rate at start (1/s)']) == pytest.approx(1000.0, rel=0.1)


def test_another_rate_than_was_set_is_rejected(wired: Any, unloaded: Any) -> None:
    port = wired(SimulatedDataq(unloaded(load_rig()), PowerUp(skew_ppm=-3e5)))
    source = make_source(load_rig(overrides={'source': 'dataq', 'port': str(port.link)}))
    with pytest.raises(DeviceError, match=r'does 7\d\d\.\d scans/s where 1000\.0 were set'):
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


@pytest.mark.parametrize(
    ('model', 'message'), [('1100', '4 analog inputs and no counter'), ('718B', "model '718B'; known are 1100")]
)
def test_a_model_that_will_not_do_is_named(wired: Any, unloaded: Any, model: str, message: str) -> None:
    port = wired(SimulatedDataq(unloaded(load_rig()), model=model))
    source = make_source(load_rig(overrides={'source': 'dataq', 'port': str(port.link)}))
    with pytest.raises(DeviceError, match=message):
        source.open(2.0)


def test_a_rate_out_of_reach_is_named(wired: Any, unloaded: Any) -> None:
    rig = load_rig(overrides={'converter.sample_rate_hz': 500.0})
    port = wired(SimulatedDataq(unloaded(rig), model='1110'))
    source = make_source(
        load_rig(overrides={'source': 'dataq', 'port': str(port.link), 'converter.sample_rate_hz': 500.0})
    )
    with pytest.raises(DeviceError, match='cannot do 500 scans/s'):
        source.open(2.0)


def test_another_range_is_rejected() -> None:
    with pytest.raises(ConfigError, match=r'converter\.full_scale = 10'):
        make_source(load_rig(overrides={'source': 'dataq', 'port': 'x', 'converter.full_scale': 5.0}))


def test_the_simulated_one_says_what_it_is_and_nothing_by_itself(unloaded: Any) -> None:
    device = SimulatedDataq(unloaded(load_rig()))
    assert device.greeting() == device.take(10**9) == b''
    assert device.receive(b'info 0\rinfo', 0) == b'info 0 DATAQ\r\x00'
    assert device.receive(b' 1\r', 0) == b'info 1 2108\r\x00'
    assert device.receive(b'slist 0 10\rsrate 60000\rdec 1\rstart\r', 0).count(b'\r') == 3
    assert device.take(2_000_000) == struct.pack('<3h', *[-32768] * 3)
    assert device.receive(b'info 0\r', 0) == b''
    assert device.receive(b'stop\r', 0) == b'stop\r\x00'
