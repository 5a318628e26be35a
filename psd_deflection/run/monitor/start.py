# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Starts the views of a session, for the node and the command line: the page, Foxglove."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import LogCallback
from psd_deflection.base.plugins import optional
from psd_deflection.run.diagnostics import HealthReporter
from psd_deflection.run.fanout import Fanout
from psd_deflection.run.monitor.feed import Feed
from psd_deflection.run.monitor.served import need_server
from psd_deflection.run.monitor.shown import ShownSession
from psd_deflection.run.processing import RecordSink
from psd_deflection.run.rig_publisher import RigPublisher
from psd_deflection.run.session import Session

if TYPE_CHECKING:
    from psd_deflection.run.monitor.server import MonitorServer


class Views:
    """What shows a session: its page, its Foxglove server, both or neither."""

    def __init__(self) -> None:
        self.closers: list[Callable[[], None]] = []  # Bound: three views.

    def close(self) -> None:
        """End all of them."""
        for close in reversed(self.closers):
            close()


def start_views(session: Session, log: LogCallback, *, reports: bool = True) -> Views:
    """Serve ``session`` as its parameters ``monitor`` and ``foxglove`` say. They add sinks and wires to the session.

    ``log`` gets each address as a line. ``reports``: whether Foxglove needs reports of the run's health; False if
    somebody puts them to the session's fan-out. Raises ConfigError if something cannot be served.
    """
    views = Views()
    try:
        if session.rig.monitor.enabled:
            views.closers.append(_start_page(session, log).close)
        if session.rig.monitor.foxglove:
            _start_foxglove(session, log, views, reports)
    except BaseException:
        views.close()
        raise
    return views


def _start_page(session: Session, log: LogCallback) -> MonitorServer:
    need_server()
    # Imported here: only the page needs aiohttp.
    from psd_deflection.run.monitor.server import MonitorServer

    feed = Feed()
    server = MonitorServer(ShownSession(session), feed, session.rig.monitor, log)
    server.start()
    # After publishing and recording.
    session.processing.sinks.append(feed)
    session.input_sinks.append(feed)
    session.listeners.append(server.notify)
    return server


def _start_foxglove(session: Session, log: LogCallback, views: Views, reports: bool) -> None:
    need_server()
    server = foxglove().FoxgloveServer(session.rig, log)
    views.closers.append(server.close)
    log(server.words())
    fanout = Fanout(session.rig.monitor.frame_prefix)
    fanout.sinks.append(server)
    rig_reported = RigPublisher(server, session)
    rig_reported.notify()
    session.fanout.sinks.append(server)
    session.fanout.change_sinks.append(rig_reported)
    session.input_sinks.append(fanout)
    if reports:
        views.closers.append(Reports(session, fanout).close)


def foxglove() -> Any:
    """The module of the optional server, which needs aiohttp. Raises ConfigError if it is not there."""
    module = optional('psd_deflection.run.monitor.foxglove')
    if module is None:
        raise ConfigError('foxglove = true: this installation has no run/monitor/foxglove.py')
    return module


class Reports:
    """Puts the run's health to ``sink``, once a second, from a thread of its own."""

    def __init__(self, session: Session, sink: RecordSink) -> None:
        self._session = session
        self._sink = sink
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name='reports', daemon=True)
        self._thread.start()

    def _run(self) -> None:
        health = HealthReporter(self._session)
        while not self._stop.wait(1.0):
            self._sink.put(health.report(self._session.acquisition.now_ns()))

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()
