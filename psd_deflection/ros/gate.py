# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What other nodes send, messages and goals, comes in through one gate: bounded in size and rate, checked, and what
cannot be used is rejected, counted and said once. No message ends a node."""

import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rclpy.action import GoalResponse
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.subscription import Subscription

from psd_deflection.base.bounds import BoundedMap, RateLimit, Tally
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import WARNING, LogCallback
from psd_deflection.base.text import sanitize
from psd_deflection.ros.endpoints import (
    FAILURES,
    GuardedClient,
    GuardedServer,
    action_class,
    graph_name,
    message_class,
    overriding,
    qos,
    rejected_qos,
)
from psd_deflection.ros.running import SPIN_S, executor_of
from psd_deflection.ros.topics import HEARD, MOST_GOALS, ROBOT_DESCRIPTION, SERVED, GraphTopic
from psd_deflection.run.rate_limited_log import RateLimitedLog
from psd_deflection.run.realtime import Signals, StopRequestedError

LONGEST = 200
"""Characters of a reason, in which a stranger's words may be."""
NEWS = 3
"""Rejections of a topic that are said one by one, before they are counted and said together."""
MOST_A_SECOND = 2000
"""Messages of one topic that are looked at within a second."""
UNIT_WITHIN = 1e-3
"""How far the length of a quaternion may be from 1."""


class InputGate:
    """Subscriptions of ``node``. ``log`` gets the rejections. ``clock``: monotonic, s.

    ``rejected``: messages by topic; ``why``: the last reason of each.
    """

    def __init__(self, node: Node, log: LogCallback, clock: Callable[[], float] = time.monotonic) -> None:
        self._node, self._clock = node, clock
        self._limited_log = RateLimitedLog(log)
        # By topic: what subscribes to messages that were kept, once there are any.
        self._latched: dict[str, Callable[[], None]] = {}  # Bound: the latched inputs of a node.
        self.rejected = Tally()
        self.why: BoundedMap[str, str] = BoundedMap()

    def listen(
        self, topic: str, check: Callable[[Any], str], take: Callable[[Any], None], name: str = '', type_name: str = ''
    ) -> list[Subscription]:
        """Subscribe to ``topic``, by its first row: ``take`` gets each message that ``check`` finds nothing wrong with.

        A further row, which is latched, waits until :meth:`subscribe_to_kept` finds a publisher for it.
        ``name``: on the graph, if it is not the topic's own. ``type_name``: of the message, if a parameter names it.
        A publisher whose messages cannot come, because they have to be reliable, counts as a rejection. Raises KeyError
        for a topic without a row, ImportError if its message is not installed, and ConfigError for a QoS override that
        ROS does not take.
        """
        subscriptions: list[Subscription] = []

        def subscribe(row: GraphTopic) -> None:
            subscriptions.append(self._subscribe(row, check, take, name or graph_name(row), type_name or row.type))

        first, *latched = HEARD[topic]
        subscribe(first)
        for row in latched:
            self._latched[name or graph_name(row)] = functools.partial(subscribe, row)
        return subscriptions

    def serve(
        self,
        action: str,
        check: Callable[[Any], str],
        accepted: Callable[[Any], None],
        cancelled: Callable[[Any], None],
    ) -> GuardedServer:
        """Serve ``action``, by its row: ``accepted`` gets the handle of each goal that ``check`` lets in, ``cancelled``
        that of one that is to be cancelled.

        Raises KeyError for an action without a row, and ConfigError if its type is not installed.
        """
        row, rate = SERVED[action], RateLimit(MOST_GOALS)

        def asked(goal: Any) -> GoalResponse:
            why = self._let_in(len(serialize_message(goal)), row.most_bytes, rate, 'goals')
            why = why or self._taken(goal, check, lambda _: None)
            if why:
                self.reject(row.name, why)
            return GoalResponse.REJECT if why else GoalResponse.ACCEPT

        reject, kind = functools.partial(self.reject, row.name), action_class(row.type)
        return GuardedServer(self._node, kind, row.name, reject, asked, accepted, cancelled)

    def ask(self, action: str, name: str) -> GuardedClient:
        """A client of the action ``name`` of another node, of the type of ``action``.

        Raises as :meth:`serve`, and what rclpy raises for a name that is none.
        """
        return GuardedClient(self._node, action_class(SERVED[action].type), name, functools.partial(self.reject, name))

    def take_in(self) -> None:
        """Take the messages that have come, while a transition keeps the executor waiting.

        To be called in the executor's thread.
        """
        for subscription in self._node.subscriptions:
            if not subscription.raw:
                # Those of rclpy itself, such as that of /clock.
                continue
            for _ in range(subscription.qos_profile.depth):
                with subscription.handle:
                    taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if taken is None:
                    break
                subscription.callback(taken[0])

    def _subscribe(
        self, row: GraphTopic, check: Callable[[Any], str], take: Callable[[Any], None], name: str, type_name: str
    ) -> Subscription:
        kind, rate = message_class(type_name), RateLimit(MOST_A_SECOND)

        def heard(encoded: bytes) -> None:
            why = self._let_in(len(encoded), row.most_bytes, rate) or self._carry_out(kind, encoded, check, take)
            if why:
                self.reject(name, why)

        def hidden(event: Any) -> None:
            if event.last_policy_kind == QoSPolicyKind.RELIABILITY:
                self.reject(name, 'a publisher is best effort, and this has to be reliable: none of its messages come')

        try:
            return self._node.create_subscription(
                kind,
                name,
                heard,
                qos(row.delivery),
                raw=True,
                event_callbacks=SubscriptionEventCallbacks(incompatible_qos=hidden),
                qos_overriding_options=overriding(row),
            )
        except (InvalidQosOverridesError, ValueError, RuntimeError) as error:
            raise rejected_qos(error) from None

    def unpack(self, kind: Any, encoded: bytes) -> Any:
        """The message that check and take get."""
        return deserialize_message(encoded, kind)

    def reject(self, topic: str, why: str) -> None:
        """Count a message and say why it is rejected."""
        self.rejected.add(topic)
        self.why[topic] = sanitize(why, LONGEST)
        self._limited_log.log(topic, f'{topic}: rejected: {self.why[topic]}', WARNING, self._clock(), NEWS)

    def subscribe_to_kept(self) -> None:
        """Subscribe by the latched rows for which a publisher now keeps its messages; to be called now and then.

        DDS warns each publisher that keeps none of such a subscription, though another one gets its messages.
        """
        for topic, subscribe in tuple(self._latched.items()):
            publishers = self._node.get_publishers_info_by_topic(topic)
            if any(info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in publishers):
                del self._latched[topic]
                subscribe()

    def settle(self) -> None:
        """Say what was counted and is due; to be called now and then."""
        self._limited_log.settle(self._clock())

    def values(self) -> list[tuple[str, str]]:
        """For the node's diagnostics."""
        counts = sorted(self.rejected.items())
        return [
            *((f'messages rejected: {topic}', str(count)) for topic, count in counts),
            *((f'rejected last: {topic}', self.why[topic]) for topic, _ in counts),
        ]

    def _let_in(self, size: int, most_bytes: int, rate: RateLimit, what: str = 'messages') -> str:
        """Why a message is not even looked at, or ''."""
        if size > most_bytes:
            return f'{size} bytes: must be at most {most_bytes}'
        return '' if rate.allows(self._clock()) else f'more than {rate.most} {what} a second'

    def _carry_out(self, kind: Any, encoded: bytes, check: Callable[[Any], str], take: Callable[[Any], None]) -> str:
        """Take the message, or give the reason why not."""
        try:
            message = self.unpack(kind, encoded)
        except (*FAILURES, RuntimeError, MemoryError):
            # Its reason is that of the library, with paths of the machine that built it.
            return f'{len(encoded)} bytes: no message of this type'
        return self._taken(message, check, take)

    def _taken(self, message: Any, check: Callable[[Any], str], take: Callable[[Any], None]) -> str:
        try:
            why = check(message)
            if not why:
                take(message)
        except FAILURES as error:
            return f'{type(error).__name__}: {error}'
        return why


class GatedNode(LifecycleNode):  # type: ignore[misc]
    """A node, of which a subscription that rclpy itself makes, as that of ``/clock``, cannot end it either.

    ``gate``: where what fails is rejected, once there is one.
    """

    gate: InputGate | None = None

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *more: Any, **options: Any
    ) -> Subscription:
        """As of rclpy's node."""

        def guarded(message: Any) -> None:
            try:
                callback(message)
            except FAILURES as error:
                if self.gate is not None:
                    self.gate.reject(topic, str(error))

        return super().create_subscription(msg_type, topic, guarded, *more, **options)


WAIT_S = 30.0
"""Time limit for it, s."""


def listen_to_description(gate: InputGate, take: Callable[[str], None]) -> None:
    """Let ``take`` have each text on ``robot_description``, the one that was published before, too.

    A ConfigError of ``take`` rejects it.
    """
    gate.listen(ROBOT_DESCRIPTION, _fault, lambda message: take(message.data))


def robot_description(
    signals: Signals, log: LogCallback, wait_s: float = WAIT_S, clock: Callable[[], float] = time.monotonic
) -> str:
    """The text on ``robot_description`` in the namespace that the ROS arguments give; rclpy is started.

    Raises ConfigError if none comes in ``wait_s``, s, and StopRequestedError if a signal comes
    before it.
    """
    heard: list[str] = []
    node = Node(f'{ROBOT_DESCRIPTION}_reader', start_parameter_services=False)
    try:
        gate = InputGate(node, log)
        listen_to_description(gate, heard.append)
        topic = node.resolve_topic_name(ROBOT_DESCRIPTION)
        log(f'waiting for the robot on {topic}')
        until = clock() + wait_s
        with executor_of(node) as executor:
            while not heard:
                if signals.stop:
                    raise StopRequestedError
                if clock() >= until:
                    why = gate.why.get(
                        ROBOT_DESCRIPTION, 'nobody publishes it' if not node.count_publishers(topic) else 'none came'
                    )
                    raise ConfigError(f'{topic}: no description of the robot in {wait_s:g} s ({why}); give a URDF file')
                executor.spin_once(timeout_sec=SPIN_S)
    finally:
        node.destroy_node()
    return heard[0]


def _fault(message: Any) -> str:
    return '' if message.data.strip() else 'it is empty'


def quaternion_fault(quaternion: Sequence[float]) -> str:
    """Why (x, y, z, w) is no rotation; '' if it is one."""
    length = math.sqrt(math.fsum(v * v for v in quaternion)) if np.all(np.abs(quaternion) < 2.0) else math.nan
    return '' if abs(length - 1.0) <= UNIT_WITHIN else 'its orientation is no unit quaternion'


def stamp_fault(seconds: int, nanoseconds: int) -> str:
    """Why a stamp is none; '' if it is one."""
    if seconds < 0 or not 0 <= nanoseconds < 1_000_000_000:
        return f'stamp {seconds} s {nanoseconds} ns: is no time'
    return ''


def frame_fault(frame: str, wanted: str) -> str:
    """Why ``frame`` is not the frame that is ``wanted``; '' if it is, or if it is not given."""
    return '' if frame in ('', wanted) else f'frame_id {frame!r}: must be {wanted}'
