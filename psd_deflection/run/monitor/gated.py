# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A web server in a thread of its own, with the gate that every view of the daemon has: who may see it, who may press
its buttons. It takes bounded numbers of viewers and connections, and waits for none."""

import abc
import asyncio
import contextlib
import errno
import hmac
import ipaddress
import logging
import re
import socket
import threading
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from concurrent.futures import Future
from typing import Any

from aiohttp import WSCloseCode, WSMessage, WSMsgType, web

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import ERROR, WARNING, LogCallback

_HOST = re.compile(r'(?:\[([0-9a-f:.]+(?:%[a-z0-9._-]+)?)\]|([a-z0-9._-]+))(?::[0-9]{1,5})?')


def host_name(host_header: str) -> str:
    """The name in a Host header, without port and brackets, lower case; '' if it is malformed."""
    match = _HOST.fullmatch(host_header.lower())
    return (match[1] or match[2]).rstrip('.') if match is not None else ''


def is_address(name: str) -> bool:
    """Whether ``name`` is an IP address, which no name server can redirect."""
    try:
        ipaddress.ip_address(name.partition('%')[0])
    except ValueError:
        return False
    return True


def is_loopback(address: str) -> bool:
    """Whether only this machine can reach a server bound to ``address``."""
    if address == 'localhost':
        return True
    return is_address(address) and ipaddress.ip_address(address.partition('%')[0]).is_loopback


def is_own_host(host_header: str, address: str) -> bool:
    """Whether the Host header names this machine: an address, localhost, or its host name.

    Any web page can make a browser send requests, also to 127.0.0.1. So a request must name this
    machine as its host: otherwise a foreign name could point here (DNS rebinding). A request that
    comes from a page must come from our page: otherwise any site could take the zero (cross-site request
    forgery, cross-site websocket hijacking). If others on the network can reach the page, its
    buttons also need a token.
    """
    name = host_name(host_header)
    if not name:
        return False
    if is_loopback(address):
        return is_loopback(name)
    hostname = socket.gethostname().lower()
    return is_address(name) or name in ('localhost', address.lower(), hostname, hostname + '.local')


def is_own_page(headers: Mapping[str, str]) -> bool:
    """Whether a request comes from our page, or from no page at all (curl has no Origin)."""
    if headers.get('Sec-Fetch-Site', 'same-origin') not in ('same-origin', 'none'):
        return False
    origin = headers.get('Origin')
    return origin is None or origin.lower() == f'http://{headers.get("Host", "").lower()}'


def is_token(given: str | None, expected: str) -> bool:
    """Whether the token is right, compared in constant time."""
    # A header may hold bytes that are not text; they appear as lone surrogates.
    return given is not None and hmac.compare_digest(
        given.encode(errors='surrogateescape'), expected.encode(errors='surrogateescape')
    )


VIEWERS = 16
CONNECTIONS = 100
"""Maximum plain HTTP connections, in addition to websockets; a browser opens at most six."""

PATH_CHARACTERS = 100
LOOK_S = 0.03
"""Time between two looks at the number of connections."""

START_S = 10.0
CLOSE_S = 3.0
FAREWELL_S = 0.3
"""How long the end waits for viewers to take leave, all at once."""

HEARTBEAT_S = 10.0

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

# aiohttp logs each malformed request with a traceback: an attacker could fill the journal.
_UNHEARD = logging.getLogger('psd_deflection.run.monitor.http')
_UNHEARD.disabled = True


class GatedServer(abc.ABC):
    """Serves from :meth:`start` to :meth:`close`. ``name``: of the view, with which its parameters begin.

    ``origins``: pages besides our own that may open a websocket. ``websocket_path``: where it is. ``viewers``: who
    looks on, each with the event that wakes its sender.
    """

    websocket_path = '/ws'

    def __init__(self, name: str, address: str, port: int, log: LogCallback, origins: tuple[str, ...] = ()) -> None:
        self.name, self.log = name, log
        self.viewers: dict[web.WebSocketResponse, asyncio.Event] = {}  # Bound: VIEWERS.
        self._address, self._port = address, port
        self._origins = frozenset(origin.lower().rstrip('/') for origin in origins)
        self._looked_through: set[web.RequestHandler] = set()  # Bound: VIEWERS.
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ended: asyncio.Event | None = None
        self._started: Future[str] = Future()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @abc.abstractmethod
    def add_routes(self, application: web.Application) -> None:
        """Add what is served."""

    @abc.abstractmethod
    def jobs(self) -> list[Coroutine[Any, Any, None]]:
        """What runs beside, until the end."""

    def start_thread(self) -> str:
        """Start the thread; return ``//HOST:PORT``. Raises ConfigError if it cannot be served."""
        self._thread.start()
        return self._started.result(START_S)

    def close(self) -> None:
        """Close the connections and end the thread; a second call does nothing."""
        if self._loop is not None and self._ended is not None and self._thread.is_alive():
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._ended.set)
            self._thread.join(CLOSE_S)

    def wake(self) -> None:
        """Wake the senders; in the server's thread."""
        for event in self.viewers.values():
            event.set()

    async def look_on(
        self,
        request: web.Request,
        viewer: web.WebSocketResponse,
        send: Callable[[web.WebSocketResponse, asyncio.Event], Coroutine[Any, Any, None]],
        feed: Callable[[WSMessage], None] = lambda message: None,
    ) -> web.WebSocketResponse:
        """Let ``viewer`` look on until it leaves: ``send`` runs beside, ``feed`` gets what it says."""
        await viewer.prepare(request)
        if len(self.viewers) >= VIEWERS:
            # A page learns the reason of a close, but not that of a failed handshake.
            full = f'{VIEWERS} viewers look on already'
            await viewer.close(code=WSCloseCode.TRY_AGAIN_LATER, message=full.encode())
            return viewer
        event = self.viewers[viewer] = asyncio.Event()
        self._looked_through.add(request.protocol)
        sender = asyncio.create_task(send(viewer, event))
        try:
            async for message in viewer:
                if message.type is WSMsgType.ERROR:
                    break
                feed(message)
        finally:
            del self.viewers[viewer]
            self._looked_through.discard(request.protocol)
            sender.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await sender
        return viewer

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except Exception as error:
            if not self._started.done():
                self._started.set_exception(error)
            else:
                self.log(f'{self.name}: ended: {type(error).__name__}: {error}', ERROR)

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._ended = asyncio.Event()
        application = web.Application(middlewares=[self._guard], client_max_size=4096)
        self.add_routes(application)
        runner = web.AppRunner(
            application, handle_signals=False, access_log=None, logger=_UNHEARD, shutdown_timeout=FAREWELL_S
        )
        await runner.setup()
        tasks: list[asyncio.Task[None]] = []
        try:
            self._started.set_result(await self._listen(runner))
            tasks = [asyncio.create_task(job) for job in (*self.jobs(), self._bound_connections(runner))]
            ended = asyncio.create_task(self._ended.wait())
            done, _ = await asyncio.wait([ended, *tasks], return_when=asyncio.FIRST_COMPLETED)
            for task in done - {ended}:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            # What a viewer has not read keeps its connection open; with aiohttp 3.9 it leaves the set as it is closed.
            connections = tuple(self._looked_through)
            leaving = [asyncio.create_task(v.close(code=WSCloseCode.GOING_AWAY)) for v in tuple(self.viewers)]
            if leaving:
                # A viewer that does not read does not take leave either.
                _, deaf = await asyncio.wait(leaving, timeout=FAREWELL_S)
                for farewell in deaf:
                    farewell.cancel()
                await asyncio.gather(*leaving, return_exceptions=True)
            for connection in connections:
                if connection.transport is not None:
                    connection.transport.abort()
            await runner.cleanup()

    async def _listen(self, runner: web.AppRunner) -> str:
        address, port = self._address, self._port
        try:
            try:
                await web.TCPSite(runner, address, port).start()
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
                # An unusual address is better than no view.
                self.log(f'{self.name}: port {port} is in use (by another daemon?); taking a free one', WARNING)
                await web.TCPSite(runner, address, 0).start()
        except (OSError, UnicodeError) as error:
            reason = error.strerror or str(error) if isinstance(error, OSError) else str(error)
            raise ConfigError(
                f'{self.name}_address = {address!r}, {self.name}_port = {port}: cannot be served there ({reason}); '
                f'{self.name}_address is an address of this machine, 127.0.0.1 for itself, 0.0.0.0 for all'
            ) from None
        port = runner.addresses[0][1]
        name = {'0.0.0.0': socket.gethostname(), '::': socket.gethostname()}.get(address, address)
        return f'//{f"[{name}]" if ":" in name else name}:{port}'

    async def _bound_connections(self, runner: web.AppRunner) -> None:
        while True:
            if runner.server is not None:
                pending = [c for c in runner.server.connections if c not in self._looked_through]
                for oldest in pending[:-CONNECTIONS]:
                    oldest.force_close()
            await asyncio.sleep(LOOK_S)

    def _may(self, request: web.Request) -> bool:
        """Whether a request comes from a page that may ask for what is not only looked at."""
        if is_own_page(request.headers):
            return True
        return (
            request.path == self.websocket_path
            and request.headers.get('Origin', '').lower().rstrip('/') in self._origins
        )

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if not is_own_host(request.headers.get('Host', ''), self._address):
            return web.Response(status=403, text='this is not the name of this machine')
        asks = request.method != 'GET' or request.path == self.websocket_path or request.path.startswith('/api/')
        if asks and not self._may(request):
            return web.Response(status=403, text='rejected: asked for by another site')
        if 'Content-Encoding' in request.headers:
            return web.Response(status=415, text='rejected: a body must not be encoded')
        if len(request.path) > PATH_CHARACTERS:
            return web.Response(status=404, text='not found')
        try:
            return await handler(request)
        except (web.HTTPException, ConnectionError):
            raise
        except Exception as error:
            self.log(f'{self.name}: {request.path!r}: {type(error).__name__}: {error}', ERROR)
            return web.Response(status=500, text='this should not have happened; the daemon has said what')
