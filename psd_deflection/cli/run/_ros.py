# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What has to be there before rclpy is imported."""

from __future__ import annotations

import importlib.util

from psd_deflection.base.errors import ConfigError, MachineError
from psd_deflection.run.realtime import SHARED_MEMORY, shared_memory_left

NEEDED_BYTES = 65_536
"""The tracing of ROS 2 maps two pages of shared memory as it is imported; without room the system ends it by SIGBUS."""


def require_ros(otherwise: str = '') -> None:
    """Raise ConfigError if rclpy is not installed, MachineError if shared memory is full. ``otherwise``: what to do
    instead, from ', ' on."""
    if importlib.util.find_spec('rclpy') is None:
        raise ConfigError(
            f"rclpy is not installed: source your ROS 2, or `pip install 'psd_deflection[ros]'`{otherwise}"
        )
    left = shared_memory_left()
    if left < NEEDED_BYTES:
        raise MachineError(
            f'{SHARED_MEMORY} has {left} bytes left, ROS 2 needs {NEEDED_BYTES}: delete what nobody uses there, or '
            f'make it larger (docker run --shm-size){otherwise}'
        )
