# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes publishers from the rows of :mod:`psd_deflection.ros.topics`, and what subscriptions need
of a row."""

from __future__ import annotations

import importlib
import os
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions

from msg_adapters import Delivery
from psd_deflection.base.errors import ConfigError
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
