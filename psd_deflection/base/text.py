# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Text for people and programs: a stranger's words made printable, near spellings, plain numbers, JSON of numbers."""

import difflib
import json
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any


def sanitize(text: str, longest: int) -> str:
    """``text`` in one line of printable characters; what is beyond ``longest`` characters is cut, with an ellipsis.

    A stranger's words (a device's, a file's) can so neither move the cursor, change colours, forge a line, nor fail
    to be encoded. Text that is so already comes back as it is.
    """
    if text.isprintable() and len(text) <= longest:
        return text
    pieces: list[str] = []
    length = 0
    for character in text[: longest + 1]:
        piece = character if character.isprintable() else character.encode('unicode_escape').decode('ascii')
        length += len(piece)
        pieces.append(piece)
    if length <= longest and len(text) <= longest:
        return ''.join(pieces)
    while length > longest - 1:
        length -= len(pieces.pop())
    return ''.join(pieces) + '\N{HORIZONTAL ELLIPSIS}'


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``; did you mean X?`` if ``name`` is close to one of ``known``, else an empty string."""
    matches = difflib.get_close_matches(name, list(known), n=1)
    return f'; did you mean {matches[0]}?' if matches else ''


NUMBER = re.compile(
    r'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,4})?|[+-]?(?:nan|inf|infinity)', re.ASCII | re.IGNORECASE
)
"""What loggers write. Python takes ``1_000`` and digits of every script as well; in a file they are typing errors."""


def plain_number(text: str) -> float:
    """The number that ``text`` is, spaces around it aside. Raises ValueError, also for ``1_000`` and ``٣``."""
    text = text.strip()
    if NUMBER.fullmatch(text) is None:
        raise ValueError(f'{text!r} is not a number')
    return float(text)


def json_text(value: Any, indent: int | None = None) -> str:
    """``value`` as JSON, with null for numbers that JSON does not have (NaN, infinite)."""
    return json.dumps(_plain(value), indent=indent, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, list | tuple) else value
