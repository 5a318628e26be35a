# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a device says of itself, made harmless: text that can be printed, numbers that can be computed with.

A device's JSON object comes from a stranger and goes to the log, ``/diagnostics``, recordings and a person's terminal.
Both protocols that carry one pass it through :func:`device_words`, so that nothing else ever reaches the program.
"""

import math
from collections.abc import Mapping

from psd_deflection.base.text import sanitize

MAX_TEXT = 200
"""Characters of one text. A longer one is cut."""

MAX_INTEGER = 1 << 53
"""Whole numbers beyond it are not exact in JSON, and are kept as text."""

MAX_DEPTH = 3
"""Lists and objects that are nested deeper are kept as text."""


def finite(value: object) -> float | None:
    """``value`` if it is a finite number, else None."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def device_words(info: Mapping[str, object]) -> dict[str, object]:
    """``info`` with printable texts of at most ``MAX_TEXT`` characters and finite numbers; the rest becomes text.

    What is harmless already comes back as it is.
    """
    return {sanitize(str(key), MAX_TEXT): _harmless(value, 1) for key, value in info.items()}


def _harmless(value: object, depth: int) -> object:
    match value:
        case None | bool():
            return value
        case str():
            return sanitize(value, MAX_TEXT)
        case int() if abs(value) <= MAX_INTEGER:
            return value
        case float() if math.isfinite(value):
            return value
        case list() | tuple() if depth < MAX_DEPTH:
            return [_harmless(item, depth + 1) for item in value]
        case Mapping() if depth < MAX_DEPTH:
            return {sanitize(str(key), MAX_TEXT): _harmless(item, depth + 1) for key, item in value.items()}
        case int():
            return f'a whole number of {value.bit_length()} bits'
        case _:
            return sanitize(repr(value), MAX_TEXT)
