# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The gate: what is bounded before it is unpacked, and who is told that his messages do not come."""

import math
from collections.abc import Iterator
from typing import Any, cast

import pytest
import rclpy
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from bench.campaign.attacked import NODES
from msg_adapters import INPUTS, LATCHED, LOAD, MARK, Delivery
from psd_deflection.base.log import INFO, WARNING
from psd_deflection.ros.endpoints import qos
from psd_deflection.ros.gate import InputGate, frame_fault, quaternion_fault, stamp_fault
from psd_deflection.ros.topics import HEARD, GraphTopic
from test.ros.test_conformance import nodes_of_setup

pytestmark = pytest.mark.ros
TOPIC = '/said'
KEPT = Delivery(50)


class Gated:
    """A gate on a node of the peer's own executor."""

    def __init__(self, peer: Any) -> None:
        self.logged: list[str] = []
        self.levels: list[int] = []
        self.heard: list[str] = []
        self.node = rclpy.create_node('gated', context=peer.context)
        peer.executor.add_node(self.node)
        self.now = 100.0
        self.gate = InputGate(self.node, self._log, lambda: self.now)

    def _log(self, text: str, level: int = INFO, /) -> None:
        self.logged.append(text)
        self.levels.append(level)

    def listen(self) -> None:
        self.gate.listen(
            TOPIC,
            lambda message: 'empty' if not message.data else '',
            lambda message: self.heard.append(message.data),
            TOPIC,
        )


ROW = GraphTopic(TOPIC, 'std_msgs/msg/String', 'gated', 'words', KEPT)


def heard_as(monkeypatch: pytest.MonkeyPatch, row: GraphTopic = ROW) -> None:
    """Give the topic a row."""
    monkeypatch.setitem(cast(dict[str, Any], HEARD), TOPIC, (row,))


@pytest.fixture
def gated(peer: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Gated]:
    heard_as(monkeypatch)
    made = Gated(peer)
    yield made
    peer.executor.remove_node(made.node)
    made.node.destroy_node()


def sender(peer: Any, delivery: Any = 50) -> Any:
    publisher = peer.node.create_publisher(String, TOPIC, delivery)
    peer.until(lambda: peer.node.count_subscribers(TOPIC) > 0, 'the gate')
    return publisher


@pytest.mark.parametrize(
    ('row', 'most'), [(ROW, 1_000_000), (ROW._replace(most_bytes=HEARD[MARK][0].most_bytes), 4096)]
)
def test_good_ones_are_taken_and_others_counted_and_reported(
    peer: Any, gated: Gated, monkeypatch: pytest.MonkeyPatch, row: GraphTopic, most: int
) -> None:
    heard_as(monkeypatch, row)
    gated.listen()
    publisher = sender(peer)

    def sent() -> bool:
        for text in ('good', '', 'x' * most):
            publisher.publish(String(data=text))
        return bool(gated.heard) and gated.gate.rejected[TOPIC] >= 2

    peer.until(sent, 'the messages')
    assert set(gated.heard) == {'good'}
    size = f'{most + 9} bytes: must be at most {most}'
    assert set(gated.logged) == {f'{TOPIC}: rejected: empty', f'{TOPIC}: rejected: {size}'}
    assert set(gated.levels) == {WARNING}
    count, why = gated.gate.values()
    assert count == (f'messages rejected: {TOPIC}', str(gated.gate.rejected[TOPIC]))
    assert why[0] == f'rejected last: {TOPIC}'
    assert f'{TOPIC}: rejected: {why[1]}' in gated.logged


def test_a_text_that_is_no_text_ends_nothing(peer: Any, gated: Gated) -> None:
    gated.listen()
    publisher = sender(peer)
    # CDR, little-endian: a string of two bytes and a zero that are no UTF-8.
    wrong = b'\x00\x01\x00\x00\x03\x00\x00\x00\xff\xfe\x00'

    def sent() -> bool:
        publisher.publish(wrong)
        publisher.publish(String(data='good'))
        return bool(gated.heard) and (gated.gate.rejected[TOPIC] > 0 or len(gated.heard) > 20)

    peer.until(sent, 'the good one')
    assert 'good' in gated.heard


@pytest.mark.slow
def test_a_flood_is_cut_off_until_the_next_second(peer: Any, gated: Gated) -> None:
    gated.listen()
    publisher = sender(peer)

    def flooded() -> bool:
        for _ in range(20):
            publisher.publish(String(data='x'))
        return gated.gate.rejected[TOPIC] > 0

    peer.until(flooded, 'the end of the flood')
    assert (len(gated.heard), gated.gate.why[TOPIC]) == (2000, 'more than 2000 messages a second')
    gated.now += 1.0
    peer.until(lambda: not flooded() or len(gated.heard) > 2000, 'the next second')


def test_a_volatile_publisher_gets_no_latched_subscription(
    peer: Any, gated: Gated, monkeypatch: pytest.MonkeyPatch
) -> None:
    """DDS would warn it of messages that do not come, while they do. One that keeps its message is heard, however late
    the gate listens."""
    rows = ROW._replace(delivery=Delivery(1)), ROW._replace(delivery=LATCHED)
    monkeypatch.setitem(cast(dict[str, Any], HEARD), TOPIC, rows)
    warned: list[Any] = []
    publisher = peer.node.create_publisher(
        String, TOPIC, 1, event_callbacks=PublisherEventCallbacks(incompatible_qos=warned.append)
    )
    gated.listen()

    def heard(text: str) -> bool:
        gated.gate.subscribe_to_kept()
        return text in gated.heard

    peer.until(lambda: publisher.publish(String(data='now')) or heard('now'), 'what is not kept')
    assert not warned
    peer.node.destroy_publisher(publisher)
    publisher = peer.node.create_publisher(String, TOPIC, qos(LATCHED))
    publisher.publish(String(data='before'))
    peer.until(lambda: heard('before'), 'what was kept')


def test_unreliable_load_publisher_rejected_by_name(peer: Any, gated: Gated, monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds until the next: a lost one would be a wrong label of all that follows."""
    assert [topic for topic in INPUTS if HEARD[topic][0].delivery.reliable] == [LOAD, MARK]
    heard_as(monkeypatch, ROW._replace(delivery=HEARD[LOAD][0].delivery))
    gated.listen()
    peer.node.create_publisher(String, TOPIC, QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT))
    peer.until(lambda: gated.gate.rejected[TOPIC] > 0, 'the publisher that is best effort')
    assert 'a publisher is best effort, and this has to be reliable' in gated.logged[0]


def test_every_node_is_attacked() -> None:
    assert set(NODES) == set(nodes_of_setup())


def test_a_stamp_a_frame_and_a_rotation_are_what_is_wanted() -> None:
    assert stamp_fault(0, 0) == stamp_fault(5, 999_999_999) == ''
    assert all(stamp_fault(*wrong) for wrong in ((-1, 5), (5, -1), (5, 1_000_000_000)))
    assert frame_fault('', 'base') == frame_fault('base', 'base') == ''
    assert 'must be base' in frame_fault('tip', 'base')
    assert quaternion_fault((0.0, 0.6, 0.0, 0.8)) == ''
    for wrong in ((0.0, 0.0, 0.0, 0.0), (0.0, 0.6, 0.0, 0.9), (math.nan, 0.0, 0.0, 1.0), (0.0, 0.0, 1e300, 0.0)):
        assert quaternion_fault(wrong)
