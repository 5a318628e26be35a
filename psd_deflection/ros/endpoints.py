# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes publishers from the rows of :mod:`psd_deflection.ros.topics`, and what subscriptions need
of a row."""

import importlib
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions

from msg_adapters import Delivery
from psd_deflection.base.bounds import RateLimit
from psd_deflection.base.errors import ConfigError, PsdDeflectionError
from psd_deflection.ros.declared import SOURCE
from psd_deflection.ros.topics import PUBLISHED, GraphTopic


def message_class(type_name: str) -> Any:
    """The class of ``pkg/msg/Name``."""
    package, _, name = type_name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), name)


def action_class(type_name: str) -> Any:
    """The class of ``pkg/action/Name``. Raises ConfigError if it is not installed."""
    package, _, name = type_name.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.action'), name)
    except (ImportError, AttributeError):
        apt = f'ros-{os.environ.get("ROS_DISTRO", "jazzy")}-{package.replace("_", "-")}'
        raise ConfigError(f'{package} is not installed: apt install {apt}') from None


def qos(delivery: Delivery) -> QoSProfile:
    """The QoS profile of ``delivery``."""
    depth, reliable, latched = delivery
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def graph_name(row: GraphTopic, below: str = '') -> str:
    """The name of ``row`` in the node's namespace, so that two rigs can share a graph.

    Without a namespace this is the topic's own name. ``below``: a further namespace, for a node of
    several rigs.
    """
    return row.name if row.common else (below + row.name).removeprefix('/')


def overriding(row: GraphTopic) -> QoSOverridingOptions | None:
    """Whether parameters may change the QoS of ``row``."""
    return QoSOverridingOptions.with_default_policies() if row.overridable else None


def rejected_qos(error: Exception) -> ConfigError:
    """The error of a ``qos_overrides`` parameter that ROS does not take."""
    return ConfigError(f'{SOURCE}: qos_overrides: {error}')


def publisher_of(node: Node, topic: str, below: str = '') -> Publisher:
    """The publisher of ``topic``, by its row: the one place where any is made.

    ``below``: as of :func:`graph_name`. Raises KeyError for a topic without a row, ImportError if
    its message is not installed, and ConfigError for a QoS override that ROS does not take.
    """
    row = PUBLISHED[topic]
    kind = message_class(row.type)
    try:
        return node.create_publisher(
            kind, graph_name(row, below), qos(row.delivery), qos_overriding_options=overriding(row)
        )
    except (InvalidQosOverridesError, ValueError, RuntimeError) as error:
        raise rejected_qos(error) from None


FAILURES = (PsdDeflectionError, ArithmeticError, ValueError, LookupError, TypeError, AttributeError)
"""What a message of a strange content can cause; scipy's and numpy's errors of linear algebra are ValueErrors."""
OF_RCLPY = (*FAILURES, RuntimeError, MemoryError)
RESULT_KEPT_S = 10
"""How long the result of a goal may be asked for after its end, s; a client asks when the goal is accepted."""
MOST_ASKED = 200
"""Requests to cancel, and for results, that are looked at within a second."""


class _Guarded:
    """``reject``: is told why something that came is not taken."""

    reject: Callable[[str], None]

    def take_data(self) -> Mapping[str, Any]:
        """As of rclpy's."""
        try:
            return dict(super().take_data())  # type: ignore[misc]
        except OF_RCLPY:
            # Its reason is that of the library, with paths of the machine that built it.
            self.reject('no message of this type')
            return {}

    async def execute(self, taken_data: Mapping[str, Any]) -> None:
        """As of rclpy's, one after the other: what fails takes nothing with it."""
        for what, content in taken_data.items():
            try:
                await super().execute({what: content})  # type: ignore[misc]
            except OF_RCLPY as error:
                self.reject(f'{what}: {type(error).__name__}: {error}')


class GuardedServer(_Guarded, ActionServer):  # type: ignore[misc]
    """Serves the action ``name`` of the class ``kind``.

    ``asked``: whether a goal is taken. ``accepted``: gets the handle of each that is; it runs until :meth:`finish`.
    ``cancelled``: gets that of one that is to be cancelled.
    """

    def __init__(
        self,
        node: Any,
        kind: Any,
        name: str,
        reject: Callable[[str], None],
        asked: Callable[[Any], Any],
        accepted: Callable[[Any], None],
        cancelled: Callable[[Any], None],
    ) -> None:
        self.reject = reject
        self._asked_for = RateLimit(MOST_ASKED)

        def run(handle: ServerGoalHandle) -> None:
            handle.execute()
            accepted(handle)

        def cancel(handle: ServerGoalHandle) -> CancelResponse:
            cancelled(handle)
            return CancelResponse.ACCEPT

        super().__init__(
            node,
            kind,
            name,
            lambda handle: kind.Result(),
            goal_callback=asked,
            handle_accepted_callback=run,
            cancel_callback=cancel,
            result_timeout=RESULT_KEPT_S,
        )

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Any) -> None:
        """A goal begins: rclpy runs nothing of it."""

    def finish(self, handle: ServerGoalHandle, end: Callable[[ServerGoalHandle], Any]) -> None:
        """The goal is over: ``end`` says so to its handle and gives its result."""
        super().notify_execute(handle, end)

    def take_data(self) -> Mapping[str, Any]:
        """As of rclpy's."""
        out = dict(super().take_data())
        for what in ('cancel', 'result'):
            if what in out and not self._asked_for.allows(time.monotonic()):
                del out[what]
                self.reject(f'more than {MOST_ASKED} requests a second')
        return out


class GuardedClient(_Guarded, ActionClient):  # type: ignore[misc]
    """A client of the action ``name`` of the class ``kind``."""

    def __init__(self, node: Any, kind: Any, name: str, reject: Callable[[str], None]) -> None:
        self.reject = reject
        super().__init__(node, kind, name)
