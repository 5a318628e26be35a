"""Runs a session without ROS, until a signal ends it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Protocol

from psd_deflection.config import Rig, rig_from_values
from psd_deflection.runner.realtime import Watchdog, settle
from psd_deflection.runner.session import Session
from psd_deflection.runner.signals import Signals, StopRequestedError

LOOK_S = 0.1

Say = Callable[[str], None]


class Companion(Protocol):
    """Something that runs beside a session, such as its live page."""

    def close(self) -> None:
        """End it, before the session."""


def run_headless(
    values: Mapping[str, object],
    say: Say,
    watch: Callable[[Session], None],
    start_companion: Callable[[Session, Say], Companion | None],
) -> int:
    """Run a session with these parameters until SIGINT, SIGTERM or SIGHUP; return the exit status.

    ``watch``: called every 0.1 s. ``start_companion``: called before samples flow. Raises the error that ended
    the session.
    """
    signals = Signals()
    try:
        return _run_until(signals, rig_from_values(values, 'command line'), say, watch, start_companion)
    except StopRequestedError:
        return 0
    finally:
        signals.restore()


def _run_until(
    signals: Signals,
    rig: Rig,
    say: Say,
    watch: Callable[[Session], None],
    start_companion: Callable[[Session, Say], Companion | None],
) -> int:
    session = signals.interruptible(lambda: Session(rig, say))
    watchdog = Watchdog()
    companion = None
    try:
        settle()
        companion = start_companion(session, say)
        session.start()
        watchdog.ready()
        while not signals.stop and session.processing.alive:
            time.sleep(LOOK_S)
            if session.responsive():
                watchdog.alive()
            watch(session)
    finally:
        watchdog.stopping()
        if companion is not None:
            companion.close()
        session.close()
    if session.failed is not None:
        raise session.failed
    return 0
