# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Markers for RViz: link, plate, detectors, beams and dots, displacements magnified. Static parts are latched; moving
ones go when there is no estimate."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Quaternion
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters.orientation import quaternion
from psd_deflection.model.plate.layout import Vector, bend, tip_boxes
from psd_deflection.records import DeflectionEstimate, SpotMeans
from psd_deflection.rig.config import Rig
from psd_deflection.ros.endpoints import publisher_of
from psd_deflection.ros.topics import BASE, MARKERS, MARKERS_AT_REST
from psd_deflection.run.session import Session

PERIOD_S = 0.1
LIFETIME_S = 1.0

_METAL, _PLATE, _SENSOR, _LASER = (
    (0.6, 0.65, 0.7, 0.9),
    (0.2, 0.3, 0.4, 0.6),
    (0.1, 0.1, 0.12, 1.0),
    (1.0, 0.2, 0.15, 1.0),
)


def _marker(
    number: int, name: str, kind: int, color: Sequence[float], scale: Vector, at: Vector = (0.0, 0.0, 0.0)
) -> Any:
    marker = Marker(ns=name, id=number, type=kind, action=Marker.ADD)
    marker.pose.position = Point(x=at[0], y=at[1], z=at[2])
    marker.scale.x, marker.scale.y, marker.scale.z = scale
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = color
    return marker


def at_rest(rig: Rig) -> Any:
    """The MarkerArray of the static parts: the unloaded link, both lasers, both beams."""
    length, radius = rig.link.length, rig.link.outer_radius
    link = _marker(
        0,
        'link_at_rest',
        Marker.CYLINDER,
        (*_METAL[:3], 0.25),
        (2 * radius, 2 * radius, length),
        (0.0, 0.0, length / 2),
    )
    out = [link]
    for i, psd in enumerate(rig.psds, 1):
        x, y = psd.center[0] + psd.zero[0], psd.center[1] + psd.zero[1]
        out.append(_marker(i, 'laser', Marker.CYLINDER, _SENSOR, (0.016, 0.016, 0.04), (x, y, -0.02)))
        beam = _marker(i, 'beam', Marker.LINE_LIST, (*_LASER[:3], 0.7), (0.0015, 0.0, 0.0))
        beam.points = [Point(x=x, y=y, z=0.0), Point(x=x, y=y, z=length + psd.height)]
        out.append(beam)
    return _of_rig(rig, out)


def moving(rig: Rig, estimate: DeflectionEstimate | None, spots: SpotMeans, magnify: float) -> Any:
    """The MarkerArray of bent link, plate, detectors and dots; without ``estimate`` all of them are removed."""
    length = rig.link.length
    dx, dy, theta = (magnify * v for v in estimate.pose) if estimate is not None else (0.0, 0.0, 0.0)
    c, s = math.cos(theta), math.sin(theta)

    def placed(x: float, y: float, z: float) -> Vector:
        return dx + c * x - s * y, dy + s * x + c * y, length + z

    orientation = Quaternion(**quaternion(theta))
    link = _marker(0, 'link', Marker.LINE_STRIP, _METAL, (2 * rig.link.outer_radius, 0.0, 0.0))
    places = np.linspace(0.0, 1.0, 21)
    for u, part in zip(places.tolist(), bend(places).tolist(), strict=True):
        link.points.append(Point(x=dx * part, y=dy * part, z=length * u))
    (middle, size), *sensors = tip_boxes(rig)
    plate = _marker(0, 'plate', Marker.CUBE, _PLATE, size, placed(*middle))
    plate.pose.orientation = orientation
    out = [link, plate]
    for i, psd in enumerate(rig.psds):
        (cx, cy), (zx, zy) = psd.center, psd.zero
        sensor = _marker(i + 1, 'psd', Marker.CUBE, _SENSOR, sensors[i][1], placed(*sensors[i][0]))
        sensor.pose.orientation = orientation
        mx, my = spots.dots[2 * i], spots.dots[2 * i + 1]
        radius = 2.0 * psd.spot_radius
        where = placed(cx + zx + magnify * (mx - zx), cy + zy + magnify * (my - zy), psd.height - 0.002)
        dot = _marker(i + 1, 'dot', Marker.SPHERE, _LASER, (2 * radius, 2 * radius, 2 * radius), where)
        if spots.sums[i] < rig.estimator.sum_min or not (math.isfinite(mx) and math.isfinite(my)):
            dot.action = Marker.DELETE
        out += [sensor, dot]
    block_s = rig.estimator.block_size / rig.converter.sample_rate_hz
    seconds, nanoseconds = divmod(int(max(LIFETIME_S, 3.0 * block_s) * 1e9), 1_000_000_000)
    for marker in out:
        marker.header.stamp.sec, marker.header.stamp.nanosec = divmod(spots.t_ns, 1_000_000_000)
        marker.lifetime.sec, marker.lifetime.nanosec = seconds, nanoseconds
        if estimate is None:
            marker.action = Marker.DELETE
    return _of_rig(rig, out)


def _of_rig(rig: Rig, markers: list[Any]) -> Any:
    for marker in markers:
        marker.header.frame_id = rig.monitor.frame_prefix + BASE
    return MarkerArray(markers=markers)


class RigMarkers:
    """Publishes the last state of ``session`` ten times a second; nothing while it is None.

    The static parts are published again after a zero, because the beams then end at the new dots.
    """

    def __init__(self, node: Node, rig: Rig) -> None:
        self.session: Session | None = None
        self._node = node
        self._magnify = rig.monitor.markers_magnify
        self._observed = 0
        self._at_rest, self._moving = publisher_of(node, MARKERS_AT_REST), publisher_of(node, MARKERS)
        self._at_rest.publish(at_rest(rig))
        self._rest_of = rig
        self._timer = node.create_timer(PERIOD_S, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _publish(self) -> None:
        session = self.session
        if session is None:
            return
        estimate, spots = session.pipeline.last_estimate, session.pipeline.last_spots
        if spots is None or spots.t_ns == self._observed:
            return
        self._observed = spots.t_ns
        if session.rig is not self._rest_of:
            self._rest_of = session.rig
            self._at_rest.publish(at_rest(session.rig))
        self._moving.publish(moving(session.rig, estimate, spots, self._magnify))

    def close(self) -> None:
        """Take the publishers off the graph."""
        self._node.destroy_timer(self._timer)
        for publisher in (self._at_rest, self._moving):
            self._node.destroy_publisher(publisher)
