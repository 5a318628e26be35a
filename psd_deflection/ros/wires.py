"""Connects a session to the graph: publishers of encoded messages, subscriptions that are recorded."""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rcl_interfaces.msg import Log
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from msg_adapters import DIAGNOSTICS, INPUTS, TOPIC_TYPES, to_messages
from psd_deflection import __version__
from psd_deflection.errors import Failed, Warned
from psd_deflection.recordings import cdr
from psd_deflection.records import ENVIRONMENT, ParameterChange, RigState, TemperatureReading
from psd_deflection.ros.names import delivery
from psd_deflection.runner.session import Session

MAX_INPUT_BYTES = 4096
"""Maximum size of a message of another node that we record, bytes; valid ones have some hundred bytes."""


def message_class(type_name: str) -> Any:
    """The class of ``pkg/msg/Name``."""
    package, _, name = type_name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), name)


def relative(topic: str) -> str:
    """``topic`` as a relative name in the node's namespace, so that two rigs can share a graph.

    Without a namespace this is the topic's own name. ``/diagnostics`` stays absolute, as is usual.
    """
    return topic if topic == DIAGNOSTICS else topic.removeprefix('/')


def qos(topic: str) -> QoSProfile:
    """QoS profile of ``topic``."""
    depth, reliable, latched = delivery(topic)
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class PublisherWire:
    """Publishes encoded messages: a wire of the fan-out. While it is not ``active``, diagnostics alone."""

    def __init__(self, node: Node, topics: Mapping[str, str]) -> None:
        self.active = False
        options = QoSOverridingOptions.with_default_policies()
        self._publishers: dict[str, Publisher] = {}
        for topic, type_name in topics.items():
            self._publishers[topic] = node.create_publisher(
                message_class(type_name), relative(topic), qos(topic), qos_overriding_options=options
            )

    def names(self, topics: Iterable[str]) -> list[str]:
        """Names of the topics on the graph, including remapping."""
        return [self._publishers[topic].topic_name for topic in topics]

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Publish; the stamp is in the message."""
        if self.active or topic == DIAGNOSTICS:
            self._publishers[topic].publish(cdr)


class RigPublisher:
    """Publishes rig, zero and hello of ``session``: on activation, at each change, and if the hello changes.

    Changes come in the pipeline thread, between two blocks. Our own recordings hold the same without it.
    """

    def __init__(self, wire: PublisherWire, session: Session) -> None:
        self._wire = wire
        self._session = session
        self._told: Mapping[str, object] | None = None
        self._last = ParameterChange(0, 0, ())
        self._environment: dict[str, object] = {}

    def put_change(self, change: ParameterChange) -> None:
        """Publish the rig after ``change``."""
        self._last = change
        self._environment |= {name: value for name, value in change.values if name in ENVIRONMENT}
        self._publish(dict(change.values))

    def tell(self, again: bool = True) -> None:
        """Publish the present rig; with ``again`` False only if the hello is another than the one that was told."""
        if again or self._hello() != self._told:
            self._publish(self._environment)

    def _hello(self) -> Mapping[str, object] | None:
        hello = self._session.acquisition.hello
        return None if hello is None else hello.info

    def _publish(self, changed: Mapping[str, object]) -> None:
        self._told = self._hello()
        state = RigState(self._last.t_ns, self._last.block, self._session.rig.flat(), self._told, changed, __version__)
        for message in to_messages(state):
            self._wire.put(message.topic, message.type, cdr.encode(message.type, message.fields), time.time_ns())


def severity(text: str) -> LoggingSeverity:
    """Severity of a line that a session says."""
    if isinstance(text, Failed):
        return LoggingSeverity.ERROR
    return LoggingSeverity.WARN if isinstance(text, Warned) else LoggingSeverity.INFO


def say_on_rosout(node: Node, say: Callable[[str], None]) -> Callable[[str], None]:
    """Call ``say`` and also write the line to ``/rosout``: the terminal's lines do not go through the ROS log."""
    as_every_node = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(Log, '/rosout', as_every_node)
    logger = node.get_logger()
    name = logger.name

    def both(text: str) -> None:
        level = severity(text)
        # What --log-level leaves out.
        if not logger.is_enabled_for(level):
            return
        say(text)
        line = Log(level=int(level), name=name, msg=text)
        line.stamp.sec, line.stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
        # An abandoned thread may log a line after the node is gone.
        with contextlib.suppress(RuntimeError):
            publisher.publish(line)

    return both


class InputRecorder:
    """Records known loads, references and temperatures as they arrive.

    ``session``: the one that records, or None. A message that is too long for its type is ignored and
    counted in ``refused``, so that another node cannot fill the disk.
    """

    def __init__(self, node: Node) -> None:
        self.session: Session | None = None
        self.refused = 0
        for topic in INPUTS:
            node.create_subscription(
                message_class(TOPIC_TYPES[topic]),
                relative(topic),
                lambda message, topic=topic: self._received(topic, message),
                qos(topic),
                raw=True,
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )

    def _received(self, topic: str, message: bytes) -> None:
        if len(message) > MAX_INPUT_BYTES:
            self.refused += 1
        elif self.session is not None:
            record = self.session.take_input(topic, bytes(message))
            try:
                if record is None:
                    self.refused += 1
                elif isinstance(record, TemperatureReading):
                    self.session.temperature(record.celsius)
            except TimeoutError:
                self.refused += 1
