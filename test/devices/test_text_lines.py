# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Lines of text: written by hand, and the simulated device on a pseudo-terminal."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices import LineDevice, PowerUp
from psd_deflection.devices.dataq import SimulatedDataq
from psd_deflection.devices.protocol.frames import BadFrame
from psd_deflection.devices.protocol.text_lines import Description, Line, LineDecoder, TimeExtender, parse, with_check
from psd_deflection.devices.registry import make_source
from psd_deflection.devices.rig_feed import RigFeed
from psd_deflection.devices.source import Sample
from psd_deflection.devices.text_lines import SimulatedLines
from psd_deflection.records import FLAG_OVER_RANGE, channel_names
from psd_deflection.rig.config import load_rig

VALUES = (0.1, -0.2, 5.0, 0.0, 1.5, 4.75)
LINE = Line(7, 7000, VALUES)


@pytest.mark.parametrize(
    ('text', 'item'),
    [
        (b'7,7000,0.1,-0.2,5,0,1.5,4.75', LINE),
        (b'7,7000,.1,-0.2,5.0,+0,1.5,4.75\r', LINE),
        (b' 7, 7000, 0.1, -0.2, 5, 0, 1.5, 4.75 ', LINE),
        (b'', None),
        (b'\r', None),
        (b'# {"sample_rate_hz": 200}', Description({'sample_rate_hz': 200})),
        (b'# a remark', BadFrame('comment without a description', 10)),
        (b'#[1]', BadFrame('comment without a description', 4)),
        (b'7,7000,0.1,-0.2,5,0,1.5', BadFrame('no number of fields that a sample has', 23)),
        (b'7,7000,0.1,-0.2,5,0,1.5,x', BadFrame('a reading is no number', 25)),
        (b'7,7000,0.1,-0.2,5,0,1.5,nan', BadFrame('a reading is no number', 27)),
        (b'7,7000,0.1,-0.2,5,0,1.5,1e9', BadFrame('a reading is no number', 27)),
        (b'-7,7000,0,0,5,0,0,5', Line(2**32 - 7, 7000, (0, 0, 5, 0, 0, 5))),
        (b'7,-2147483648,0,0,5,0,0,5', Line(7, 2**31, (0, 0, 5, 0, 0, 5))),
        (b'7,-2147483649,0,0,5,0,0,5', BadFrame('seq or t_us is over 32 bits', 25)),
        (b'7,7e3,0,0,5,0,0,5', BadFrame('seq or t_us is no whole number', 17)),
        (b'4294967296,7,0,0,5,0,0,5', BadFrame('seq or t_us is over 32 bits', 24)),
        (b'4294967295,4294967295,0,0,5,0,0,5', Line(2**32 - 1, 2**32 - 1, (0, 0, 5, 0, 0, 5))),
        (b'#{"serial": "a*b"}', Description({'serial': 'a*b'})),
        (b'7,4294967296,0,0,5,0,0,5', BadFrame('seq or t_us is over 32 bits', 24)),
        (b'1,1,0,0,5,0,0,5*00', BadFrame('check differs', 18)),
        (b'1,1,0,0,5,0,0,5*zz', BadFrame('check differs', 18)),
    ],
)
def test_one_line(text: bytes, item: object) -> None:
    assert parse(text) == item


def test_the_check_is_the_exclusive_or() -> None:
    # By hand: 31 ^ 2c ^ 31 ^ 2c ^ 30 = 30, hexadecimal.
    assert with_check('1,1,0') == b'1,1,0*30\n'
    line = with_check('7,7000,0.1,-0.2,5,0,1.5,4.75')
    assert parse(line[:-1]) == LINE
    flipped = line.replace(b'0.1', b'0.3')
    assert parse(flipped[:-1]) == BadFrame('check differs', len(flipped) - 1)


STREAM = b'tail\n7,7000,0.1,-0.2,5,0,1.5,4.75\r\n\n#{"a":1}\nrubbish\n' + b'x' * 1000 + b'\n1,2,0,0,5,0,0,5\n9,'
ITEMS = [
    LINE,
    Description({'a': 1}),
    BadFrame('no number of fields that a sample has', 7),
    BadFrame('longer than a line', 1000),
    Line(1, 2, (0, 0, 5, 0, 0, 5)),
]


@given(st.lists(st.integers(0, len(STREAM)), max_size=30))
def test_lines_come_out_however_the_stream_was_cut(cuts: list[int]) -> None:
    decoder = LineDecoder()
    places = sorted({0, len(STREAM), *cuts})
    assert [i for a, b in itertools.pairwise(places) for i in decoder.feed(STREAM[a:b])] == ITEMS
    # One that comes first is whole, too.
    assert LineDecoder().feed(b'7,7000,0.1,-0.2,5,0,1.5,4.75\n') == [LINE]


@pytest.mark.parametrize('cut', [0, 200, 399, 400, 401])
def test_a_line_has_400_bytes_at_most(cut: int) -> None:
    for size in (400, 401):
        line = b'7,7000,0.1,-0.2,5,0,1.5,4.75'.ljust(size) + b'\n'
        decoder = LineDecoder()
        decoder.feed(b'\n')
        decoded = decoder.feed(line[:cut]) + decoder.feed(line[cut:])
        assert decoded == ([LINE] if size == 400 else [BadFrame('longer than a line', 401)])


ALMOST = st.text('0123456789,.-+*#{} \r\n', max_size=60).map(str.encode)
FIELDS = st.lists(st.sampled_from(['7', '-2', '.5', '1e3', 'x', '']), min_size=6, max_size=10)


@given(st.lists(st.binary(max_size=100) | ALMOST | FIELDS.map(lambda f: f'\n{",".join(f)}\n'.encode()), max_size=10))
@example([b'\n3,4,1,2,3,4,5,6\n'])
@example([b'0,-1,0,0,0,0,0,0\n'])
@example([b'\n3,4,1,2,3,4,5\n', b'\n3,4,1,2,3,4,5,6,7\n'])
def test_garbage_gives_no_sample_and_reading_continues(pieces: list[bytes]) -> None:
    decoder = LineDecoder()
    lines = [i for piece in pieces for i in decoder.feed(piece) if isinstance(i, Line)]
    # What stands between two newlines as eight numbers, read by another hand; * and # are the decoder's own affair.
    written = []
    for text in b''.join(pieces).split(b'\n')[:-1]:
        try:
            fields = [float(field) for field in text.partition(b'*')[0].split(b',')]
        except ValueError:
            continue
        # Six to eighteen readings, or eight to twenty-four electrodes, of two to six PSDs.
        if len(fields) - 2 in {6, 8, 9, 12, 15, 16, 18, 20, 24}:
            number, t_us = map(int, fields[:2])
            written.append((number % 2**32, t_us % 2**32, tuple(fields[2:])))
    at = iter(written)
    assert all(any(line == other for other in at) for line in lines)
    assert decoder.feed(b'\n7,7000,0.1,-0.2,5,0,1.5,4.75\n')[-1] == LINE


@pytest.mark.foreign
def test_micros_wraps_and_restarts_with_the_device() -> None:
    extender = TimeExtender()
    lines = [(100, 2**32 - 1000), (101, 2**32), (102, 2**32 + 1000), (0, 500), (1, 1500)]
    assert [extender.extend(Line(s, t % 2**32, VALUES)) for s, t in lines] == [t for _, t in lines]


def test_micros_going_back_at_same_number_is_a_restart() -> None:
    """As far back as a wrap: but a device that counts its samples does not count one for 71 minutes."""
    extender = TimeExtender()
    assert [extender.extend(Line(7, t, VALUES)) for t in (2**32 - 5, 3)] == [2**32 - 5, 3]


@pytest.mark.parametrize(
    ('ahead', 'earlier_us', 'wraps'),
    [
        # A line of the next number, or of a later one less than half way round; the clock goes back more than half way.
        (1, 2**31 + 1, 1),
        (2**31 - 1, 2**31 + 1, 1),
        (2**31, 2**31 + 1, 0),
        # Less is no wrap.
        (1, 2**31, 0),
    ],
)
def test_what_a_clock_that_goes_back_means(ahead: int, earlier_us: int, wraps: int) -> None:
    extender = TimeExtender()
    now = 3_000_000_000
    extender.extend(Line(1000, now, VALUES))
    assert extender.extend(Line(1000 + ahead, now - earlier_us, VALUES)) == wraps * 2**32 + now - earlier_us


def test_the_same_line_again_is_of_the_same_time() -> None:
    extender = TimeExtender()
    lines = [(5, 2**32 - 5), (6, 3), (6, 3), (7, 1003)]
    assert [extender.extend(Line(s, t, VALUES)) - 2**32 for s, t in lines] == [-5, 3, 3, 1003]


@pytest.mark.parametrize(
    ('lag', 'earlier_us', 'again'), [(63, 1000, True), (64, 1000, False), (10, 2**31 - 1, True), (10, 2**31, False)]
)
def test_a_line_that_comes_again_does_not_turn_back_the_clock(lag: int, earlier_us: int, again: bool) -> None:
    """Less than 64 numbers and half a turn of the clock back; else the device has started again."""
    extender = TimeExtender()
    now = 3_000_000_000
    for seq, t_us in ((998, 2**32 - 1000), (999, 500), (1000, now)):
        extender.extend(Line(seq, t_us, VALUES))
    wrap = 2**32 if again else 0
    assert extender.extend(Line(1000 - lag, now - earlier_us, VALUES)) == wrap + now - earlier_us
    assert extender.extend(Line(1001, now + 1, VALUES)) == wrap + now + 1


@pytest.mark.parametrize(('seq', 'again'), [(64, False), (65, True)])
def test_first_numbers_after_restart_are_not_old_lines(seq: int, again: bool) -> None:
    extender = TimeExtender()
    for s, t in ((69, 2**32 - 1000), (70, 2**32 + 9000)):
        extender.extend(Line(s, t % 2**32, VALUES))
    assert (extender.extend(Line(seq, 5000, VALUES)) == 2**32 + 5000) == again


def test_it_reads_the_rig(wired: Any, run: Any, unloaded: Any, volts: Any) -> None:
    port = wired(SimulatedLines(unloaded(load_rig()), PowerUp(first_seq=2**32 - 200)))
    running = run(load_rig(overrides={'source': 'lines', 'port': str(port.link)}))
    chunks = running.take(400)
    numbers = [int(s) for c in chunks for s in c.raw.seq]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    np.testing.assert_allclose(volts(chunks).mean(axis=0), [0, 0, 5, 0, 0, 5], atol=1e-3)
    times = np.concatenate([c.raw.t_ns for c in chunks])
    assert (np.diff(times) > 0).all()
    counters = running.acquisition.counters
    assert (counters.lost, counters.bad, counters.restarts) == (0, 0, 0)


@pytest.mark.parametrize(('source', 'made'), [('lines', SimulatedLines), ('dataq', SimulatedDataq)])
def test_an_unplugged_device_is_asked_and_read_again(
    wired: Any, run: Any, unloaded: Any, source: str, made: Callable[[RigFeed], LineDevice]
) -> None:
    port = wired(made(unloaded(load_rig())))
    running = run(load_rig(overrides={'source': source, 'port': str(port.link)}))
    running.take(40)
    port.unplug()
    running.heard('waiting for it to come back')
    port.plug(made(unloaded(load_rig())))
    running.heard('the device is back')
    running.forget()
    running.take(40)
    assert running.acquisition.counters.disconnects == 1


class Sends:
    """Sends the same bytes whenever its port is opened, and nothing else."""

    def __init__(self, text: bytes) -> None:
        self.text = text

    def greeting(self) -> bytes:
        return self.text

    def due_in_ns(self, since_power_up_ns: int) -> int:
        return 10_000_000

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        return b''

    def take(self, since_power_up_ns: int, room: int = 4096) -> bytes:
        return b''


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (b'', 'nothing comes'),
        (b'\nhello\n', '7 bytes but no line of ours; is the baud rate'),
        (b'\n1,2,0,0,5,0,0,5\n', 'no line that describes them'),
    ],
)
def test_another_device_is_rejected_by_name(wired: Any, text: bytes, message: str) -> None:
    port = wired(Sends(text))
    with pytest.raises(DeviceError, match=message):
        make_source(load_rig(overrides={'source': 'lines', 'port': str(port.link)})).open(2.0)


def sent(wired: Any, info: bytes, line: bytes, **more: Any) -> Any:
    """What the source makes of a line."""
    device = Sends(b'\n#{"sample_rate_hz": 1000, %s}\n' % info)
    device.take = lambda since_power_up_ns, room=4096: line + b'\n'  # type: ignore[method-assign]
    source = make_source(load_rig(overrides={'source': 'lines', 'port': str(wired(device).link), **more}))
    hello = source.open(2.0)
    source.start()
    events = [event for _ in range(10) for event in source.read(1.0).events]
    source.close()
    return hello, events[0]


def test_counts_of_24_bits(wired: Any) -> None:
    info = b'"volts_per_count": %r' % (10.0 / 2**23)
    _, event = sent(wired, info, b'1,1000,8388607,-8388608,4000000,0,1,5', **{'converter.bits': 24})
    assert event == Sample(FLAG_OVER_RANGE, 1, 1000, (8388607, -8388608, 4000000, 0, 1, 5))


ELECTRODES = b'1,1000,3,1,2,2,1,3,1,1'


@pytest.mark.parametrize(
    ('info', 'line', 'reason'),
    [
        (b'"volts_per_count": 0.001', b'1,1000,0,0,40000,0,0,5', 'counts are whole numbers of 16 bits'),
        (b'"volts_per_count": 0.001', b'1,1000,0,0,0.5,0,0,5', 'counts are whole numbers of 16 bits'),
        (b'"serial": "a"', b'1,1000,0,0,123456,0,0,5', 'a reading is out of all bounds'),
        (b'"serial": "a"', ELECTRODES, '8 readings where the description says 6'),
        (b'"electrodes": true', b'1,1000,0,0,5,0,0,5', '6 readings where the description says 8'),
    ],
)
def test_readings_that_do_not_fit_are_no_samples(wired: Any, info: bytes, line: bytes, reason: str) -> None:
    _, event = sent(wired, info, line)
    assert isinstance(event, BadFrame)
    assert event.reason == reason


def test_a_thousand_volts_are_the_most(wired: Any) -> None:
    for line, reading in ((b'1,1000,0,0,1000,0,-1000,5', 1000.0), (b'1,1000,0,0,1000.1,0,0,5', None)):
        _, event = sent(wired, b'"serial": "a"', line)
        assert (event.readings[2] if isinstance(event, Sample) else None) == reading


def test_electrodes_become_the_readings_of_a_divider(wired: Any) -> None:
    hello, event = sent(wired, b'"electrodes": true', ELECTRODES)
    # Half of 5 mm at 0.5 mm/V.
    assert event == Sample(0, 1, 1000, (5.0, 0.0, 4.0, -5.0, 0.0, 3.0))
    assert hello.info['volts_per_count'] is None


def test_electrode_counts_are_scaled_with_over_range(wired: Any) -> None:
    scale = 10.0 / 2**15
    info = b'"electrodes": true, "volts_per_count": %r' % scale
    _, event = sent(wired, info, b'1,1000,32767,0,100,100,100,300,200,200')
    assert event.flags == FLAG_OVER_RANGE
    np.testing.assert_allclose(event[3], [10.0, 0.0, 32967 / 2 * scale, -5.0, 0.0, 400 * scale])


def test_three_psds(wired: Any, run: Any, unloaded: Any, volts: Any) -> None:
    more = {'psd_3.center': [0.08, 0.0]}
    port = wired(SimulatedLines(unloaded(load_rig(overrides=more))))
    running = run(load_rig(overrides={'source': 'lines', 'port': str(port.link), **more}))
    np.testing.assert_allclose(volts(running.take(100)).mean(axis=0), [0, 0, 5] * 3, atol=1e-2)
    assert running.acquisition.counters.bad == 0


@pytest.mark.parametrize(
    ('info', 'line', 'result'),
    [
        (b'"psds": 3', b'1,1000,0,0,5,0,0,5,0,1,5', (0, 0, 5, 0, 0, 5, 0, 1, 5)),
        (b'"psds": 3', b'1,1000,0,0,5,0,0,5', '6 readings where the description says 9'),
        (b'"psds": 3, "electrodes": true', b'1,1000' + b',1,1,1,1' * 3, (0, 0, 2, 0, 0, 2, 0, 0, 2)),
        (b'"psds": 3', b'1,1000,0,0,5,0,0,5,0', 'no number of fields that a sample has'),
    ],
)
def test_a_line_of_three_psds(wired: Any, info: bytes, line: bytes, result: object) -> None:
    hello, event = sent(wired, info, line, **{'psd_3.center': [0.08, 0.0]})
    assert (hello.info['psds'], hello.info['channels']) == (3, list(channel_names(3)))
    assert (event.reason if isinstance(event, BadFrame) else event.readings) == result


@given(st.integers(1, 60), st.floats(-900.0, 900.0))
def test_a_line_has_readings_or_electrodes_of_two_to_six_psds(count: int, value: float) -> None:
    item = parse(with_check('7,7000,' + ','.join([f'{value:.4f}'] * count)).strip())
    if count in {6, 8, 9, 12, 15, 16, 18, 20, 24}:
        assert isinstance(item, Line)
        assert len(item.readings) == count
    else:
        assert isinstance(item, BadFrame)
