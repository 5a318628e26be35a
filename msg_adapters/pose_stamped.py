# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/PoseStamped: an estimate or a reference measurement of the tip, in ``link_tip_rest``."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from msg_adapters.header import Fields, header, stamp_ns
from msg_adapters.message_type import MessageType
from msg_adapters.orientation import angles, quaternion
from psd_deflection.records import DeflectionEstimate, FloatArray, ReferencePose

MESSAGE = MessageType(
    'geometry_msgs/msg/PoseStamped',
    'RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8',
    'std_msgs/Header header\ngeometry_msgs/Pose pose\n',
)
FRAME = 'link_tip_rest'


def pose(dx: float, dy: float, theta: float, phi: float = 0.0, omega: float = 0.0) -> Fields:
    """geometry_msgs/Pose: position (dx, dy, 0) m, orientation of R."""
    return {'position': {'x': dx, 'y': dy, 'z': 0.0}, 'orientation': quaternion(theta, phi, omega)}


def from_estimate(e: DeflectionEstimate) -> Fields:
    """Fields of one solver's answer."""
    return {'header': header(e.t_ns, FRAME), 'pose': pose(e.dx, e.dy, e.theta, e.phi, e.omega)}


def from_reference(r: ReferencePose) -> Fields:
    """Fields of an independent measurement; its tilts are not known and are left at zero."""
    return {'header': header(r.t_ns, FRAME), 'pose': pose(r.dx, r.dy, r.theta)}


def to_reference(fields: Mapping[str, Any]) -> ReferencePose:
    """The record of a reference message: m, m, rad."""
    position = fields['pose']['position']
    theta, _, _ = angles(fields['pose']['orientation'])
    return ReferencePose(stamp_ns(fields), float(position['x']), float(position['y']), theta)


def to_poses(numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(dX m, dY m, theta rad) (n, 3) and (phi, omega) rad (n, 2) of n messages.

    ``numbers`` (n, 7 or more): the message's float64 in order, that is position and orientation.
    """
    rotated = np.array([angles(dict(zip('xyzw', q, strict=True))) for q in numbers[:, 3:7].tolist()])
    return np.column_stack([numbers[:, 0], numbers[:, 1], rotated[:, 0]]), rotated[:, 1:]
