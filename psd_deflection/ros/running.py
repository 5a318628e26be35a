# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""rclpy from its start to its end, for every node that runs until a signal stops it."""

import contextlib
import os
import threading
from collections.abc import Iterator, Sequence

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from psd_deflection.base.errors import ConfigError
from psd_deflection.run.realtime import Signals

SPIN_S = 0.1
"""Longest time until a signal takes effect, s."""
WAKE_S = 0.2
"""Longest wait for messages and timers if the system clock is set back, s."""
TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
OTHER_CHOICES = (TRANSPORTS, 'FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
"""With one of these the user has chosen the transports of Fast DDS."""


@contextlib.contextmanager
def ros(name: str, arguments: Sequence[str], shared_memory: bool = False) -> Iterator[Signals]:
    """Start rclpy with the ROS ``arguments`` of the program ``name``, and end it; SIGINT and SIGTERM set what is given.

    ``shared_memory``: its messages are large, so that Fast DDS is to use it. A process that was killed in it may leave
    the others deaf (https://github.com/eProsima/Fast-DDS/issues/5053), so what need not use it does not. Raises
    ConfigError if rclpy does not take the arguments.
    """
    if not shared_memory and not any(choice in os.environ for choice in OTHER_CHOICES):
        os.environ[TRANSPORTS] = 'UDPv4'
    signals = Signals()
    try:
        try:
            rclpy.init(args=[name, *arguments], signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:
            raise ConfigError('ROS arguments: ' + str(error).splitlines()[0]) from None
        try:
            yield signals
        finally:
            rclpy.try_shutdown()
    finally:
        signals.restore_handlers()


@contextlib.contextmanager
def executor_of(node: Node) -> Iterator[SingleThreadedExecutor]:
    """An executor that serves ``node`` in the thread that spins it.

    Fast DDS waits until a time of the system clock: set back by an hour, a wait lasts as long. So a thread ends each.
    """
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    ended = threading.Event()

    def wake() -> None:
        while not ended.wait(WAKE_S):
            executor.wake()

    waker = threading.Thread(target=wake, name='waker', daemon=True)
    waker.start()
    try:
        yield executor
    finally:
        ended.set()
        waker.join()
        executor.remove_node(node)
        executor.shutdown(timeout_sec=0.2)
