"""geometry_msgs/PointStamped: the block mean of one dot, in its own PSD's axes; m."""

from __future__ import annotations

from msg_adapters.header import Fields, header
from psd_deflection.records import SpotMeans

TYPE = 'geometry_msgs/msg/PointStamped'


def from_spot(spots: SpotMeans, psd: int) -> Fields:
    """Fields of the dot on PSD ``psd`` (1 or 2), frame ``psd_1`` or ``psd_2``."""
    x, y = spots.dots[2 * psd - 2], spots.dots[2 * psd - 1]
    return {'header': header(spots.t_ns, f'psd_{psd}'), 'point': {'x': x, 'y': y, 'z': 0.0}}
