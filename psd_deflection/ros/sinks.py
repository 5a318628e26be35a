# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Connects a session to the graph: publishers of encoded messages, subscriptions that are recorded."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from msg_adapters import DIAGNOSTICS, TOPIC_TYPES, vector3_stamped
from psd_deflection.base.log import null_log
from psd_deflection.model.solvers.registry import solver_class
from psd_deflection.recordings import cdr
from psd_deflection.records import Record, SampleBlock, TemperatureReading
from psd_deflection.rig.config import Rig
from psd_deflection.ros.endpoints import publisher_of
from psd_deflection.ros.gate import InputGate
from psd_deflection.ros.inputs import input_fault
from psd_deflection.ros.topics import VOLTS
from psd_deflection.run.fanout import published
from psd_deflection.run.session import Session


def topics_of(rig: Rig) -> tuple[str, ...]:
    """The topics that a node of ``rig`` publishes encoded messages on. Raises ConfigError for an unknown solver."""
    for name in rig.estimator.solvers:
        solver_class(name)
    volts = VOLTS[: len(rig.psds)] if rig.monitor.publish_volts else ()
    return (*published(rig), *volts)


class PublisherSink:
    """Publishes encoded messages: a wire of the fan-out. While it is not ``active``, diagnostics alone.

    ``below``: namespace of the topics in that of the node.
    """

    def __init__(self, node: Node, topics: Iterable[str], below: str = '') -> None:
        self.active = False
        self._node = node
        self._below = below
        self._publishers: dict[str, Publisher] = {}
        self.offer(topics)

    def offer(self, topics: Iterable[str]) -> None:
        """Publish exactly these topics from now on. Only while no session runs."""
        topics = tuple(topics)
        for topic in [t for t in self._publishers if t not in topics]:
            self._node.destroy_publisher(self._publishers.pop(topic))
        for topic in [t for t in topics if t not in self._publishers]:
            self._publishers[topic] = publisher_of(self._node, topic, self._below)

    def names(self, topics: Iterable[str]) -> list[str]:
        """Names of the topics on the graph, including remapping."""
        return [self._publishers[topic].topic_name for topic in topics]

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Publish; the stamp is in the message."""
        if self.active or topic == DIAGNOSTICS:
            self._publishers[topic].publish(cdr)


class VoltsPublisher:
    """A sink of records: each raw sample as plain numbers, which plots draw; the bag has them as ``/psd/samples``."""

    def __init__(self, sink: PublisherSink, frame_prefix: str) -> None:
        self._sink = sink
        self._frame_prefix = frame_prefix
        self._encode = cdr.encoder_of(vector3_stamped.MESSAGE)

    def put(self, record: Record) -> None:
        """Publish the samples of a block."""
        if isinstance(record, SampleBlock) and self._sink.active:
            for psd, topic in enumerate(VOLTS[: record.volts.shape[1] // 3], 1):
                for t_ns, fields in vector3_stamped.from_block(record, psd, self._frame_prefix):
                    self._sink.put(topic, vector3_stamped.MESSAGE.name, self._encode(fields), t_ns)


class InputRecorder(InputGate):
    """Gives the session what other nodes say, as it arrives and if it can be used.

    ``session``: the one that takes it, or None. It counts and says what is rejected. ``below``: as
    of :class:`PublisherWire`.
    """

    def __init__(self, node: Node, topics: Iterable[str], below: str = '') -> None:
        super().__init__(node, null_log)
        self.session: Session | None = None
        self._below = below
        self._subscriptions: dict[str, list[Subscription]] = {}
        self.offer(topics)

    def offer(self, topics: Iterable[str]) -> None:
        """Subscribe to exactly these topics from now on. Only while no session runs."""
        topics = tuple(topics)
        for topic in [t for t in self._subscriptions if t not in topics]:
            for subscription in self._subscriptions.pop(topic):
                self._node.destroy_subscription(subscription)
        for topic in [t for t in topics if t not in self._subscriptions]:
            check, take = partial(self._fault, topic), partial(self._take, topic)
            self._subscriptions[topic] = self.listen(topic, check, take, (self._below + topic).removeprefix('/'))

    def unpack(self, kind: Any, encoded: bytes) -> bytes:
        """The message as it came: the session records these bytes."""
        return bytes(encoded)

    def reject(self, topic: str, why: str) -> None:
        """Let the session count it and say why."""
        if self.session is not None:
            self.session.reject_input('/' + topic.removeprefix(self._below).removeprefix('/'), why)

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
                self.session.reject_input(topic, str(error))
