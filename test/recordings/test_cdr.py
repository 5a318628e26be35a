# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Our bytes are those of an independent encoder, message by message."""

import contextlib
import re
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from msg_adapters import MESSAGE_TYPES
from msg_adapters.message_type import Constant, MessageType
from psd_deflection.recordings import cdr

pytestmark = pytest.mark.slow
STORE = get_typestore(Stores.ROS2_JAZZY)
CLOUD = 'sensor_msgs/msg/PointCloud2'
FULL = {'int32': (-(2**31), 2**31 - 1), 'uint32': (0, 2**32 - 1), 'uint8': (0, 255), 'byte': (0, 255)}


def values(message: MessageType, kind: str = '') -> st.SearchStrategy[Any]:
    """What a field of this type may hold."""
    if (array := re.fullmatch(r'(\S+)\[(\d*)\]', kind)) is not None:
        if array[1] == 'uint8':
            return st.binary(max_size=40)
        size = int(array[2]) if array[2] else None
        return st.lists(values(message, array[1]), min_size=size or 0, max_size=size or 3)
    if kind in FULL:
        return st.integers(*FULL[kind])
    if kind == 'float64':
        return st.floats(allow_nan=False)
    if kind == 'string':
        return st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=20)
    if kind == 'bool':
        return st.booleans()
    return st.fixed_dictionaries({name: values(message, inner) for inner, name in message.members(kind)})


@pytest.mark.parametrize('type_name', sorted(MESSAGE_TYPES))
@given(st.data())
def test_bytes_are_those_of_an_independent_encoder(type_name: str, data: st.DataObject) -> None:
    message = data.draw(values(MESSAGE_TYPES[type_name]))
    ours = cdr.encode(type_name, message)
    assert cdr.decode(type_name, ours) == message
    assert bytes(STORE.serialize_cdr(STORE.deserialize_cdr(ours, type_name), type_name)) == ours


@pytest.mark.parametrize('type_name', sorted(MESSAGE_TYPES))
@given(junk=st.binary(max_size=300), data=st.data())
def test_bytes_that_are_no_message_are_rejected_or_a_message(type_name: str, junk: bytes, data: st.DataObject) -> None:
    encoded = cdr.encode(type_name, data.draw(values(MESSAGE_TYPES[type_name])))
    cut = encoded[: data.draw(st.integers(0, len(encoded) - 1))]
    for wrong in (junk, cut, b'\0\1\0\0' + junk, b'\0\0\0\0' + junk):
        with contextlib.suppress(ValueError):
            cdr.decode(type_name, wrong)


def test_an_array_that_declares_more_than_there_is_costs_nothing() -> None:
    four_thousand_million = b'\0\1\0\0' + struct.pack('<iII', 0, 0, 1) + b'\0\0\0\0' + b'\xff' * 4
    with pytest.raises(ValueError, match='not a diagnostic_msgs/msg/DiagnosticArray'):
        cdr.decode('diagnostic_msgs/msg/DiagnosticArray', four_thousand_million)


def test_big_endian_numbers_are_read() -> None:
    head = struct.pack('>iII', 3, 4, 2) + b'a\0'
    fields = cdr.decode('geometry_msgs/msg/PoseStamped', b'\0\0\0\0' + head + b'\0\0' + struct.pack('>7d', *range(7)))
    assert fields['header'] == {'stamp': {'sec': 3, 'nanosec': 4}, 'frame_id': 'a'}
    assert [*fields['pose']['position'].values(), *fields['pose']['orientation'].values()] == list(range(7))


def test_the_encoder_takes_every_kind_of_field() -> None:
    kinds = ['bool', 'byte', 'int8', 'uint8', 'int16', 'uint16', 'int32', 'uint32', 'int64', 'uint64', 'float32']
    text = ''.join(f'{kind} {kind}_\n' for kind in kinds)
    text += 'string word\nint16[3] three\nuint8[2] two\nstring[] words\n'
    made_up = MessageType('test_msgs/msg/MadeUp', '', text)
    values_of: dict[str, Any] = {f'{kind}_': i % 2 for i, kind in enumerate(kinds)}
    values_of |= {'word': 'µ', 'three': [1, -2, 3], 'two': b'ab', 'words': ['', 'long']}
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(made_up.definition, made_up.name))
    encoded = cdr.encoder_of(made_up)(values_of)
    decoded = store.deserialize_cdr(encoded, made_up.name)
    for name, value in values_of.items():
        decoded_value = getattr(decoded, name)
        assert (type(value)(decoded_value) if isinstance(value, bytes | list) else decoded_value) == value
    assert bytes(store.serialize_cdr(decoded, made_up.name)) == encoded
    with pytest.raises(ValueError, match='2 values in an array of 3'):
        cdr.encoder_of(made_up)({**values_of, 'three': [1, 2]})


def test_a_type_that_is_not_ours_is_rejected() -> None:
    with pytest.raises(KeyError):
        cdr.encode('std_msgs/msg/Empty', {})


def test_constant_array_encodes_alike_at_any_offset() -> None:
    names = (('seq', 6), ('x', 7), ('y', 7))
    fields = [{'name': name, 'offset': 4 * i, 'datatype': kind, 'count': 1} for i, (name, kind) in enumerate(names)]
    size = {'height': 1, 'width': 0, 'point_step': 8, 'row_step': 0, 'data': b''}
    constants = [Constant(fields[:2]), Constant(fields), Constant([])]
    for frame in ('', 'a', 'ab', 'abc', 'abcd', 'abcde', 'tip', 'link_tip') * 2:
        for constant in (*constants, constants[0], *constants):
            header = {'stamp': {'sec': 1, 'nanosec': 2}, 'frame_id': frame}
            message = {'header': header, 'fields': constant, 'is_bigendian': False, 'is_dense': True, **size}
            plain = {**message, 'fields': list(constant)}
            assert cdr.encode(CLOUD, message) == cdr.encode(CLOUD, plain)
