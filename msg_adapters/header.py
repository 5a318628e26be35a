# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""std_msgs/Header: a stamp in integer nanoseconds and the frame the numbers are in."""

from collections.abc import Mapping
from typing import Any

NS_PER_S = 1_000_000_000

Fields = dict[str, Any]


def header(t_ns: int, frame_id: str) -> Fields:
    """Header fields for ``t_ns``, ns since the epoch."""
    sec, nanosec = divmod(t_ns, NS_PER_S)
    return {'stamp': {'sec': sec, 'nanosec': nanosec}, 'frame_id': frame_id}


def stamp_ns(fields: Mapping[str, Any]) -> int:
    """The stamp of a message that has a header, ns since the epoch."""
    stamp = fields['header']['stamp']
    return int(stamp['sec']) * NS_PER_S + int(stamp['nanosec'])
