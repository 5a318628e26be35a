"""rclpy from its start to its end, for every node that runs until a signal stops it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from psd_deflection.base.errors import ConfigError
from psd_deflection.run.signals import Signals

SPIN_S = 0.1
"""Longest time until a signal takes effect, s."""


@contextlib.contextmanager
def ros(name: str, arguments: Sequence[str]) -> Iterator[Signals]:
    """Start rclpy with the ROS ``arguments`` of the program ``name``, and end it; SIGINT and SIGTERM set what is given.

    Raises ConfigError if rclpy does not take the arguments.
    """
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
        signals.restore()


@contextlib.contextmanager
def executor_of(node: Node) -> Iterator[SingleThreadedExecutor]:
    """An executor that serves ``node`` in the thread that spins it."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        yield executor
    finally:
        executor.remove_node(node)
        executor.shutdown(timeout_sec=0.2)
