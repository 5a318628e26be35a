"""geometry_msgs/PoseStamped: an estimate or a reference measurement of the tip, in ``link_tip_rest``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msg_adapters.header import Fields, header, stamp_ns
from msg_adapters.orientation import angles, quaternion
from psd_deflection.records import DeflectionEstimate, ReferencePose

TYPE = 'geometry_msgs/msg/PoseStamped'
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
