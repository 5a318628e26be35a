# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The robot's description (URDF) as ROS 2 has it: latched on ``robot_description``, from
robot_state_publisher."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import LogCallback
from psd_deflection.ros.gate import InputGate
from psd_deflection.ros.running import SPIN_S, executor_of
from psd_deflection.ros.topics import ROBOT_DESCRIPTION
from psd_deflection.run.signals import Signals, StopRequestedError

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
