# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What RViz is given: latched geometry at rest, and what moves with the estimate."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.ros
pytest.importorskip('rclpy')

from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from visualization_msgs.msg import Marker, MarkerArray  # noqa: E402

from psd_deflection.records import BlockStatus, DeflectionEstimate, SpotMeans  # noqa: E402
from psd_deflection.rig.config import load_rig  # noqa: E402
from psd_deflection.ros.markers import at_rest, moving  # noqa: E402

RIG = load_rig()


def spots(dots: tuple[float, float, float, float], sums: tuple[float, float] = (5.0, 5.0)) -> SpotMeans:
    return SpotMeans(5_000_000_007, 0, dots, sums, np.zeros((4, 4)), 20, 0, BlockStatus.OK, '')


def estimate(dx: float = 0.0, dy: float = 0.0, theta: float = 0.0) -> DeflectionEstimate:
    return DeflectionEstimate(0, 0, 'exact', dx, dy, theta, 0.0, 0.0, (0.0,) * 9, 0.0, True)


def by_name(array: Any) -> dict[tuple[str, int], Any]:
    return {(m.ns, m.id): m for m in array.markers}


def test_at_rest_the_beams_meet_the_detectors() -> None:
    rest, now = by_name(at_rest(RIG)), by_name(moving(RIG, estimate(), spots((0.0, 0.0, 0.0, 0.0)), 10.0))
    for number, psd in enumerate(RIG.psds, 1):
        start, end = rest['beam', number].points
        assert (start.x, start.y, start.z) == (*psd.center, 0.0)
        assert (end.x, end.y, end.z) == (*psd.center, RIG.link.length)
        place = now['psd', number].pose.position
        assert (place.x, place.y, place.z) == (*psd.center, RIG.link.length)
        dot = now['dot', number].pose.position
        assert (dot.x, dot.y) == psd.center
    stamp = now['plate', 0].header.stamp
    assert (stamp.sec, stamp.nanosec) == (5, 7)


def test_plate_follows_estimate_and_dot_stays_on_beam() -> None:
    dx, dy, theta = 1e-4, -2e-4, 1e-3
    bent = estimate(dx, dy, theta)
    c, s = math.cos(theta), math.sin(theta)
    dots = []
    for cx, cy in (psd.center for psd in RIG.psds):
        x, y = cx - dx, cy - dy
        # c + m = Rz(-theta)(l - d)
        dots += [c * x + s * y - cx, -s * x + c * y - cy]
    now = by_name(moving(RIG, bent, spots((dots[0], dots[1], dots[2], dots[3])), 1.0))
    for number, psd in enumerate(RIG.psds, 1):
        dot = now['dot', number].pose.position
        assert (dot.x, dot.y) == pytest.approx(psd.center, abs=1e-12)
    tip = now['link', 0].points[-1]
    assert (tip.x, tip.y, tip.z) == pytest.approx((dx, dy, RIG.link.length))
    assert now['psd', 1].pose.orientation.z == pytest.approx(math.sin(theta / 2))
    far = by_name(moving(RIG, bent, spots((0.0, 0.0, 0.0, 0.0)), 10.0))
    assert far['link', 0].points[-1].y == pytest.approx(10.0 * dy)


def test_a_lost_dot_is_taken_away() -> None:
    now = by_name(moving(RIG, estimate(), spots((0.0, 0.0, math.nan, 0.0), (0.1, 5.0)), 10.0))
    assert now['dot', 1].action == Marker.DELETE
    assert now['dot', 2].action == Marker.DELETE
    assert now['psd', 1].action == now['link', 0].action == Marker.ADD


def test_markers_are_removed_without_an_estimate() -> None:
    dots = spots((0.0, 0.0, 0.0, 0.0))
    assert {m.action for m in moving(RIG, None, dots, 10.0).markers} == {Marker.DELETE}
    # Nor is what was measured a while ago, when nothing comes any more; at rest stays.
    assert {m.lifetime.sec for m in moving(RIG, estimate(), dots, 10.0).markers} == {1}
    assert {m.lifetime.sec for m in at_rest(RIG).markers} == {0}
    slow = load_rig(overrides={'converter.sample_rate_hz': 10.0})
    assert {m.lifetime.sec for m in moving(slow, estimate(), dots, 10.0).markers} == {6}


@pytest.mark.slow
def test_a_late_rviz_sees_both(start: Callable[..., Any], peer: Any) -> None:
    start('--ros-args', '-p', 'markers:=true')
    moves = peer.collect(MarkerArray, '/link_tip/markers')
    peer.until(lambda: len(moves) >= 5, 'moving markers')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    rest = peer.collect(MarkerArray, '/link_tip/markers_at_rest', latched)
    peer.until(lambda: len(rest) >= 1, 'the latched markers')
    assert {m.ns for m in rest[0].markers} == {'link_at_rest', 'laser', 'beam'}
    assert {m.ns for m in moves[-1].markers} == {'link', 'plate', 'psd', 'dot'}
    # The beams stand where the unloaded dots are.
    put = Parameter('psd_1.zero', value=[0.001, 0.0]).to_parameter_msg()
    peer.call(SetParameters, '/estimator/set_parameters', SetParameters.Request(parameters=[put]))
    x = RIG.psds[0].center[0] + 0.001
    peer.until(lambda: by_name(rest[-1])['beam', 1].points[0].x == pytest.approx(x), 'the beam at the new zero')


def test_markers_are_in_prefixed_frames() -> None:
    rig = load_rig(overrides={'frame_prefix': 'left_'})
    drawn = (*at_rest(rig).markers, *moving(rig, estimate(), spots((0.0, 0.0, 0.0, 0.0)), 10.0).markers)
    assert {m.header.frame_id for m in drawn} == {'left_link_base'}
