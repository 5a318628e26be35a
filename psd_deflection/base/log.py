# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Lines for people, each with its severity beside it: what formats a line cannot lose it.

The severities are the numbers of :mod:`logging`, which are those of ROS too.
"""

from collections.abc import Callable
from typing import Protocol

INFO, WARNING, ERROR = 20, 30, 40


class Note(str):
    """A text among warnings that reports no fault, only what was taken for granted."""


class LogCallback(Protocol):
    """Takes one line for people, from any thread."""

    def __call__(self, text: str, level: int = INFO, /) -> None:
        """``level``: information, ``WARNING`` for what somebody should look at, ``ERROR`` for what does not work."""


def texts(take: Callable[[str], object]) -> LogCallback:
    """What says a line by giving its text alone to ``take``."""

    def log(text: str, level: int = INFO, /) -> None:
        take(text)

    return log


def null_log(text: str, level: int = INFO, /) -> None:
    """Say nothing."""
