# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/PointCloud2: the raw samples of one block, one point per sample.

Little-endian fields in this order: ``seq`` UINT32 (the sample number modulo 2^32), ``dt`` UINT32
(ns after header.stamp, which is the time of the first sample), then the channels in volts,
FLOAT32: x1 y1 sum1 x2 y2 sum2, and three more of each further PSD. Two more follow only in blocks that need them, so
replay has the same input as the live pipeline: ``flags`` UINT32 if a sample has a flag, and after it ``seq_high``
UINT32 (seq div 2^32) once the sample number has passed 32 bits, after 49 days at 1 kHz.
"""

import functools
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from msg_adapters.header import Fields, header, stamp_ns
from msg_adapters.message_type import Constant, MessageType
from psd_deflection.records import CHANNELS, MOST_PSDS, SampleBlock, channel_names

MESSAGE = MessageType(
    'sensor_msgs/msg/PointCloud2',
    'RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5',
    'std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n'
    'bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n',
    {
        'sensor_msgs/PointField': (
            'uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n'
            'uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n'
        )
    },
)
FRAME = 'link_tip'

UINT32 = 6
FLOAT32 = 7


@functools.cache
def point_of(psds: int, more: int = 0) -> np.dtype[np.void]:
    """One sample of so many PSDs: 32 bytes of two. ``more``: 1 with ``flags``, 2 with ``seq_high`` as well."""
    kinds = [('seq', '<u4'), ('dt', '<u4'), *((c, '<f4') for c in channel_names(psds))]
    return np.dtype([*kinds, *(('flags', '<u4'), ('seq_high', '<u4'))[:more]])


MAX_SPAN_NS = 2**32 - 1
"""The largest ``dt``: 4.29 s."""

MAX_STEP = 65_536
"""Largest point, in bytes, that is read from a cloud of another program."""

_FORMATS = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}


@functools.cache
def _fields(psds: int, more: int) -> Constant:
    # Every field is four bytes wide.
    channels = channel_names(psds)
    return Constant(
        {'name': name, 'offset': 4 * i, 'datatype': FLOAT32 if name in channels else UINT32, 'count': 1}
        for i, name in enumerate(point_of(psds, more).names or ())
    )


def from_block(block: SampleBlock) -> Fields:
    """Fields of one block whose samples lie at most ``MAX_SPAN_NS`` apart (see :func:`parts`)."""
    psds = block.volts.shape[1] // 3
    more = 2 if int(block.seq[-1]) >> 32 else int(block.flags.any())
    dtype = point_of(psds, more)
    width = len(block.seq)
    t_ns = int(block.t_ns[0])
    # Every field is four bytes wide: a table.
    points = np.empty((width, dtype.itemsize // 4), '<u4')
    points[:, 0] = block.seq & 0xFFFFFFFF
    points[:, 1] = block.t_ns - t_ns
    points[:, 2 : 2 + 3 * psds].view('<f4')[:] = block.volts
    if more:
        points[:, 2 + 3 * psds] = block.flags
    if more == 2:
        points[:, -1] = block.seq >> 32
    return {
        'header': header(t_ns, FRAME),
        'height': 1,
        'width': width,
        'fields': _fields(psds, more),
        'is_bigendian': False,
        'point_step': dtype.itemsize,
        'row_step': dtype.itemsize * width,
        'data': points.tobytes(),
        'is_dense': True,
    }


def parts(block: SampleBlock) -> Iterator[SampleBlock]:
    """The block itself or, if its samples are too far apart for ``dt``, the block in pieces.

    This happens only if a device was stopped within a block and started seconds later, because its
    numbers continue without a gap.
    """
    start = 0
    while len(block.t_ns) > start:
        if int(block.t_ns[-1]) - int(block.t_ns[start]) <= MAX_SPAN_NS:
            end = len(block.t_ns)
        else:
            end = start + int(np.searchsorted(block.t_ns[start:] - block.t_ns[start], MAX_SPAN_NS, side='right'))
        if start == 0 and end == len(block.t_ns):
            yield block
        else:
            s = slice(start, end)
            yield SampleBlock(block.index, block.seq[s], block.t_ns[s], block.volts[s], block.flags[s])
        start = end


def layout(fields: Mapping[str, Any]) -> npt.DTypeLike:
    """The numpy dtype of the points of any PointCloud2 that has these fields, possibly among others.

    Raises ValueError naming the field that is absent, of another kind, or outside the point.
    """
    order = '>' if fields['is_bigendian'] else '<'
    step = int(fields['point_step'])
    names: list[str] = []
    formats: list[str] = []
    offsets: list[int] = []
    for f in fields['fields']:
        kind = _FORMATS.get(int(f['datatype']))
        if kind is None or int(f['count']) != 1 or f['name'] in names or f['name'] == '':
            continue
        dtype = np.dtype(order + kind)
        if int(f['offset']) + dtype.itemsize > step:
            raise ValueError(f'field {f["name"]!r} at offset {f["offset"]} is outside a point of {step} bytes')
        names.append(f['name'])
        formats.append(dtype.str)
        offsets.append(int(f['offset']))
    for name in ('seq', 'dt', *CHANNELS):
        if name not in names:
            raise ValueError(f'has no field {name!r} (fields: {", ".join(names) or "none"})')
    return np.dtype({'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': step})


def psds_of(points: npt.NDArray[np.void]) -> int:
    """Of how many PSDs ``points`` have all three channels: 2 to ``MOST_PSDS``."""
    names = points.dtype.names or ()
    return next((n for n in range(MOST_PSDS, 2, -1) if set(channel_names(n)) <= set(names)), 2)


def to_points(fields: Mapping[str, Any]) -> tuple[int, npt.NDArray[np.void]]:
    """(header.stamp in ns, the points as a structured array with at least our eight fields).

    Raises ValueError if the layout or the size of the message contradicts itself.
    """
    width, height, step = int(fields['width']), int(fields['height']), int(fields['point_step'])
    data = bytes(fields['data'])
    if height != 1:
        raise ValueError(f'height is {height}, not 1')
    if not 1 <= step <= MAX_STEP:
        raise ValueError(f'a point of {step} bytes is not one of ours')
    if width * step != len(data):
        raise ValueError(f'{width} points of {step} bytes do not make {len(data)} bytes')
    return stamp_ns(fields), np.frombuffer(data, layout(fields), count=width)
