# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/AccelStamped: acceleration of the link's base, in ``link_base``, without gravity; m/s^2 and rad/s^2."""

from collections.abc import Mapping
from typing import Any

from msg_adapters.header import Fields, header, stamp_ns
from msg_adapters.message_type import MessageType
from psd_deflection.records import BaseAcceleration

MESSAGE = MessageType(
    'geometry_msgs/msg/AccelStamped',
    'RIHS01_ef1df9eabae0a708cc049a061ebcddc4e2a5f745730100ba680e086a9698b165',
    'std_msgs/Header header\ngeometry_msgs/Accel accel\n',
    {'geometry_msgs/Accel': 'geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n'},
)
FRAME = 'link_base'


def from_base(base: BaseAcceleration) -> Fields:
    """Fields of a known acceleration."""
    return {
        'header': header(base.t_ns, FRAME),
        'accel': {
            'linear': dict(zip('xyz', base.linear, strict=True)),
            'angular': dict(zip('xyz', base.angular, strict=True)),
        },
    }


def to_base(fields: Mapping[str, Any]) -> BaseAcceleration:
    """The record of a known acceleration. Raises ValueError if it is in another frame or says not when it acts."""
    frame = fields['header']['frame_id']
    # A rig may have a prefix before its frames.
    if not frame.endswith(FRAME):
        raise ValueError(f'header.frame_id is {frame[:40]!r}: the acceleration has to be given in {FRAME}')
    t_ns = stamp_ns(fields)
    if t_ns == 0:
        raise ValueError('header.stamp is 0: it has to say from when on the base is accelerated')
    linear, angular = (tuple(float(fields['accel'][name][k]) for k in 'xyz') for name in ('linear', 'angular'))
    return BaseAcceleration(t_ns, linear, angular)
