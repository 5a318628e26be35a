# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A device's words, made harmless, whatever they were."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.base.sanitize import sanitize
from psd_deflection.devices.protocol.frames import BadFrame, FrameDecoder, HelloFrame, encode
from psd_deflection.devices.protocol.text_lines import Description, parse, positive
from psd_deflection.devices.protocol.words import MAX_TEXT, device_words, finite

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
    for info in [f.info for f in frames if isinstance(f, HelloFrame)] + [
        i.info for i in [described] if isinstance(i, Description)
    ]:
        assert all(t.isprintable() for t in texts(info))


@pytest.mark.parametrize(
    ('value', 'kept'),
    [
        ([[1, 2]], [[1, 2]]),
        ([[1, [2]]], [[1, '[2]']]),
        ({'b': {'c': 1}}, {'b': {'c': 1}}),
        ({'b': {'c': {'d': 1}}}, {'b': {'c': "{'d': 1}"}}),
    ],
)
def test_what_is_nested_over_three_deep_is_kept_as_text(value: object, kept: object) -> None:
    assert device_words({'a': value}) == {'a': kept}


@pytest.mark.parametrize('sign', [1, -1])
def test_whole_numbers_are_kept_as_far_as_json_has_them_exactly(sign: int) -> None:
    assert device_words({'a': sign * 2**53}) == {'a': sign * 2**53}
    assert device_words({'a': sign * (2**53 + 1)}) == {'a': 'a whole number of 54 bits'}


def test_a_text_has_200_characters_at_most() -> None:
    for text, kept in (('x' * 200, 'x' * 200), ('x' * 201, 'x' * 199 + '…')):
        assert device_words({'a': text, 'b': [text]}) == {'a': kept, 'b': [kept]}
        assert list(device_words({text: {text: 1}}).items()) == [(kept, {kept: 1})]


def test_what_is_above_zero() -> None:
    assert [positive(v) for v in (1e-9, 3, 0.0, 0, -1e-9, -0.5)] == [1e-9, 3.0, None, None, None, None]
