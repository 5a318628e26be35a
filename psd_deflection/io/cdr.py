"""Message field dicts <-> CDR bytes: the one place that knows the encoder.

The node publishes and the recorder writes the very same bytes (XCDR1, little-endian, header
``00 01 00 00``), so a message is encoded once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any

from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

from psd_deflection.io.ros2msg import definition


@cache
def _encoder(type_name: str) -> Callable[[Mapping[str, Any]], bytes]:
    encoder: Callable[[Mapping[str, Any]], bytes] = serialize_dynamic(type_name, definition(type_name))[type_name]
    return encoder


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
