# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What viewers are given: the tree of frames, latched markers and geometry, the robot's description."""

import contextlib
import importlib.util
import math
import os
import sys
from collections.abc import Callable, Iterator
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from visualization_msgs.msg import Marker

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import null_log, texts
from psd_deflection.records import BlockStatus, DeflectionEstimate, SpotMeans
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.ros.gate import robot_description
from psd_deflection.ros.markers import RigMarkers, at_rest, moving
from psd_deflection.ros.node import BaseNode
from psd_deflection.ros.running import ros
from psd_deflection.ros.sinks import TransformPublisher, static_transforms, tip_transform, topics_of
from psd_deflection.run.processing import RecordSink
from psd_deflection.run.realtime import Signals, StopRequestedError
from tools import control_msgs

pytestmark = pytest.mark.ros
AT_NS = 5_000_000_007


def estimate(primary: bool = True) -> DeflectionEstimate:
    return DeflectionEstimate(AT_NS, 0, 'exact', 1e-3, -2e-3, 0.01, 0.0, 0.0, (0.0,) * 9, 0.0, primary)


def tree(rig: Rig) -> dict[str, tuple[str, tuple[float, float, float]]]:
    """Child to its parent and its place there, m."""
    at = [(t, t.transform.translation) for t in (*static_transforms(rig, 0), tip_transform(rig, estimate()))]
    return {t.child_frame_id: (t.header.frame_id, (p.x, p.y, p.z)) for t, p in at}


def test_every_frame_of_the_messages_is_in_one_tree() -> None:
    rig = load_rig(overrides={'psd_2.height': 0.004})
    assert tree(rig) == {
        'link_tip_rest': ('link_base', (0.0, 0.0, 0.585)),
        'link_tip': ('link_tip_rest', (1e-3, -2e-3, 0.0)),
        'psd_1': ('link_tip', (0.0, 0.070, 0.0)),
        'psd_2': ('link_tip', (-0.100, 0.0, 0.004)),
    }
    moved = tip_transform(rig, estimate())
    assert moved.transform.rotation.z == pytest.approx(math.sin(0.005))
    assert (moved.header.stamp.sec, moved.header.stamp.nanosec) == (5, 7)


def test_a_prefix_keeps_two_rigs_apart() -> None:
    left, right = (tree(load_rig(overrides={'frame_prefix': f'{name}_'})) for name in ('left', 'right'))
    assert not left.keys() & right.keys()
    assert left['left_psd_1'][0] == 'left_link_tip'
    assert {parent for parent, _ in right.values()} == {'right_link_base', 'right_link_tip_rest', 'right_link_tip'}


def test_a_third_psd_has_its_frame_and_its_topics() -> None:
    third = {'psd_3.center': [0.08, -0.06], 'psd_3.height': 0.01}
    rig = load_rig(overrides={**third, 'publish_volts': True})
    assert tree(rig)['psd_3'] == ('link_tip', (0.08, -0.06, 0.01))
    two, three = topics_of(load_rig(overrides={'publish_volts': True})), topics_of(rig)
    assert set(three) - set(two) == {'/psd_3/spot', '/psd_3/volts'}
    assert not [topic for topic in two if 'psd_3' in topic]


def test_psds_at_the_base_do_not_move_with_the_tip() -> None:
    changed = {'solver': 'base_pair', 'solvers': ['base_pair'], 'psd_1.height': -0.5, 'psd_2.height': -0.585}
    frames = tree(load_rig(overrides=changed))
    assert frames['psd_1'] == ('link_tip_rest', (0.0, 0.070, -0.5))
    assert frames['psd_2'][0] == 'link_tip_rest'


class Node:
    """Keeps what is published, by topic. (Stands for rclpy's: its wheels have no tf2_msgs.)"""

    def __init__(self) -> None:
        self.sent: dict[str, list[Any]] = {}
        self.latched: dict[str, bool] = {}
        self.destroyed: list[Any] = []

    def create_publisher(self, kind: Any, topic: str, qos: QoSProfile, **more: Any) -> Any:
        self.latched[topic] = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        return SimpleNamespace(publish=self.sent.setdefault(topic, []).append)

    def destroy_publisher(self, publisher: Any) -> None:
        self.destroyed.append(publisher)


def test_the_tip_moves_with_each_primary_estimate_while_active(monkeypatch: pytest.MonkeyPatch) -> None:
    messages = ModuleType('tf2_msgs.msg')
    vars(messages)['TFMessage'] = SimpleNamespace
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', messages)
    node = Node()
    publisher = TransformPublisher(node, load_rig())
    sink: RecordSink = publisher
    sink.put(estimate())
    assert node.sent['/tf'] == []
    assert len(node.sent['/tf_static'][0].transforms) == 3
    assert node.latched == {'/tf': False, '/tf_static': True}
    publisher.active = True
    sink.put(estimate(primary=False))
    sink.put(estimate())
    (message,) = node.sent['/tf']
    assert [t.child_frame_id for t in message.transforms] == ['link_tip']
    publisher.close()
    assert len(node.destroyed) == 2


@pytest.mark.slow
@pytest.mark.skipif(not (control_msgs.installed('tf2_msgs') or control_msgs.buildable()), reason='needs g++')
def test_the_node_publishes_the_tree_by_default(
    start: Callable[..., Any], peer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not control_msgs.installed('tf2_msgs'):
        # It has no wheel.
        place = str(control_msgs.built('tf2_msgs'))
        monkeypatch.syspath_prepend(place)
        monkeypatch.setenv('PYTHONPATH', os.pathsep.join(filter(None, [place, os.environ.get('PYTHONPATH', '')])))
    from tf2_msgs.msg import TFMessage

    start('--ros-args', '-p', 'frame_prefix:=left_')
    moving = peer.collect(TFMessage, '/tf')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    fixed = peer.collect(TFMessage, '/tf_static', latched)
    peer.until(lambda: len(moving) >= 100 and len(fixed) > 0, 'transforms')
    assert {t.child_frame_id for t in fixed[0].transforms} == {'left_link_tip_rest', 'left_psd_1', 'left_psd_2'}
    assert {t.child_frame_id for m in moving for t in m.transforms} == {'left_link_tip'}
    for name in [name for name in sys.modules if name.startswith('tf2_msgs')]:
        del sys.modules[name]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec('tf2_msgs') is not None, reason='tf2_msgs is there')
def test_without_tf2_msgs_no_frames_are_reported(start: Callable[..., Any]) -> None:
    unasked = start()
    unasked.until('publishing on ROS')
    unasked.end()
    assert 'tf2_msgs' not in unasked.text
    start('--ros-args', '-p', 'publish_tf:=true').until(r'tf2_msgs is not installed: no frames on /tf \(publish_tf\)')


RIG = load_rig()


def spots(dots: tuple[float, float, float, float], sums: tuple[float, float] = (5.0, 5.0)) -> SpotMeans:
    return SpotMeans(5_000_000_007, 0, dots, sums, np.zeros((4, 4)), 20, 0, BlockStatus.OK, '')


def bent_by(dx: float = 0.0, dy: float = 0.0, theta: float = 0.0) -> DeflectionEstimate:
    return DeflectionEstimate(0, 0, 'exact', dx, dy, theta, 0.0, 0.0, (0.0,) * 9, 0.0, True)


def by_name(array: Any) -> dict[tuple[str, int], Any]:
    return {(m.ns, m.id): m for m in array.markers}


def test_at_rest_the_beams_meet_the_detectors() -> None:
    rest, now = by_name(at_rest(RIG)), by_name(moving(RIG, bent_by(), spots((0.0, 0.0, 0.0, 0.0)), 10.0))
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
    bent = bent_by(dx, dy, theta)
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
    scaled = by_name(moving(RIG, bent, spots((0.0, 0.0, 0.0, 0.0)), 10.0))
    assert scaled['link', 0].points[-1].y == pytest.approx(10.0 * dy)


def test_a_lost_dot_is_taken_away() -> None:
    now = by_name(moving(RIG, bent_by(), spots((0.0, 0.0, math.nan, 0.0), (0.1, 5.0)), 10.0))
    assert (now['dot', 1].action, now['dot', 2].action) == (Marker.DELETE, Marker.DELETE)
    assert now['psd', 1].action == now['link', 0].action == Marker.ADD


def test_markers_are_removed_without_an_estimate() -> None:
    dots = spots((0.0, 0.0, 0.0, 0.0))
    assert {m.action for m in moving(RIG, None, dots, 10.0).markers} == {Marker.DELETE}
    # Nor is what was measured a while ago, when nothing comes any more; at rest stays.
    assert {m.lifetime.sec for m in moving(RIG, bent_by(), dots, 10.0).markers} == {1}
    assert {m.lifetime.sec for m in at_rest(RIG).markers} == {0}
    slow = load_rig(overrides={'converter.sample_rate_hz': 10.0})
    assert {m.lifetime.sec for m in moving(slow, bent_by(), dots, 10.0).markers} == {6}


def test_markers_are_in_prefixed_frames() -> None:
    rig = load_rig(overrides={'frame_prefix': 'left_'})
    drawn = (*at_rest(rig).markers, *moving(rig, bent_by(), spots((0.0, 0.0, 0.0, 0.0)), 10.0).markers)
    assert {m.header.frame_id for m in drawn} == {'left_link_base'}


def test_markers_are_published_ten_times_a_second(peer: Any) -> None:
    with contextlib.closing(RigMarkers(peer.node, RIG)):
        assert [timer.timer_period_ns for timer in peer.node.timers] == [100_000_000]


LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
URDF = '<robot name="arm"/>'


@pytest.fixture
def signals(domain: int) -> Iterator[Signals]:
    with ros('reader', ['--ros-args', '-r', '__ns:=/left']) as made:
        yield made


class Bare(BaseNode[object]):
    def declare(self) -> Any:
        return None

    def set_up(self) -> None: ...


def test_diagnostics_are_published_each_second(signals: Signals) -> None:
    bare = Bare('bare', texts(list[str]().append))
    assert [timer.timer_period_ns for timer in bare.node.timers] == [1_000_000_000]
    bare.leave()


def test_what_was_published_before_is_heard(signals: Signals, peer: Any) -> None:
    publisher = peer.node.create_publisher(String, '/left/robot_description', LATCHED)
    publisher.publish(String(data=URDF))
    logged: list[str] = []
    assert robot_description(signals, texts(logged.append)) == URDF
    assert logged == ['waiting for the robot on /left/robot_description']


def test_if_nobody_publishes_it_the_error_says_so(signals: Signals) -> None:
    with pytest.raises(ConfigError, match=r'^/left/robot_description: no description .* \(nobody publishes it\)'):
        robot_description(signals, null_log, wait_s=0.0)


def test_an_empty_one_is_no_description(signals: Signals, peer: Any) -> None:
    publisher = peer.node.create_publisher(String, '/left/robot_description', LATCHED)
    publisher.publish(String(data=' '))
    reported: list[str] = []

    def clock() -> float:
        """Its time is over once the rejection was said."""
        return 10.0 * sum('rejected' in line for line in reported)

    with pytest.raises(ConfigError, match='it is empty'):
        robot_description(signals, texts(reported.append), wait_s=5.0, clock=clock)


@pytest.mark.slow
def test_a_signal_ends_the_waiting(signals: Signals) -> None:
    signals.stop = True
    with pytest.raises(StopRequestedError):
        robot_description(signals, null_log)
