# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/WrenchStamped: a load at the tip centroid, in ``link_tip_rest``; N and N m."""

from collections.abc import Mapping
from typing import Any

from msg_adapters.header import Fields, header, stamp_ns
from msg_adapters.message_type import MessageType
from psd_deflection.records import AppliedLoad, TipLoad

MESSAGE = MessageType(
    'geometry_msgs/msg/WrenchStamped',
    'RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77',
    'std_msgs/Header header\ngeometry_msgs/Wrench wrench\n',
    {'geometry_msgs/Wrench': 'geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n'},
)
FRAME = 'link_tip_rest'


def from_load(load: TipLoad | AppliedLoad) -> Fields:
    """Fields of an estimated or a known load: force x, y and torque z."""
    return {
        'header': header(load.t_ns, FRAME),
        'wrench': {'force': {'x': load.fx, 'y': load.fy, 'z': 0.0}, 'torque': {'x': 0.0, 'y': 0.0, 'z': load.tz}},
    }


def to_applied_load(fields: Mapping[str, Any]) -> AppliedLoad:
    """The record of a known load."""
    force, torque = fields['wrench']['force'], fields['wrench']['torque']
    return AppliedLoad(stamp_ns(fields), float(force['x']), float(force['y']), float(torque['z']))
