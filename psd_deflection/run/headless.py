# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Runs a session or a chain without ROS, until a signal ends it."""

import time
from collections.abc import Callable, Mapping
from typing import Protocol, TypeVar

from psd_deflection.base.log import LogCallback
from psd_deflection.rig.config import rig_from_values
from psd_deflection.run.realtime import Signals, StopRequestedError, Watchdog, settle
from psd_deflection.run.session import Session

LOOK_S = 0.1


class Companion(Protocol):
    """Something that runs beside a session, such as its live page."""

    def close(self) -> None:
        """End it, before the session."""


class Run(Protocol):
    """What runs: a session or a chain. ``failed``: the error that ended it, or None."""

    @property
    def alive(self) -> bool:
        """Whether it still runs."""

    @property
    def failed(self) -> BaseException | None:
        """The error that ended it, or None."""

    def responsive(self) -> bool:
        """Whether its threads completed a round lately."""

    def start(self) -> None:
        """Let samples flow."""

    def close(self) -> object:
        """End it."""


R = TypeVar('R', bound=Run)


def run_headless(
    values: Mapping[str, object],
    log: LogCallback,
    watch: Callable[[Session], None],
    start_companion: Callable[[Session, LogCallback], Companion | None],
) -> int:
    """Run a session with these parameters until SIGINT, SIGTERM or SIGHUP; return the exit status.

    ``watch``: called every 0.1 s. ``start_companion``: called before samples flow. Raises the error that ended
    the session.
    """

    def begin() -> Session:
        return Session(rig_from_values(values, 'command line'), log)

    return run_until_signal(begin, watch, lambda session: start_companion(session, log))


def run_until_signal(
    begin: Callable[[], R],
    watch: Callable[[R], object],
    start_companion: Callable[[R], Companion | None] = lambda run: None,
) -> int:
    """Run what ``begin`` opens until SIGINT, SIGTERM or SIGHUP, or until ``watch`` returns True; return 0.

    ``watch``: called every 0.1 s. ``start_companion``: called before samples flow. Raises the error that ended
    the run.
    """
    signals = Signals()
    try:
        return _run_until(signals, begin, watch, start_companion)
    except StopRequestedError:
        return 0
    finally:
        signals.restore_handlers()


def _run_until(
    signals: Signals,
    begin: Callable[[], R],
    watch: Callable[[R], object],
    start_companion: Callable[[R], Companion | None],
) -> int:
    run = signals.interruptible(begin)
    watchdog = Watchdog()
    companion = None
    try:
        settle()
        companion = start_companion(run)
        run.start()
        watchdog.ready()
        while not signals.stop and run.alive:
            time.sleep(LOOK_S)
            if run.responsive():
                watchdog.alive()
            if watch(run) is True:
                break
    finally:
        watchdog.stopping()
        if companion is not None:
            companion.close()
        run.close()
    if run.failed is not None:
        raise run.failed
    return 0
