# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The robot's description from its latched topic."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from psd_deflection.base.log import null_log, texts

pytestmark = pytest.mark.ros
pytest.importorskip('rclpy')

from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from psd_deflection.base.errors import ConfigError  # noqa: E402
from psd_deflection.ros.description import robot_description  # noqa: E402
from psd_deflection.ros.running import ros  # noqa: E402
from psd_deflection.run.signals import Signals, StopRequestedError  # noqa: E402

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
URDF = '<robot name="arm"/>'


@pytest.fixture
def signals(domain: int) -> Iterator[Signals]:
    with ros('reader', ['--ros-args', '-r', '__ns:=/left']) as made:
        yield made


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
