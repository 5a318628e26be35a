"""Starts the page of a session, for the node and the command line."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import TYPE_CHECKING

from psd_deflection.errors import ConfigError
from psd_deflection.monitor.feed import Feed
from psd_deflection.monitor.shown import ShownSession
from psd_deflection.runner.session import Session

if TYPE_CHECKING:
    from psd_deflection.monitor.server import MonitorServer


def need_server() -> None:
    """Raise ConfigError, with the fix, if aiohttp is not installed."""
    if importlib.util.find_spec('aiohttp') is None:
        raise ConfigError(
            "the live page needs aiohttp: `pip install 'psd_deflection[monitor]'` or `apt install python3-aiohttp`, "
            'or run without monitor'
        )


def start_monitor(session: Session, say: Callable[[str], None]) -> MonitorServer | None:
    """Serve ``session`` if its rig has ``monitor`` set; else None. It adds a sink to the session.

    ``say`` gets the address as a line. Raises ConfigError if it cannot be served.
    """
    if not session.rig.monitor.enabled:
        return None
    need_server()
    # Imported here: only the page needs aiohttp.
    from psd_deflection.monitor.server import MonitorServer

    feed = Feed()
    server = MonitorServer(ShownSession(session), feed, session.rig.monitor, say)
    server.start()
    # After publishing and recording.
    session.processing.sinks.append(feed)
    session.input_sinks.append(feed)
    session.listeners.append(server.tell)
    return server
