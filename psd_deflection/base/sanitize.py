# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A stranger's words in one line that can be printed."""

from __future__ import annotations


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
