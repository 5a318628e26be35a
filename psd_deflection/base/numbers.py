# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Numbers in the texts of others: files, options, tables. One reading of them, for every part."""

from __future__ import annotations

import re

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
