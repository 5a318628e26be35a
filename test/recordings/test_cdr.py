"""Our bytes are those of the library's encoder, message by message."""

from __future__ import annotations

import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import serialize_dynamic

from msg_adapters import TOPIC_TYPES
from psd_deflection.recordings import cdr
from psd_deflection.recordings.ros2msg import definition, members

WHOLE = {'int32': (-(2**31), 2**31 - 1), 'uint32': (0, 2**32 - 1), 'uint8': (0, 255), 'byte': (0, 255)}


def values(kind: str) -> st.SearchStrategy[Any]:
    """What a field of this type may hold."""
    if (array := re.fullmatch(r'(\S+)\[(\d*)\]', kind)) is not None:
        if array[1] == 'uint8':
            return st.binary(max_size=40)
        size = int(array[2]) if array[2] else None
        return st.lists(values(array[1]), min_size=size or 0, max_size=size or 3)
    if kind in WHOLE:
        return st.integers(*WHOLE[kind])
    if kind == 'float64':
        return st.floats(allow_nan=False)
    if kind == 'string':
        return st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=20)
    if kind == 'bool':
        return st.booleans()
    return st.fixed_dictionaries({name: values(inner) for inner, name in members(kind)})


@pytest.mark.parametrize('type_name', sorted(set(TOPIC_TYPES.values())))
@given(st.data())
def test_bytes_are_those_of_the_library(type_name: str, data: st.DataObject) -> None:
    message = data.draw(values(type_name))
    library = serialize_dynamic(type_name, definition(type_name))[type_name]
    assert cdr.encode(type_name, message) == library(message)


def test_a_type_that_is_not_ours_is_refused() -> None:
    with pytest.raises(KeyError):
        cdr.encode('std_msgs/msg/Empty', {})
