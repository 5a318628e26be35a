# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Consistent Overhead Byte Stuffing: bytes without a zero, so that a zero can end a frame.

Source: S. Cheshire, M. Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions on
Networking 7 (2), 1999. A code byte n stands before n - 1 bytes that are not zero; behind them
belongs a zero, unless n is 255 or nothing follows.
"""

from __future__ import annotations

_MOST = 254
"""Bytes behind one code."""
_CODES = [bytes((n + 1,)) for n in range(_MOST + 1)]
"""By the number of bytes behind it."""


def encode(payload: bytes) -> bytes:
    """``payload`` without zeros: one byte longer, and one more for each 254 bytes without a zero."""
    parts = payload.split(b'\0')
    if len(payload) >= _MOST:
        last = len(parts) - 1
        parts = [
            block
            for n, part in enumerate(parts)
            for block in [part[at : at + _MOST] for at in range(0, len(part) + 1, _MOST)]
            if block or n < last or not part
        ]
    return b''.join([_CODES[len(part)] + part for part in parts])


def decode(encoded: bytes) -> bytes:
    """What was encoded, without the zero that ends the frame. Raises ValueError if ``encoded`` is not COBS."""
    if 0 in encoded:
        raise ValueError('not COBS: a zero inside')
    out = bytearray(encoded)
    at, size = 0, len(out)
    if size <= _MOST:
        # In their place: each code becomes the zero that belongs before the next code.
        while at < size:
            code = out[at]
            out[at] = 0
            at += code
        plain = bytes(out[1:])
    else:
        blocks = []
        while at < size:
            code = encoded[at]
            blocks.append(encoded[at + 1 : at + code] + (b'' if code > _MOST or at + code >= size else b'\0'))
            at += code
        plain = b''.join(blocks)
    if at != size:
        raise ValueError('not COBS: a code points behind the end')
    return plain
