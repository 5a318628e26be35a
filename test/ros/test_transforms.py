# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The tree of frames: complete, true to scale, and one for each rig."""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip('rclpy')

from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402

from psd_deflection.records import DeflectionEstimate  # noqa: E402
from psd_deflection.rig.config import Rig, load_rig  # noqa: E402
from psd_deflection.ros.sinks import topics_of  # noqa: E402
from psd_deflection.ros.transforms import TransformPublisher, static_transforms, tip_transform  # noqa: E402
from psd_deflection.run.processing import RecordSink  # noqa: E402

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
    found = tree(load_rig(overrides=changed))
    assert found['psd_1'] == ('link_tip_rest', (0.0, 0.070, -0.5))
    assert found['psd_2'][0] == 'link_tip_rest'


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
@pytest.mark.skipif(importlib.util.find_spec('tf2_msgs') is None, reason='tf2_msgs comes with a ROS installation')
def test_the_node_publishes_the_tree_by_default(start: Callable[..., Any], peer: Any) -> None:
    from tf2_msgs.msg import TFMessage

    start('--ros-args', '-p', 'frame_prefix:=left_')
    moving = peer.collect(TFMessage, '/tf')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    fixed = peer.collect(TFMessage, '/tf_static', latched)
    peer.until(lambda: len(moving) >= 100 and len(fixed) > 0, 'transforms')
    assert {t.child_frame_id for t in fixed[0].transforms} == {'left_link_tip_rest', 'left_psd_1', 'left_psd_2'}
    assert {t.child_frame_id for m in moving for t in m.transforms} == {'left_link_tip'}


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec('tf2_msgs') is not None, reason='tf2_msgs is there')
def test_without_tf2_msgs_no_frames_are_reported(
    start: Callable[..., Any],
) -> None:
    unasked = start()
    unasked.until('publishing on ROS')
    unasked.end()
    assert 'tf2_msgs' not in unasked.text
    start('--ros-args', '-p', 'publish_tf:=true').until(r'tf2_msgs is not installed: no frames on /tf \(publish_tf\)')
