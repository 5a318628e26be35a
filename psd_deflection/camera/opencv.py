# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""OpenCV, imported when it is first needed: everything else of this package runs without it."""

import functools
import os
import re
import struct
from collections.abc import Callable
from typing import Any

from psd_deflection.base.errors import ConfigError
from psd_deflection.camera.answer import NoPoseError, Status

MOST_PIXELS = 50_000_000
MOST_BYTES = 400_000_000
"""Of a file: 50 million pixels of 64 bits, not packed."""

_PNM = re.compile(rb'P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s')
_NO_FRAME = {0xC4, 0xC8, 0xCC}
"""JPEG's markers in the range of frame headers that are none."""

Size = tuple[int, int]
"""Columns and rows."""


def checked(content: bytes | memoryview) -> None:
    """Raise NoPoseError if a file with this content says that its image is larger than ``MOST_PIXELS``."""
    if len(content) > MOST_BYTES:
        raise NoPoseError(Status.TOO_LARGE, f'a file of {len(content) / 1e6:.0f} MB')
    size = declared_size(content)
    if size is not None:
        check_size(*size)


def check_size(columns: int, rows: int) -> None:
    """Raise NoPoseError for an image larger than ``MOST_PIXELS``."""
    if columns * rows > MOST_PIXELS:
        raise NoPoseError(Status.TOO_LARGE, f'{columns} x {rows} px')


def declared_size(content: bytes | memoryview) -> Size | None:
    """Columns and rows that the header of an image file declares; None if it is of another kind, or cut.

    Read are the headers of PNG, JPEG, BMP, TIFF, WebP, GIF and PNM. A file of another kind is left to OpenCV, which has
    the same bound (``OPENCV_IO_MAX_IMAGE_PIXELS``).
    """
    head = bytes(content[:32])
    for begins, size_of in _KINDS:
        if head.startswith(begins):
            try:
                return size_of(content)
            except (struct.error, IndexError):
                return None
    return None


def _png(content: bytes | memoryview) -> Size | None:
    return struct.unpack_from('>II', content, 16) if bytes(content[12:16]) == b'IHDR' else None


def _jpeg(content: bytes | memoryview) -> Size | None:
    at = 2
    while True:
        while content[at] != 0xFF:
            at += 1
        while content[at] == 0xFF:
            at += 1
        marker = content[at]
        at += 1
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME:
            rows, columns = struct.unpack_from('>HH', content, at + 3)
            return columns, rows
        # The image's own data begins, or nothing follows.
        if marker in (0xDA, 0xD9):
            return None
        if marker != 0x01 and not 0xD0 <= marker <= 0xD8:
            at += max(struct.unpack_from('>H', content, at)[0], 2)


def _bmp(content: bytes | memoryview) -> Size | None:
    if struct.unpack_from('<I', content, 14)[0] == 12:
        return struct.unpack_from('<HH', content, 18)
    columns, rows = struct.unpack_from('<ii', content, 18)
    return abs(columns), abs(rows)


def _tiff(content: bytes | memoryview) -> Size | None:
    """Also of BigTIFF: the first image of the file."""
    order = '<' if content[0] == ord('I') else '>'
    big = struct.unpack_from(order + 'H', content, 2)[0] == 43
    at = struct.unpack_from(order + ('Q' if big else 'I'), content, 8 if big else 4)[0]
    count = struct.unpack_from(order + ('Q' if big else 'H'), content, at)[0]
    first, length = (at + 8, 20) if big else (at + 2, 12)
    tags: dict[int, int] = {}
    for entry in range(first, first + length * min(count, 4096), length):
        tag, kind = struct.unpack_from(order + 'HH', content, entry)
        if tag in (256, 257):
            form = {3: 'H', 4: 'I', 16: 'Q'}.get(kind)
            if form is None:
                return None
            tags[tag] = struct.unpack_from(order + form, content, entry + (12 if big else 8))[0]
    return (tags[256], tags[257]) if len(tags) == 2 else None


def _webp(content: bytes | memoryview) -> Size | None:
    kind = bytes(content[12:16])
    if kind == b'VP8X':
        columns, rows = (int.from_bytes(content[i : i + 3], 'little') + 1 for i in (24, 27))
        return columns, rows
    if kind == b'VP8L':
        bits = struct.unpack_from('<I', content, 21)[0]
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b'VP8 ':
        columns, rows = struct.unpack_from('<HH', content, 26)
        return columns & 0x3FFF, rows & 0x3FFF
    return None


def _gif(content: bytes | memoryview) -> Size | None:
    return struct.unpack_from('<HH', content, 6)


def _pnm(content: bytes | memoryview) -> Size | None:
    header = _PNM.match(bytes(content[:4096]))
    return (int(header[1]), int(header[2])) if header is not None else None


_KINDS: tuple[tuple[bytes, Callable[[bytes | memoryview], Size | None]], ...] = (
    (b'\x89PNG\r\n\x1a\n', _png),
    (b'\xff\xd8\xff', _jpeg),
    (b'BM', _bmp),
    (b'II*\0', _tiff),
    (b'MM\0*', _tiff),
    (b'II+\0', _tiff),
    (b'MM\0+', _tiff),
    (b'RIFF', _webp),
    (b'GIF8', _gif),
    *((f'P{n}'.encode(), _pnm) for n in range(1, 7)),
)


@functools.cache
def opencv() -> Any:
    """Return the module ``cv2``. Raises ConfigError, with the fix, if it is not installed."""
    # OpenCV reads it once, when it is imported; its own bound is 2^30.
    os.environ.setdefault('OPENCV_IO_MAX_IMAGE_PIXELS', str(MOST_PIXELS))
    try:
        import cv2
    except ImportError:
        raise ConfigError(
            'the camera needs OpenCV: on Ubuntu and ROS `apt install python3-opencv`, in a virtual environment '
            "`pip install 'psd_deflection[camera]'`"
        ) from None
    return cv2
