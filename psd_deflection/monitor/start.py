"""Puts a page in front of a session: the few lines that the node and the command line share."""

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
    """Raise ConfigError, with the way out, where what the page needs is not installed."""
    if importlib.util.find_spec('aiohttp') is None:
        raise ConfigError(
            "the live page needs aiohttp: `pip install 'psd_deflection[monitor]'` or `apt install python3-aiohttp`, "
            'or run without monitor'
        )


def start_monitor(session: Session, say: Callable[[str], None]) -> MonitorServer | None:
    """Serve ``session`` where its rig says ``monitor``; else None. The session's sinks gain one.

    ``say`` is told the address. Raises ConfigError where it cannot be served.
    """
    if not session.rig.monitor.enabled:
        return None
    need_server()
    # Only here: whoever does not look on does without aiohttp.
    from psd_deflection.monitor.server import MonitorServer

    feed = Feed()
    server = MonitorServer(ShownSession(session), feed, session.rig.monitor, say)
    server.start()
    # Behind what is published and recorded.
    session.processing.sinks.append(feed)
    session.listeners.append(server.tell)
    return server
