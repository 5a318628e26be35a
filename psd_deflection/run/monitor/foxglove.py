"""Serves what is measured to Foxglove, without ROS: the messages of the graph, over Foxglove's WebSocket protocol.

The protocol is foxglove-sdk's (https://docs.foxglove.dev/docs/sdk). Messages are the ones that ROS and the recording
get: the same topics, types (``ros2msg``) and bytes (CDR). A slow viewer loses its oldest messages; we wait for none.
Viewers can only look: the server offers neither publishing nor services nor parameters.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from typing import TYPE_CHECKING

from msg_adapters import MESSAGE_TYPES, RIG, TOPIC_TYPES
from psd_deflection import __version__
from psd_deflection.base.errors import ConfigError
from psd_deflection.recordings.provenance import provenance
from psd_deflection.records import ParameterChange, Record, RigState, SpotMeans
from psd_deflection.rig.config import Rig
from psd_deflection.rig.declarations import MonitorConfig
from psd_deflection.run.fanout import Fanout, published, subscribed
from psd_deflection.run.monitor.feed import Feed

if TYPE_CHECKING:
    import foxglove
    from foxglove.websocket import ChannelView, Client, WebSocketServer

VIEWER = 'in Foxglove: Open connection'


SETTLED_S = 0.2
"""So long after a viewer has asked for a topic it gets what is sent."""


class FoxgloveServer:
    """A wire of the fan-out. Serves from construction on; ``address``: its WebSocket URL.

    Raises ConfigError if foxglove-sdk is not installed or the address cannot be served on.
    """

    def __init__(self, rig: Rig) -> None:
        # Imported here: only this view needs it.
        try:
            import foxglove
        except ImportError:
            raise ConfigError(
                "foxglove needs foxglove-sdk: `pip install 'psd_deflection[foxglove]'`, or run without it and open the "
                "recording's .mcap"
            ) from None
        # It logs each viewer that comes and goes.
        logging.getLogger('foxglove').setLevel(logging.ERROR)
        self._sdk = foxglove
        self._context = foxglove.Context()
        self._lock = threading.Lock()
        self._channels: dict[str, foxglove.Channel] = {}
        self._rig: tuple[bytes, int] | None = None
        self._repeat_at = math.inf
        # Before anybody looks: foxglove-sdk offers a new channel to a viewer that it does not let subscribe to it yet.
        for topic, type_name in (published(rig) | {name: TOPIC_TYPES[name] for name in subscribed(rig)}).items():
            self._offer(topic, type_name)
        self._server = self._serve(rig.monitor)
        self.address = f'ws://{rig.monitor.foxglove_address}:{self._server.port}'

    def _serve(self, config: MonitorConfig) -> WebSocketServer:
        server = self

        class Listener(self._sdk.ServerListener):  # type: ignore[misc, name-defined]
            """The server's thread tells it of each viewer that looks at a topic."""

            def on_subscribe(self, client: Client, channel: ChannelView) -> None:
                if channel.topic == RIG:
                    # What is sent now would not reach it: it is told before its subscription holds.
                    server._repeat_at = time.monotonic() + SETTLED_S

        ports = [config.foxglove_port] + [0] * (config.foxglove_port != 0)
        for port in ports:
            try:
                return self._sdk.start_server(
                    name='psd_deflection',
                    host=config.foxglove_address,
                    port=port,
                    context=self._context,
                    server_listener=Listener(),
                )
            except RuntimeError as error:
                reason = str(error)
        raise ConfigError(f'foxglove_address {config.foxglove_address}: {reason}')

    def _offer(self, topic: str, type_name: str) -> None:
        with self._lock:
            if topic not in self._channels:
                self._channels[topic] = self._sdk.Channel(
                    topic,
                    schema=self._sdk.Schema(
                        name=type_name, encoding='ros2msg', data=MESSAGE_TYPES[type_name].definition.encode()
                    ),
                    message_encoding='cdr',
                    context=self._context,
                )

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Send a message to those who look at its topic."""
        if topic not in self._channels:
            self._offer(topic, type_name)
        if topic == RIG:
            # Sent again to who comes later, as a latched topic is.
            self._rig = cdr, t_ns
        self._channels[topic].log(cdr, log_time=t_ns)
        if time.monotonic() >= self._repeat_at and self._rig is not None:
            self._repeat_at = math.inf
            message, t_ns = self._rig
            self._channels[RIG].log(message, log_time=t_ns)

    def words(self) -> str:
        """The address, and where to open it, as a line."""
        return f'foxglove: {self.address} ({VIEWER})'

    def close(self) -> None:
        """End the connections."""
        self._server.stop()


class FeedBeside(Feed):
    """A feed of the page whose records go to Foxglove too, for a recording that is played with ``rig``."""

    def __init__(self, server: FoxgloveServer, rig: Rig) -> None:
        super().__init__()
        self._present = dict(rig.flat())
        self._told = False
        self._fanout = Fanout(rig.monitor.frame_prefix)
        self._fanout.wires.append(server)

    def put(self, record: Record) -> None:
        """Take one record."""
        super().put(record)
        self._fanout.put(record)
        if isinstance(record, ParameterChange):
            self._tell(record.t_ns, record.block, dict(record.values))
        elif isinstance(record, SpotMeans) and not self._told:
            self._tell(record.t_ns, record.index, {})

    def _tell(self, t_ns: int, block: int, changed: dict[str, object]) -> None:
        self._told = True
        self._present |= changed
        self._fanout.put(RigState(t_ns, block, self._present, None, changed, __version__, provenance()))
