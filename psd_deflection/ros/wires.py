"""Connects a session to the graph: publishers of encoded messages, subscriptions that are recorded."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from msg_adapters import (
    DIAGNOSTICS,
    TOPIC_TYPES,
    vector3_stamped,
)
from psd_deflection.base.log import unsaid
from psd_deflection.recordings import cdr
from psd_deflection.records import Record, SampleBlock, TemperatureReading
from psd_deflection.rig.config import Rig
from psd_deflection.ros.gate import InputGate
from psd_deflection.ros.inputs import input_fault
from psd_deflection.ros.names import VOLTS, delivery
from psd_deflection.run.fanout import published
from psd_deflection.run.session import Session

MAX_INPUT_BYTES = 4096
"""Maximum size of a message of another node that we record, bytes; valid ones have some hundred bytes."""


def message_class(type_name: str) -> Any:
    """The class of ``pkg/msg/Name``."""
    package, _, name = type_name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), name)


def relative(topic: str, below: str = '') -> str:
    """``topic`` as a relative name in the node's namespace, so that two rigs can share a graph.

    Without a namespace this is the topic's own name. ``below``: a further namespace, for a node of several rigs.
    ``/diagnostics`` stays absolute, as is usual.
    """
    return topic if topic == DIAGNOSTICS else (below + topic).removeprefix('/')


def qos(topic: str) -> QoSProfile:
    """QoS profile of ``topic``."""
    depth, reliable, latched = delivery(topic)
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def topics_of(rig: Rig) -> dict[str, str]:
    """The topics that a node of ``rig`` publishes encoded messages on, with their types."""
    volts = VOLTS[: len(rig.psds)] if rig.monitor.publish_volts else ()
    return published(rig) | dict.fromkeys(volts, vector3_stamped.MESSAGE.name)


class PublisherWire:
    """Publishes encoded messages: a wire of the fan-out. While it is not ``active``, diagnostics alone.

    ``below``: namespace of the topics in that of the node.
    """

    def __init__(self, node: Node, topics: Mapping[str, str], below: str = '') -> None:
        self.active = False
        self._node = node
        self._below = below
        self._publishers: dict[str, Publisher] = {}
        self.offer(topics)

    def offer(self, topics: Mapping[str, str]) -> None:
        """Publish exactly these topics (name to type) from now on. Only while no session runs."""
        for topic in [t for t in self._publishers if t not in topics]:
            self._node.destroy_publisher(self._publishers.pop(topic))
        options = QoSOverridingOptions.with_default_policies()
        for topic in [t for t in topics if t not in self._publishers]:
            self._publishers[topic] = self._node.create_publisher(
                message_class(topics[topic]), relative(topic, self._below), qos(topic), qos_overriding_options=options
            )

    def names(self, topics: Iterable[str]) -> list[str]:
        """Names of the topics on the graph, including remapping."""
        return [self._publishers[topic].topic_name for topic in topics]

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Publish; the stamp is in the message."""
        if self.active or topic == DIAGNOSTICS:
            self._publishers[topic].publish(cdr)


class VoltsPublisher:
    """A sink of records: each raw sample as plain numbers, which plots draw; the bag has them as ``/psd/samples``."""

    def __init__(self, wire: PublisherWire, frame_prefix: str) -> None:
        self._wire = wire
        self._frame_prefix = frame_prefix
        self._encode = cdr.encoder_of(vector3_stamped.MESSAGE)

    def put(self, record: Record) -> None:
        """Publish the samples of a block."""
        if isinstance(record, SampleBlock) and self._wire.active:
            for psd, topic in enumerate(VOLTS[: record.volts.shape[1] // 3], 1):
                for t_ns, fields in vector3_stamped.from_block(record, psd, self._frame_prefix):
                    self._wire.put(topic, vector3_stamped.MESSAGE.name, self._encode(fields), t_ns)


class InputRecorder(InputGate):
    """Gives the session what other nodes say, as it arrives and if it can be used.

    ``session``: the one that takes it, or None. It counts and says what is refused. ``below``: as of
    :class:`PublisherWire`.
    """

    def __init__(self, node: Node, topics: Iterable[str], below: str = '') -> None:
        super().__init__(node, unsaid)
        self.session: Session | None = None
        self._below = below
        self._subscriptions: dict[str, Subscription] = {}
        self.offer(topics)

    def offer(self, topics: Iterable[str]) -> None:
        """Subscribe to exactly these topics from now on. Only while no session runs."""
        topics = tuple(topics)
        for topic in [t for t in self._subscriptions if t not in topics]:
            self._node.destroy_subscription(self._subscriptions.pop(topic))
        for topic in [t for t in topics if t not in self._subscriptions]:
            kind, name = message_class(TOPIC_TYPES[topic]), relative(topic, self._below)
            check, take = partial(self._fault, topic), partial(self._take, topic)
            self._subscriptions[topic] = self.listen(kind, name, check, take, qos(topic), MAX_INPUT_BYTES)

    def unpack(self, kind: Any, encoded: bytes) -> bytes:
        """The message as it came: the session records these bytes."""
        return bytes(encoded)

    def refuse(self, topic: str, why: str) -> None:
        """Let the session count it and say why."""
        if self.session is not None:
            self.session.refuse_input('/' + topic.removeprefix(self._below).removeprefix('/'), why)

    def _fault(self, topic: str, message: bytes) -> str:
        session = self.session
        if session is None:
            return ''
        fields = cdr.decode(TOPIC_TYPES[topic], message)
        return input_fault(topic, fields, session.rig, session.acquisition.now_ns())

    def _take(self, topic: str, message: bytes) -> None:
        if self.session is None:
            return
        record = self.session.take_input(topic, message)
        if isinstance(record, TemperatureReading):
            try:
                self.session.temperature(record.celsius)
            except TimeoutError as error:
                self.session.refuse_input(topic, str(error))
