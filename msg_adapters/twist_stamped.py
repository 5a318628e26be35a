# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/TwistStamped: the tip's velocity by the filter, in ``link_tip_rest``; m/s and rad/s."""

from msg_adapters.header import Fields, header
from msg_adapters.message_type import MessageType
from msg_adapters.pose_stamped import FRAME
from psd_deflection.records import TipMotion

MESSAGE = MessageType(
    'geometry_msgs/msg/TwistStamped',
    'RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64',
    'std_msgs/Header header\ngeometry_msgs/Twist twist\n',
    {'geometry_msgs/Twist': 'geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n'},
)


def from_motion(m: TipMotion) -> Fields:
    """Fields of a motion: linear x, y and angular z."""
    return {
        'header': header(m.t_ns, FRAME),
        'twist': {'linear': {'x': m.vx, 'y': m.vy, 'z': 0.0}, 'angular': {'x': 0.0, 'y': 0.0, 'z': m.vtheta}},
    }
