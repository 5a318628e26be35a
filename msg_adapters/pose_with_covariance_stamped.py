# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/PoseWithCovarianceStamped: the primary estimate, the filter's pose or a reference, with covariance."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from msg_adapters.header import Fields, header, stamp_ns
from msg_adapters.message_type import MessageType
from msg_adapters.orientation import angles
from msg_adapters.pose_stamped import FRAME, pose
from psd_deflection.records import (
    DeflectionEstimate,
    EndEffectorDeflection,
    FloatArray,
    ReferenceWithCovariance,
    TipMotion,
)

MESSAGE = MessageType(
    'geometry_msgs/msg/PoseWithCovarianceStamped',
    'RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e',
    'std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n',
    {'geometry_msgs/PoseWithCovariance': 'geometry_msgs/Pose pose\nfloat64[36] covariance\n'},
)

UNOBSERVED_VARIANCE = 1e6
"""Variance of the axes that two flat PSDs do not see (z in m^2, roll and pitch in rad^2)."""

_OBSERVED = (0, 1, 5)
"""x, y and yaw in ROS order (x, y, z, roll, pitch, yaw)."""


def from_estimate(e: DeflectionEstimate | TipMotion | ReferenceWithCovariance) -> Fields:
    """Fields of an estimate, a motion or a reference: covariance 6 x 6, row by row, in ROS order."""
    covariance = [0.0] * 36
    for axis in (2, 3, 4):
        covariance[7 * axis] = UNOBSERVED_VARIANCE
    for i, row in enumerate(_OBSERVED):
        for j, column in enumerate(_OBSERVED):
            covariance[6 * row + column] = e.covariance[3 * i + j]
    return {
        'header': header(e.t_ns, FRAME),
        'pose': {'pose': pose(e.dx, e.dy, e.theta, e.phi, e.omega), 'covariance': covariance},
    }


def from_end_effector(e: EndEffectorDeflection, frame: str) -> Fields:
    """Fields of a chain's end effector in ``frame``, that of its rigid pose."""
    place = dict(zip('xyz', e.position, strict=True))
    rotated = dict(zip('xyzw', e.quaternion, strict=True))
    return {
        'header': header(e.t_ns, frame),
        'pose': {'pose': {'position': place, 'orientation': rotated}, 'covariance': list(e.covariance)},
    }


def to_reference(fields: Mapping[str, Any]) -> ReferenceWithCovariance:
    """The record of a reference message: m, m, rad."""
    pose_fields = fields['pose']['pose']
    theta, phi, omega = angles(pose_fields['orientation'])
    place, numbers = pose_fields['position'], fields['pose']['covariance']
    covariance = tuple(float(numbers[6 * i + j]) for i in _OBSERVED for j in _OBSERVED)
    return ReferenceWithCovariance(
        stamp_ns(fields), float(place['x']), float(place['y']), theta, phi, omega, covariance
    )


def to_covariances(numbers: FloatArray) -> FloatArray:
    """Covariance (n, 3, 3) of (dX, dY, theta) of n messages.

    ``numbers`` (n, 43): the message's float64 in order: position 3, orientation 4, covariance 6 x 6.
    """
    return numbers[:, 7:].reshape(-1, 6, 6)[np.ix_(range(len(numbers)), _OBSERVED, _OBSERVED)]
