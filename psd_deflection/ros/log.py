# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node's log: each line on the terminal, on ``/rosout`` and in the log file that rcl began for this process.

The terminal's lines do not go through the ROS log, because the live line is among them. So the
lines are put on ``/rosout`` and into the file here, as rcl does with those of other nodes. A thread
writes the file: a disk that hangs holds up nothing.
"""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import time
from pathlib import Path

from rcl_interfaces.msg import Log
from rclpy.logging import LoggingSeverity, get_logging_directory
from rclpy.node import Node

from psd_deflection.base.log import INFO, LogCallback
from psd_deflection.ros.endpoints import publisher_of
from psd_deflection.ros.topics import ROSOUT

MOST_LINES = 1000
"""Lines that wait for a slow disk; further ones are not in the file."""
JOIN_S = 0.2
"""Time limit for the last lines to reach the disk."""


def rcl_log_file() -> Path | None:
    """The file of this process, ``PROGRAM_PID_TIME.log``; None if rcl writes none (``--disable-external-lib-logs``)."""
    with contextlib.suppress(OSError):
        return max(
            get_logging_directory().glob(f'*_{os.getpid()}_*.log'), key=lambda f: f.stat().st_mtime_ns, default=None
        )
    return None


class NodeLog:
    """Call it with a line. ``log`` puts it on the terminal; what ``--log-level`` leaves out goes nowhere."""

    def __init__(self, node: Node, log: LogCallback) -> None:
        self._log = log
        self._logger = node.get_logger()
        self._publisher = publisher_of(node, ROSOUT)
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        file = rcl_log_file()
        if file is not None:
            self._thread = threading.Thread(target=self._write, args=(file,), name='log', daemon=True)
            self._thread.start()

    def __call__(self, text: str, level: int = INFO, /) -> None:
        """Log one line, from any thread."""
        severity = LoggingSeverity(level)
        if not self._logger.is_enabled_for(severity):
            return
        line = Log(level=level, name=self._logger.name, msg=text)
        line.stamp.sec, line.stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
        # The terminal comes last: who reads a line there finds it in the file.
        if self._thread is not None and self._lines.qsize() < MOST_LINES:
            seconds = f'{line.stamp.sec}.{line.stamp.nanosec:09d}'
            self._lines.put(f'[{severity.name}] [{seconds}] [{self._logger.name}]: {text}\n')
        # An abandoned thread may log a line after the node is gone.
        with contextlib.suppress(RuntimeError):
            self._publisher.publish(line)
        self._log(text, level)

    def close(self) -> None:
        """Write the last lines."""
        if self._thread is not None:
            self._lines.put(None)
            self._thread.join(JOIN_S)

    def _write(self, file: Path) -> None:
        # The daemon measures on without a log.
        with contextlib.suppress(OSError), file.open('a', 1, 'utf-8', 'backslashreplace') as stream:
            while (line := self._lines.get()) is not None:
                stream.write(line)
