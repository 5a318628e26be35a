# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The frames of the messages as a tree for tf2: ``link_base``, ``link_tip_rest``, ``link_tip``, ``psd_1`` ...

What the rig file fixes is static and latched. The tip moves with each estimate of the primary
solver; it is sent by the pipeline thread, with the estimate's own stamp.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import Quaternion, TransformStamped
from rclpy.node import Node

from msg_adapters.orientation import quaternion
from psd_deflection.model.plate.scene import Vector
from psd_deflection.records import DeflectionEstimate, Record
from psd_deflection.rig.config import Rig
from psd_deflection.ros.endpoints import message_class, publisher_of
from psd_deflection.ros.names import BASE, PSDS, REST, TIP
from psd_deflection.ros.topics import PUBLISHED, TF, TF_STATIC

_UPRIGHT = {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}


def installed() -> bool:
    """Whether tf2_msgs is there: it comes with a ROS installation, not with rclpy's wheels."""
    return importlib.util.find_spec('tf2_msgs') is not None


def transform_message(parent: str, child: str, t_ns: int, at: Vector, rotation: dict[str, float]) -> Any:
    """The TransformStamped of ``child`` in ``parent``, m."""
    out = TransformStamped(child_frame_id=child)
    out.header.frame_id = parent
    out.header.stamp.sec, out.header.stamp.nanosec = divmod(t_ns, 1_000_000_000)
    out.transform.translation.x, out.transform.translation.y, out.transform.translation.z = at
    out.transform.rotation = Quaternion(**rotation)
    return out


def static_transforms(rig: Rig, t_ns: int) -> list[Any]:
    """The TransformStamped of the unloaded tip and of the PSDs, which are on the plate or, at the base, fixed."""
    prefix = rig.monitor.frame_prefix
    holder = REST if rig.psds_at_base else TIP
    return [
        transform_message(prefix + BASE, prefix + REST, t_ns, (0.0, 0.0, rig.link.length), _UPRIGHT),
        *(
            transform_message(prefix + holder, prefix + name, t_ns, (*psd.center, psd.height), _UPRIGHT)
            for name, psd in zip(PSDS, rig.psds, strict=False)
        ),
    ]


def tip_transform(rig: Rig, e: DeflectionEstimate) -> Any:
    """The TransformStamped of the tip, true to scale."""
    rotation = quaternion(e.theta, e.phi, e.omega)
    prefix = rig.monitor.frame_prefix
    return transform_message(prefix + REST, prefix + TIP, e.t_ns, (e.dx, e.dy, 0.0), rotation)


class FramePublisher:
    """Publishes TransformStamped on ``/tf`` and ``/tf_static``. Needs tf2_msgs."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._message = message_class(PUBLISHED[TF].type)
        self._moving, self._static = publisher_of(node, TF), publisher_of(node, TF_STATIC)

    def fix(self, transforms: Sequence[Any]) -> None:
        """Publish those that do not move, in place of the ones before."""
        self._static.publish(self._message(transforms=transforms))

    def move(self, transforms: Sequence[Any]) -> None:
        """Publish those that move."""
        self._moving.publish(self._message(transforms=transforms))

    def close(self) -> None:
        """Take the publishers off the graph."""
        for publisher in (self._moving, self._static):
            self._node.destroy_publisher(publisher)


class TransformPublisher:
    """A sink of records: ``/tf`` for each primary estimate while it is ``active``. Needs tf2_msgs."""

    def __init__(self, node: Node, rig: Rig) -> None:
        self.active = False
        self._rig = rig
        self._frames = FramePublisher(node)
        self._frames.fix(static_transforms(rig, time.time_ns()))

    def put(self, record: Record) -> None:
        """Publish where the tip is."""
        if self.active and isinstance(record, DeflectionEstimate) and record.primary:
            self._frames.move([tip_transform(self._rig, record)])

    def close(self) -> None:
        """Take the publishers off the graph."""
        self._frames.close()
