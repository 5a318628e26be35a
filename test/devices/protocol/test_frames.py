# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The frames of docs/protocol.md, whose bytes were written down, not encoded by us; COBS, beside the package cobs."""

import itertools
import json
import math
import zlib
from typing import Any

import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.base.text import sanitize
from psd_deflection.devices.protocol.frames import (
    MAX_ENCODED,
    BadFrame,
    BadReason,
    Frame,
    FrameDecoder,
    GoodFrame,
    HelloFrame,
    HelloRequestFrame,
    PingFrame,
    PongFrame,
    SampleFrame,
    StartFrame,
    StatusFrame,
    StopFrame,
    cobs_decode,
    cobs_encode,
    encode,
)
from psd_deflection.devices.protocol.text_lines import Description, parse, positive
from psd_deflection.devices.protocol.words import MAX_TEXT, device_words, finite
from psd_deflection.records import MOST_PSDS

SAMPLE = SampleFrame(0, 1, 1000, (1, -1, 16384, 0, 0, 16384))
SAMPLE_BYTES = bytes.fromhex('020102010101 03e803 01010101 01 0201 03ffff 0240 01010101 0640713ed6b200')
WIDE = 'a wide sample'
GOOD: list[tuple[str, str, GoodFrame]] = [
    ('a sample', SAMPLE_BYTES.hex(), SAMPLE),
    (
        'a sample with both flags, the last seq and the rails',
        '0e 01 03 ff ff ff ff 08 07 06 05 04 03 02 03 ff 7f 02 80 01 02 01 02 02 02 03 05 78 eb d9 5f 00',
        SampleFrame(3, 0xFFFFFFFF, 566265752454920, (32767, -32768, 0, 1, 2, 3)),
    ),
    (
        WIDE,
        '02 03 02 01 01 01 03 e8 03 01 01 01 01 01 04 ff ff 7f 05 ff ff ff ff 01 02 40 01 02 01 01 01 01 03 80 ff 01 02'
        '40 05 12 9f 49 04 00',
        SampleFrame(0, 1, 1000, (8388607, -1, 4194304, 256, -8388608, 4194304)),
    ),
    ('status', '0302070101076608fcba8a2a00', StatusFrame(7, 2150)),
    ('status without a thermometer', '020201010107ff7f885f6d5900', StatusFrame(0, None)),
    ('hello', '1510017b2273657269616c223a2241227d5c9afeb600', HelloFrame(1, {'serial': 'A'})),
    ('hello of another version', '0310020601 7b6cde0500', HelloFrame(2, {})),
    ('hello?', '06117fcfb2b800', HelloRequestFrame()),
    ('ping', '03120101010101010105c77e95a800', PingFrame(1)),
    ('pong', '03 1301010101010101 0202010101010101 05a8a5696100', PongFrame(1, 2)),
    ('start', '0614f03bd8c800', StartFrame()),
    ('stop', '0615660bdfbf00', StopFrame()),
]


def sealed(body: bytes) -> str:
    """The bytes of a frame with this type and body, hexadecimal."""
    encoded: bytes = cobs.encode(body + zlib.crc32(body).to_bytes(4, 'little'))
    return encoded.hex() + '00'


BAD: list[tuple[str, str, BadReason]] = [
    ('unknown type', '087f010212a6f95700', BadReason.UNKNOWN_TYPE),
    ('sample with too few bytes, CRC right', '02010601b383848900', BadReason.LENGTH),
    ('start with a byte too many, CRC right', '0714090e7dab1600', BadReason.LENGTH),
    ('hello whose JSON is cut', '1110017b2273657269616c223a6e519d9e00', BadReason.BODY),
    ('hello that is a list', '0910015b5d624b0a3c00', BadReason.BODY),
    (
        'sample at a time that no clock has reached',
        '02 01 02 01 01 01 01 01 01 01 01 01 01 02 10 01 01 01 01 01 01 01 01 01 01 01 05 58 db d3 7d 00',
        BadReason.BODY,
    ),
    ('start with a wrong CRC', '0614f03bd8c900', BadReason.CRC),
    ('too short for a CRC', '0314f000', BadReason.TOO_SHORT),
    ('a CRC of nothing', '0101010100', BadReason.TOO_SHORT),
    ('hello without a version, CRC right', sealed(b'\x10'), BadReason.LENGTH),
    ('ping with too few bytes, CRC right', sealed(b'\x12' + bytes(7)), BadReason.LENGTH),
    ('pong with a byte too many, CRC right', sealed(b'\x13' + bytes(17)), BadReason.LENGTH),
    ('status with a byte too many, CRC right', sealed(b'\x02' + bytes(7)), BadReason.LENGTH),
    ('not COBS: the code points past the end', '0901020300', BadReason.COBS),
    ('longer than a frame can be', '01' * (MAX_ENCODED + 1) + '00', BadReason.TOO_LONG),
]


def decode(stream: bytes) -> list[Frame]:
    """As a receiver that is in step."""
    return FrameDecoder().feed(b'\x00' + stream)


@pytest.mark.parametrize(('label', 'encoded', 'frame'), GOOD, ids=[c[0] for c in GOOD])
def test_a_frame_and_its_bytes(label: str, encoded: str, frame: GoodFrame) -> None:
    received = bytes.fromhex(encoded)
    assert decode(received) == [frame]
    if not (isinstance(frame, HelloFrame) and frame.version != 1):
        assert encode(frame, wide=label == WIDE) == received


def test_sample_counts_default_to_16_bits() -> None:
    assert encode(SAMPLE) == encode(SAMPLE, wide=False)
    assert len(encode(SAMPLE, wide=True)) == len(encode(SAMPLE)) + 2 * len(SAMPLE.counts)


@pytest.mark.parametrize(('label', 'encoded', 'reason'), BAD, ids=[c[0] for c in BAD])
def test_bytes_that_are_no_frame(label: str, encoded: str, reason: BadReason) -> None:
    received = bytes.fromhex(encoded)
    assert decode(received + SAMPLE_BYTES) == [BadFrame(reason, len(received) - 1), SAMPLE]


@pytest.mark.parametrize('wide', [False, True])
def test_a_device_time_of_285_years_is_the_latest(wide: bool) -> None:
    latest = SAMPLE._replace(t_device_us=2**53)
    assert decode(encode(latest, wide=wide)) == [latest]
    (bad,) = decode(encode(SAMPLE._replace(t_device_us=2**53 + 1), wide=wide))
    assert isinstance(bad, BadFrame)
    assert bad.reason == BadReason.BODY


def test_overlong_frame_has_same_length_for_any_cut() -> None:
    for cuts in ((600,), (512, 600), (513, 600), (100, 513, 514, 600)):
        decoder = FrameDecoder()
        decoder.feed(b'\x00')
        for a, b in itertools.pairwise((0, *cuts)):
            assert decoder.feed(b'\x01' * (b - a)) == []
        assert decoder.feed(b'\x00' + SAMPLE_BYTES) == [BadFrame(BadReason.TOO_LONG, 600), SAMPLE]


def test_tail_of_partial_first_frame_is_skipped_a_whole_one_not() -> None:
    assert decode(b'\x00\x00' + SAMPLE_BYTES + b'\x00') == [SAMPLE]
    for cut in range(1, len(SAMPLE_BYTES)):
        assert FrameDecoder().feed(SAMPLE_BYTES[cut:] + SAMPLE_BYTES) == [SAMPLE]
    assert FrameDecoder().feed(SAMPLE_BYTES) == [SAMPLE]


def test_a_field_that_does_not_fit_is_rejected() -> None:
    with pytest.raises(ValueError, match='SampleFrame'):
        encode(SAMPLE._replace(seq=1 << 32))


def test_a_hello_of_512_bytes_encoded_is_sent_and_received() -> None:
    # Type, version, {"serial":""} and CRC are 19 bytes. COBS adds one, and one after each 254: 19 + 490 + 3 = 512.
    for size in (491, 600):
        with pytest.raises(ValueError, match=rf'{size + 22} bytes encoded, at most 512'):
            encode(HelloFrame(1, {'serial': 'x' * size}))
    sent = encode(HelloFrame(1, {'serial': 'x' * 490}))
    decoder = FrameDecoder()
    assert decoder.feed(b'\x00' + sent[:-1]) == []
    (received,) = decoder.feed(sent[-1:])
    assert isinstance(received, HelloFrame)
    assert len(sent) == MAX_ENCODED + 1
    assert isinstance(decode(sent)[0], HelloFrame)


HEADS = (st.integers(0, 255), st.integers(0, 2**32 - 1), st.integers(0, 2**53))
samples = st.builds(SampleFrame, *HEADS, st.tuples(*[st.integers(-32768, 32767)] * 6))
WORDS = st.text(st.characters(categories=['L', 'N']), max_size=8)
frames = st.one_of(
    samples,
    st.builds(StatusFrame, st.integers(0, 2**32 - 1), st.none() | st.integers(-32768, 32766)),
    st.builds(HelloFrame, st.just(1), st.dictionaries(WORDS, st.integers(-(2**53), 2**53), max_size=4)),
    st.builds(PongFrame, st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1)),
)
streams = st.lists(frames.map(encode) | st.binary(max_size=40), max_size=12).map(b''.join)


@given(frames)
def test_what_is_encoded_is_decoded(frame: GoodFrame) -> None:
    assert decode(encode(frame)) == [frame]


@pytest.mark.slow
@given(streams, st.lists(st.integers(0, 2000), max_size=20))
def test_any_split_of_the_stream_gives_the_same_frames(stream: bytes, cuts: list[int]) -> None:
    full = FrameDecoder().feed(stream)
    bounds = [0, *sorted(min(c, len(stream)) for c in cuts), len(stream)]
    for places in (bounds, range(len(stream) + 1)):
        decoder = FrameDecoder()
        assert [f for a, b in itertools.pairwise(places) for f in decoder.feed(stream[a:b])] == full


@given(st.binary(max_size=3000))
def test_random_bytes_never_raise_and_never_grow(stream: bytes) -> None:
    decoder = FrameDecoder()
    decoder.feed(stream)
    assert len(decoder._rest) <= MAX_ENCODED


@given(samples, st.data())
def test_one_flipped_bit_never_yields_a_sample(sample: SampleFrame, data: st.DataObject) -> None:
    encoded = bytearray(encode(sample))
    bit = data.draw(st.integers(0, 8 * len(encoded) - 1))
    encoded[bit // 8] ^= 1 << (bit % 8)
    assert not any(isinstance(f, SampleFrame) for f in decode(bytes(encoded) + b'\x00'))


def test_every_single_flipped_bit_of_one_sample_is_noticed() -> None:
    for bit in range(8 * len(SAMPLE_BYTES)):
        encoded = bytearray(SAMPLE_BYTES)
        encoded[bit // 8] ^= 1 << (bit % 8)
        assert not any(isinstance(f, SampleFrame) for f in decode(bytes(encoded) + b'\x00')), bit


@st.composite
def samples_of_some(draw: st.DrawFn) -> tuple[SampleFrame, bool]:
    """A sample of any number of PSDs, and whether it goes as a wide one."""
    wide = draw(st.booleans())
    most = (1 << 31 if wide else 1 << 15) - 1
    count = 3 * draw(st.integers(2, MOST_PSDS))
    counts = draw(st.lists(st.integers(-most - 1, most), min_size=count, max_size=count))
    flags, seq, t_us = draw(st.integers(0, 255)), draw(st.integers(0, 2**32 - 1)), draw(st.integers(0, 2**53))
    return SampleFrame(flags, seq, t_us, tuple(counts)), wide


@pytest.mark.slow
@given(samples_of_some(), st.integers(2, MOST_PSDS))
def test_sample_decodes_for_its_number_of_psds_only(sample: tuple[SampleFrame, bool], psds: int) -> None:
    frame, wide = sample
    stream = b'\x00' + encode(frame, wide=wide)
    assert len(stream) - 2 <= MAX_ENCODED
    (decoded,) = FrameDecoder(psds).feed(stream)
    if 3 * psds == len(frame.counts):
        assert decoded == frame
    else:
        assert isinstance(decoded, BadFrame)
        assert decoded.reason == BadReason.LENGTH


@pytest.mark.parametrize('count', [0, 3, 5, 7, 3 * MOST_PSDS + 3])
def test_counts_that_are_not_three_of_each_psd_cannot_be_sent(count: int) -> None:
    with pytest.raises(ValueError, match=r'counts|expected'):
        encode(SampleFrame(0, 0, 0, (0,) * count))


@given(st.binary(max_size=200), st.integers(2, MOST_PSDS))
def test_decoded_sample_has_expected_number_of_psds(junk: bytes, psds: int) -> None:
    stream = b'\x00' + bytes.fromhex(sealed(b'\1' + junk)) + junk + b'\x00'
    for frame in FrameDecoder(psds).feed(stream):
        assert isinstance(frame, BadFrame) or (isinstance(frame, SampleFrame) and len(frame.counts) == 3 * psds)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters()),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(st.characters()), inner, max_size=4),
    max_leaves=12,
)


def texts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value]
    if isinstance(value, dict):
        return [*value, *(t for v in value.values() for t in texts(v))]
    return [t for v in value for t in texts(v)] if isinstance(value, list) else []


@pytest.mark.parametrize(
    ('text', 'shown'),
    [
        ('SIM-0001', 'SIM-0001'),
        ('Rig Ä, 5 µm', 'Rig Ä, 5 µm'),
        ('\ud800', '\\ud800'),
        ('\x1b[31mred\x07', '\\x1b[31mred\\x07'),
        ('a\nstate complete', 'a\\nstate complete'),
        ('\u202eabc', '\\u202eabc'),
        ('x' * 50, 'x' * 19 + '…'),
        ('\x1b' * 50, '\\x1b' * 4 + '…'),
    ],
)
def test_a_text_in_one_printable_line(text: str, shown: str) -> None:
    assert sanitize(text, 20) == shown


@given(st.text(st.characters()), st.integers(1, 40))
def test_printable_is_printable_bounded_and_stays(text: str, longest: int) -> None:
    shown = sanitize(text, longest)
    assert shown.isprintable()
    assert len(shown) <= longest
    assert sanitize(shown, longest) == shown


@pytest.mark.slow
@given(st.dictionaries(st.text(st.characters()), JSON, max_size=6))
def test_any_words_become_harmless_and_stay(info: dict[str, Any]) -> None:
    words = device_words(info)
    assert all(t.isprintable() and len(t) <= MAX_TEXT for t in texts(words))
    json.dumps(words, allow_nan=False, ensure_ascii=False).encode()
    assert device_words(words) == words


@pytest.mark.parametrize('value', [10**309, math.nan, math.inf, True, '1', None, [1]])
def test_what_is_no_finite_number(value: object) -> None:
    assert finite(value) is None
    assert positive(value) is None


@pytest.mark.slow
@given(JSON)
def test_a_hello_and_a_line_of_any_json_are_harmless(value: Any) -> None:
    text = json.dumps({'serial': value})
    try:
        frames = FrameDecoder().feed(b'\x00' + encode(HelloFrame(1, {'serial': value})))
    except ValueError:
        frames = []
    described = parse(b'#' + text.encode())
    assert isinstance(described, Description | BadFrame)
    for item in (*frames, described):
        if isinstance(item, HelloFrame | Description):
            assert all(t.isprintable() for t in texts(item.info))


@pytest.mark.parametrize(
    ('value', 'text'),
    [
        ([[1, 2]], [[1, 2]]),
        ([[1, [2]]], [[1, '[2]']]),
        ({'b': {'c': 1}}, {'b': {'c': 1}}),
        ({'b': {'c': {'d': 1}}}, {'b': {'c': "{'d': 1}"}}),
    ],
)
def test_what_is_nested_over_three_deep_is_kept_as_text(value: object, text: object) -> None:
    assert device_words({'a': value}) == {'a': text}


@pytest.mark.parametrize('sign', [1, -1])
def test_whole_numbers_are_kept_as_far_as_json_has_them_exactly(sign: int) -> None:
    assert device_words({'a': sign * 2**53}) == {'a': sign * 2**53}
    assert device_words({'a': sign * (2**53 + 1)}) == {'a': 'a whole number of 54 bits'}


def test_a_text_has_200_characters_at_most() -> None:
    for text, short in (('x' * 200, 'x' * 200), ('x' * 201, 'x' * 199 + '…')):
        assert device_words({'a': text, 'b': [text]}) == {'a': short, 'b': [short]}
        assert list(device_words({text: {text: 1}}).items()) == [(short, {short: 1})]


def test_what_is_above_zero() -> None:
    assert [positive(v) for v in (1e-9, 3, 0.0, 0, -1e-9, -0.5)] == [1e-9, 3.0, None, None, None, None]


RUNS = st.integers(0, 3).flatmap(lambda k: st.integers(max(254 * k - 2, 0), 254 * k + 2))
"""Lengths of runs without a zero: short ones, and those where a block of 254 bytes ends."""
PAYLOADS = st.binary(max_size=600) | st.lists(RUNS, max_size=4).map(lambda runs: b'\0'.join(b'\x07' * n for n in runs))


@given(PAYLOADS)
def test_any_payload_is_encoded_as_the_judge_does_and_comes_back(payload: bytes) -> None:
    encoded = cobs_encode(payload)
    assert encoded == cobs.encode(payload)
    assert 0 not in encoded
    assert cobs_decode(encoded) == payload


@given(st.binary(max_size=600) | PAYLOADS.map(cobs_encode).map(lambda full: full[:-1]))
def test_any_bytes_are_decoded_or_rejected_as_the_judge_does(encoded: bytes) -> None:
    try:
        expected = cobs.decode(encoded)
    except cobs.DecodeError:
        with pytest.raises(ValueError, match='not COBS'):
            cobs_decode(encoded)
    else:
        assert cobs_decode(encoded) == expected


def test_the_blocks_around_254_bytes() -> None:
    for size in range(250, 514):
        for payload in (b'a' * size, b'a' * size + b'\0', b'\0' + b'a' * size, b'a' * size + b'\0b'):
            assert cobs_encode(payload) == cobs.encode(payload)
            assert cobs_decode(cobs_encode(payload)) == payload
