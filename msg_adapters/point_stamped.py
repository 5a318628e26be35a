# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/PointStamped: the block mean of one dot, in its own PSD's axes; m."""

from msg_adapters.header import Fields, header
from msg_adapters.message_type import MessageType
from psd_deflection.records import SpotMeans

MESSAGE = MessageType(
    'geometry_msgs/msg/PointStamped',
    'RIHS01_4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897',
    'std_msgs/Header header\ngeometry_msgs/Point point\n',
)


def from_spot(spots: SpotMeans, psd: int) -> Fields:
    """Fields of the dot on PSD ``psd`` (from 1), frame ``psd_1``, ``psd_2`` ..."""
    x, y = spots.dots[2 * psd - 2], spots.dots[2 * psd - 1]
    return {'header': header(spots.t_ns, f'psd_{psd}'), 'point': {'x': x, 'y': y, 'z': 0.0}}
