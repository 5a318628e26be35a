"""Message field dicts <-> CDR bytes: the one place that knows the encoder.

The node publishes and the recorder writes the very same bytes (XCDR1, little-endian, header
``00 01 00 00``), so a message is encoded once. The library's encoder walks the definition anew for
each message, which was the dearest part of a block; messages that are a header and numbers, seven
of a block's eight, are packed in one go here, to the same bytes.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from operator import itemgetter
from typing import Any

from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

from psd_deflection.recordings.ros2msg import definition, members

Encoder = Callable[[Mapping[str, Any]], bytes]

_ENCAPSULATION = b'\x00\x01\x00\x00'
_FLOAT64 = re.compile(r'float64(?:\[(\d+)\])?')


@cache
def _encoder(type_name: str) -> Encoder:
    text = definition(type_name)
    (first, _), *others = members(type_name)
    if first == 'std_msgs/Header' and all(_only_numbers(kind) for kind, _ in others):
        return _packer([part for kind, name in others for part in _numbers(kind, (name,))])
    encoder: Encoder = serialize_dynamic(type_name, text)[type_name]
    return encoder


def _only_numbers(kind: str) -> bool:
    inside = members(kind)
    return bool(_FLOAT64.fullmatch(kind)) or (bool(inside) and all(_only_numbers(k) for k, _ in inside))


def _numbers(kind: str, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], int]]:
    """Where each float64 of a ``kind`` is, and how many are there: 0 for a lone one."""
    array = _FLOAT64.fullmatch(kind)
    if array is not None:
        yield path, int(array[1] or 0)
    for inner, name in members(kind):
        yield from _numbers(inner, (*path, name))


def _packer(fields: list[tuple[tuple[str, ...], int]]) -> Encoder:
    """An encoder of messages that are a header and float64 ``fields``."""
    # Lone numbers that are neighbours in one part of the message are taken together.
    together: list[tuple[tuple[str, ...], list[str]]] = []
    for path, size in fields:
        if size:
            together.append((path, []))
        elif together and together[-1][1] and together[-1][0] == path[:-1]:
            together[-1][1].append(path[-1])
        else:
            together.append((path[:-1], [path[-1]]))
    takers = [(path, _taker(names)) for path, names in together]
    numbers = sum(max(size, 1) for _, size in fields)

    @cache
    def layout(size: int) -> struct.Struct:
        # Numbers stand at multiples of 8, counted from behind the encapsulation.
        return struct.Struct(f'<4siII{size}s{-(12 + size) % 8}x{numbers}d')

    def encode(message: Mapping[str, Any]) -> bytes:
        values: list[float] = []
        for path, take in takers:
            part: Any = message
            for name in path:
                part = part[name]
            values += take(part)
        header = message['header']
        stamp, frame = header['stamp'], header['frame_id'].encode()
        # With the zero that ends it.
        size = len(frame) + 1
        return layout(size).pack(_ENCAPSULATION, stamp['sec'], stamp['nanosec'], size, frame, *values)

    return encode


def _taker(names: list[str]) -> Callable[[Any], Iterable[float]]:
    """The numbers of a part: its fields of these names, or all of it where it is an array."""
    if not names:
        return iter
    return itemgetter(*names) if len(names) > 1 else lambda part: (part[names[0]],)


@cache
def _decoder(type_name: str) -> Callable[[bytes], Any]:
    decoder: Callable[[bytes], Any] = generate_dynamic(type_name, definition(type_name))[type_name]
    return decoder


def encode(type_name: str, fields: Mapping[str, Any]) -> bytes:
    """CDR of one message, encapsulation header included. Raises KeyError for a type that is not ours."""
    return _encoder(type_name)(fields)


def prepare(type_names: Iterable[str]) -> None:
    """Make the encoders now: the first message of a stream must not wait for them."""
    for type_name in type_names:
        _encoder(type_name)


def decode(type_name: str, cdr: bytes) -> dict[str, Any]:
    """The fields of one message, nested dicts and lists; ``uint8[]`` as bytes.

    Raises ValueError where the bytes are not a message of that type.
    """
    try:
        fields: dict[str, Any] = _plain(_decoder(type_name)(cdr))
    except KeyError:
        raise
    except Exception as error:  # the decoder lets struct, index and unicode errors through
        raise ValueError(f'not a {type_name} ({error})') from None
    return fields


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(v) for v in value]
    names = getattr(value, '__slots__', None)
    if names is None:
        return value
    return {name: _plain(getattr(value, name)) for name in names}
