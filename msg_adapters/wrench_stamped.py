"""geometry_msgs/WrenchStamped: a load at the tip centroid, in ``link_tip_rest``; N and N m."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msg_adapters.header import Fields, header, stamp_ns
from psd_deflection.records import AppliedLoad, TipLoad

TYPE = 'geometry_msgs/msg/WrenchStamped'
FRAME = 'link_tip_rest'


def from_load(load: TipLoad | AppliedLoad) -> Fields:
    """Fields of an estimated or a known load: force x, y and torque z."""
    return {
        'header': header(load.t_ns, FRAME),
        'wrench': {
            'force': {'x': load.fx, 'y': load.fy, 'z': 0.0},
            'torque': {'x': 0.0, 'y': 0.0, 'z': load.tz},
        },
    }


def to_applied_load(fields: Mapping[str, Any]) -> AppliedLoad:
    """The record of a known load."""
    force, torque = fields['wrench']['force'], fields['wrench']['torque']
    return AppliedLoad(stamp_ns(fields), float(force['x']), float(force['y']), float(torque['z']))
