# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Serves the messages of the graph to Foxglove, without ROS (``foxglove.websocket.v1``): the same topics, types and
bytes. A slow viewer loses its oldest messages; viewers can only look."""

import asyncio
import contextlib
import json
import secrets
import struct
import threading
from collections import deque
from collections.abc import Coroutine
from typing import Any

from aiohttp import WSMessage, WSMsgType, web

from msg_adapters import MESSAGE_TYPES, RIG, TOPIC_TYPES
from psd_deflection import __version__
from psd_deflection.base.bounds import MESSAGE_BYTES, ByteBudget
from psd_deflection.base.log import LogCallback, null_log
from psd_deflection.recordings.provenance import provenance
from psd_deflection.records import ParameterChange, Record, RigState, SpotMeans
from psd_deflection.rig.config import Rig
from psd_deflection.run.fanout import Fanout, published, subscribed
from psd_deflection.run.monitor.feed import Feed
from psd_deflection.run.monitor.gated import HEARTBEAT_S, GatedServer

VIEWER = 'in Foxglove: Open connection'
PROTOCOLS = ('foxglove.websocket.v1', 'foxglove.sdk.v1')
"""The second is what newer viewers call it."""

BACKLOG_BYTES = 8_000_000
"""What waits for one viewer: a minute and more."""

REQUEST_BYTES = 65_536
PUMP_S = 0.02
_MESSAGE = struct.Struct('<BIQ')
_MESSAGE_DATA = 1


class _Viewer:
    """What one viewer looks at, and what waits for it; messages may come from any thread."""

    def __init__(self) -> None:
        self.reported = 0
        self.subscriptions: dict[int, int] = {}  # Bound: one a topic.
        self._budget = ByteBudget(BACKLOG_BYTES)
        self._waiting: deque[bytes] = deque()  # Bound: BACKLOG_BYTES.

    def offer(self, channel: int, message: bytes, t_ns: int) -> None:
        """Let a message wait, if the viewer looks at its channel; if there is no room, the oldest is dropped."""
        subscription = self.subscriptions.get(channel)
        if subscription is None:
            return
        size = _MESSAGE.size + len(message) + MESSAGE_BYTES
        while not self._budget.take(size):
            if self.take() is None:
                return
        self._waiting.append(_MESSAGE.pack(_MESSAGE_DATA, subscription, t_ns) + message)

    def take(self) -> bytes | None:
        """The next message to send, or None."""
        with contextlib.suppress(IndexError):
            message = self._waiting.popleft()
            self._budget.give_back(len(message) + MESSAGE_BYTES)
            return message
        return None


class FoxgloveServer(GatedServer):
    """A wire of the fan-out. Serves from construction on; ``address``: its WebSocket URL.

    ``log`` gets what is out of the ordinary. Raises ConfigError if the address cannot be served on.
    """

    websocket_path = '/'

    def __init__(self, rig: Rig, log: LogCallback = null_log) -> None:
        config = rig.monitor
        super().__init__('foxglove', config.foxglove_address, config.foxglove_port, log, config.foxglove_origins)
        # A viewer forgets what it has of another one.
        self._session = secrets.token_hex(8)
        self._lock = threading.Lock()
        # Both for as long as the server lives: one entry a topic of our own.
        self._numbers: dict[str, int] = {}  # Bound: our own topics.
        self._channels: list[dict[str, object]] = []  # Bound: our own topics.
        self._looking: dict[web.WebSocketResponse, _Viewer] = {}  # Bound: VIEWERS.
        self._rig: tuple[bytes, int] | None = None
        for topic, type_name in (published(rig) | {name: TOPIC_TYPES[name] for name in subscribed(rig)}).items():
            self._offer(topic, type_name)
        self.address = f'ws:{self.start_thread()}'

    def add_routes(self, application: web.Application) -> None:
        """The websocket alone."""
        application.router.add_get(self.websocket_path, self._websocket)

    def jobs(self) -> list[Coroutine[Any, Any, None]]:
        """Wakes the senders."""
        return [self._pump()]

    async def _pump(self) -> None:
        while True:
            self.wake()
            await asyncio.sleep(PUMP_S)

    def _offer(self, topic: str, type_name: str) -> int:
        with self._lock:
            if topic not in self._numbers:
                number = self._numbers[topic] = len(self._channels) + 1
                self._channels.append(
                    {
                        'id': number,
                        'topic': topic,
                        'encoding': 'cdr',
                        'schemaName': type_name,
                        'schemaEncoding': 'ros2msg',
                        'schema': MESSAGE_TYPES[type_name].definition,
                    }
                )
            return self._numbers[topic]

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Send a message to those who look at its topic."""
        number = self._numbers.get(topic) or self._offer(topic, type_name)
        if topic == RIG:
            # Sent again to who comes later, as a latched topic is.
            self._rig = cdr, t_ns
        for viewer in tuple(self._looking.values()):
            viewer.offer(number, cdr, t_ns)

    async def _websocket(self, request: web.Request) -> web.StreamResponse:
        # Not compressed: aiohttp compresses in a task that outlives a viewer that has left.
        socket = web.WebSocketResponse(
            protocols=PROTOCOLS, heartbeat=HEARTBEAT_S, max_msg_size=REQUEST_BYTES, compress=False
        )
        viewer = _Viewer()

        async def send(socket: web.WebSocketResponse, event: asyncio.Event) -> None:
            self._looking[socket] = viewer
            await socket.send_json(
                {'op': 'serverInfo', 'name': 'psd_deflection', 'capabilities': [], 'sessionId': self._session}
            )
            while True:
                if viewer.reported < len(self._channels):
                    new = self._channels[viewer.reported :]
                    viewer.reported += len(new)
                    await socket.send_json({'op': 'advertise', 'channels': new})
                while (message := viewer.take()) is not None:
                    await socket.send_bytes(message)
                await event.wait()
                event.clear()

        try:
            return await self.look_on(request, socket, send, lambda message: self._receive(viewer, message))
        finally:
            self._looking.pop(socket, None)

    def _receive(self, viewer: _Viewer, message: WSMessage) -> None:
        """What a viewer asks for; what is not understood is not answered."""
        if message.type is not WSMsgType.TEXT:
            return
        with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):
            asked = json.loads(message.data)
            if asked['op'] == 'subscribe':
                for subscription in asked['subscriptions']:
                    self._subscribe(viewer, subscription['channelId'], subscription['id'])
            elif asked['op'] == 'unsubscribe':
                gone = frozenset(asked['subscriptionIds'])
                for channel in [c for c, s in viewer.subscriptions.items() if s in gone]:
                    del viewer.subscriptions[channel]

    def _subscribe(self, viewer: _Viewer, channel: object, subscription: object) -> None:
        if type(channel) is not int or type(subscription) is not int:
            return
        if not (0 < channel <= len(self._channels) and 0 <= subscription < 2**32):
            return
        viewer.subscriptions[channel] = subscription
        if channel == self._numbers.get(RIG) and self._rig is not None:
            viewer.offer(channel, *self._rig)

    def words(self) -> str:
        """The address, and where to open it, as a line."""
        return f'foxglove: {self.address} ({VIEWER})'


class FeedBeside(Feed):
    """A feed of the page whose records go to Foxglove too, for a recording that is played with ``rig``."""

    def __init__(self, server: FoxgloveServer, rig: Rig) -> None:
        super().__init__()
        self._present = dict(rig.flat())  # Bound: our own parameters.
        self._reported = False
        self._fanout = Fanout(rig.monitor.frame_prefix)
        self._fanout.sinks.append(server)

    def put(self, record: Record) -> None:
        """Take one record."""
        super().put(record)
        self._fanout.put(record)
        if isinstance(record, ParameterChange):
            self._report(record.t_ns, record.block, dict(record.values))
        elif isinstance(record, SpotMeans) and not self._reported:
            self._report(record.t_ns, record.index, {})

    def _report(self, t_ns: int, block: int, changed: dict[str, object]) -> None:
        self._reported = True
        self._present |= changed
        self._fanout.put(RigState(t_ns, block, self._present, None, changed, __version__, provenance()))
