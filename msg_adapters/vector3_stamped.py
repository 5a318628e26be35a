# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/Vector3Stamped: one raw sample of one PSD as plain numbers, for plots; x, y and the sum as z, V."""

from collections.abc import Iterator

from msg_adapters.header import Fields, header
from msg_adapters.message_type import MessageType
from psd_deflection.records import SampleBlock

MESSAGE = MessageType(
    'geometry_msgs/msg/Vector3Stamped',
    'RIHS01_d4829622288cbb443886e7ea94ea5671a3b1be6bab4ad04224432a65f7d7887a',
    'std_msgs/Header header\ngeometry_msgs/Vector3 vector\n',
)


def from_block(block: SampleBlock, psd: int, frame_prefix: str = '') -> Iterator[tuple[int, Fields]]:
    """(stamp in ns, fields) of each sample of PSD ``psd`` (from 1), frame ``psd_1``, ``psd_2`` ..."""
    frame = f'{frame_prefix}psd_{psd}'
    volts = block.volts[:, 3 * psd - 3 : 3 * psd].tolist()
    for t_ns, (x, y, total) in zip(block.t_ns.tolist(), volts, strict=True):
        yield t_ns, {'header': header(t_ns, frame), 'vector': {'x': x, 'y': y, 'z': total}}
