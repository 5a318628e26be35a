# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads the point clouds that hold the samples, faster than the generic decoder.

The clouds of one recording differ only in stamp, width and points. So the bytes between these are parsed
once and then only compared. A message that differs goes to the generic decoder.
"""

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from msg_adapters import point_cloud2
from psd_deflection.recordings import cdr
from psd_deflection.recordings.mcap_format import MAX_FIELDS
from psd_deflection.records import IntArray, channel_names


class _CloudLayout(NamedTuple):
    """The common bytes of messages of one kind, and the offsets of the other parts."""

    width_at: int
    row_step_at: int
    before_width: bytes
    after_width: bytes
    points: np.dtype[np.void]


class CloudDecoder:
    """PointCloud2 messages of one topic, one after the other."""

    _MOST = 8

    def __init__(self) -> None:
        # Our messages have two layouts, with and without flags.
        self._layouts: list[_CloudLayout] = []

    def decode(self, message: bytes) -> tuple[int, npt.NDArray[np.void]]:
        """(header.stamp in ns, the points). Raises ValueError if it is not a PointCloud2."""
        for width_at, row_step_at, before_width, after_width, dtype in self._layouts:
            if message[cdr.FRAME_AT : width_at] == before_width and message[width_at + 4 : row_step_at] == after_width:
                try:
                    width = cdr.u32(message, width_at)
                    if width * dtype.itemsize != cdr.u32(message, row_step_at + 4):
                        break
                    return cdr.header_stamp_ns(message), np.frombuffer(message, dtype, width, row_step_at + 8)
                except (struct.error, ValueError):
                    raise ValueError('is shorter than it declares') from None
        if _declared_fields(message) > MAX_FIELDS:
            raise ValueError(f'it declares more than {MAX_FIELDS} fields')
        stamp, points = point_cloud2.to_points(cdr.decode(point_cloud2.MESSAGE.name, message))
        if message[:2] == cdr.LITTLE and len(self._layouts) < self._MOST:
            self._layouts.append(_learn(message, points.dtype))
        return stamp, points


def _declared_fields(message: bytes) -> int:
    """How many fields a PointCloud2 declares, before any is decoded; 0 if the message ends before that."""
    try:
        return cdr.u32(message, cdr.after_text(message, cdr.FRAME_AT) + 8)
    except struct.error:
        return 0


def _learn(message: bytes, dtype: np.dtype[np.void]) -> _CloudLayout:
    """Offsets of the parts that change from one message to the next; ``message`` must be valid."""
    width_at = cdr.after_text(message, cdr.FRAME_AT) + 4
    at = width_at + 8
    for _ in range(cdr.u32(message, width_at + 4)):
        at = cdr.after_text(message, at) + 12
    row_step_at = at + 8
    return _CloudLayout(
        width_at, row_step_at, message[cdr.FRAME_AT : width_at], message[width_at + 4 : row_step_at], dtype
    )


class Samples(NamedTuple):
    """Samples in order: ``seq`` int64 (n,), ``t_ns`` (n,), ``volts`` (n, 3P), ``flags`` (n,).

    ``full``: False if ``seq`` is modulo 2^32.
    """

    full: bool
    seq: IntArray
    t_ns: IntArray
    volts: npt.NDArray[np.float32]
    flags: npt.NDArray[np.uint8]


def joined_points(messages: Sequence[tuple[int, npt.NDArray[np.void]]]) -> Samples:
    """The samples of messages of one layout, given as (stamp, points)."""
    # Byte by byte: np.concatenate compares the fields of all of them first, which costs more than the copy.
    points = np.frombuffer(b''.join([p.tobytes() for _, p in messages]), messages[0][1].dtype)
    stamps = np.repeat([stamp for stamp, _ in messages], [len(p) for _, p in messages])
    names = points.dtype.names or ()
    seq = points['seq'].astype(np.uint32).astype(np.int64)
    full = 'seq_high' in names
    if full:
        # 31 more bits are always enough, and no file can make the number negative.
        seq += (points['seq_high'].astype(np.int64) & 0x3FFFFFFF) << 32
    return Samples(
        full,
        seq,
        stamps + points['dt'].astype(np.int64),
        np.stack([points[c] for c in channel_names(point_cloud2.psds_of(points))], axis=1).astype(np.float32),
        points['flags'].astype(np.uint8) if 'flags' in names else np.zeros(len(points), np.uint8),
    )
