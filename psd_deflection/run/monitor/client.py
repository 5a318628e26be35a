# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Speaks to a running daemon over its page: requests, and what it measures. For commands without ROS."""

import asyncio
import contextlib
import http.client
import json
import os
import time
from collections.abc import AsyncGenerator, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

from psd_deflection.base.errors import ConfigError, DaemonError
from psd_deflection.run.monitor.served import MAX_AGO_S, TOKEN_HEADER, TOKEN_VARIABLE, served_pages

_IMPORTED_S = time.monotonic()

DEFAULT_URL = 'http://127.0.0.1:8790/'
ANSWER_S = 10.0
"""Time limit for an answer, s; the daemon waits for its disk before it answers a recording."""

HEARD_S = 15.0
"""A daemon that says nothing for this long is gone, s; it reports its health once a second."""

MAX_MESSAGE = 64 * 1024 * 1024


class Daemon(NamedTuple):
    """Where a daemon's page is, and its token or ''."""

    url: str
    token: str


def find_daemon(url: str | None) -> Daemon:
    """The daemon at ``url`` (a printed address, with or without its token), else the one of this user.

    Raises DaemonError if several are running, ConfigError if ``url`` is no address.
    """
    pages = served_pages()
    if url is not None:
        try:
            parts = urlsplit(url if '//' in url else f'http://{url}')
            given = parts.scheme in ('http', 'https') and parts.hostname is not None
            # Out of range, it raises.
            given = given and parts.port != 0
        except ValueError:
            given = False
        if not given:
            raise ConfigError(f'url = {url}: is no address such as {DEFAULT_URL}')
        base = f'{parts.scheme}://{parts.netloc}/'
        token = parse_qs(parts.fragment).get('token', [''])[0] or next((p.token for p in pages if p.url == base), '')
        return Daemon(base, token or os.environ.get(TOKEN_VARIABLE, ''))
    if len(pages) > 1:
        listed = ', '.join(f'{p.url} ({p.name})' for p in pages)
        raise DaemonError(f'several daemons are running: {listed}; give the address of one')
    if pages:
        return Daemon(pages[0].url, pages[0].token)
    # One of another user, such as a service.
    return Daemon(DEFAULT_URL, os.environ.get(TOKEN_VARIABLE, ''))


def since_start_s() -> float:
    """Seconds since this program was started; since this module was imported where the system does not say it."""
    try:
        ticks = int(Path('/proc/self/stat').read_text(encoding='utf-8').rpartition(')')[2].split()[19])
        return max(time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf('SC_CLK_TCK'), 0.0)
    except (OSError, ValueError, IndexError, AttributeError):
        return time.monotonic() - _IMPORTED_S


def ask(daemon: Daemon, path: str, body: Mapping[str, object], *, timed: bool = False) -> str:
    """Send a request such as ``api/zero``; return the answer's message. Raises DaemonError.

    ``timed``: it is of the time at which this program was started, and says how long ago that is.
    """
    parts = urlsplit(daemon.url)
    kind = http.client.HTTPSConnection if parts.scheme == 'https' else http.client.HTTPConnection
    headers = {'Content-Type': 'application/json', **({TOKEN_HEADER: daemon.token} if daemon.token else {})}
    try:
        with contextlib.closing(kind(parts.netloc, timeout=ANSWER_S)) as connection:
            connection.connect()
            late = {'late': min(since_start_s(), MAX_AGO_S)} if timed else {}
            connection.request('POST', parts.path + path, json.dumps({**body, **late}), headers)
            # The connection forgets an answer that ends with it.
            with contextlib.closing(connection.getresponse()) as answer:
                status, text = answer.status, answer.read(10_000).decode(errors='replace')
    except (http.client.HTTPException, OSError, ValueError) as error:
        raise _unreachable(daemon, error) from None
    message: Any = None
    with contextlib.suppress(ValueError, RecursionError, TypeError, KeyError):
        message = json.loads(text)['message']
    if not isinstance(message, str):
        raise DaemonError(f'{daemon.url}: {text[:200]!r} is no answer of a daemon (HTTP status {status})')
    if status != 200:
        hint = '; give the address with that token' if status == 401 else ''
        raise DaemonError(f'{daemon.url}: {message}{hint}')
    return message


async def messages(daemon: Daemon) -> AsyncGenerator[dict[str, Any], None]:
    """The messages of the page: ``hello`` first, then new rows as they come. Raises DaemonError, also at the end."""
    # Imported here: requests do without it, and it takes longer than they do.
    import aiohttp

    limit = aiohttp.ClientTimeout(total=None, sock_connect=ANSWER_S)
    try:
        async with (
            aiohttp.ClientSession(timeout=limit) as session,
            session.ws_connect(f'{daemon.url}ws?history=0', max_msg_size=MAX_MESSAGE) as socket,
        ):
            while True:
                message = await socket.receive(HEARD_S)
                if message.type is not aiohttp.WSMsgType.TEXT:
                    why = f': {message.extra}' if message.extra else ''
                    raise DaemonError(f'{daemon.url}: the daemon closed the connection{why}')
                content = json.loads(message.data)
                if not isinstance(content, dict):
                    raise DaemonError(f'{daemon.url}: no page of this program is there')
                yield content
    except (aiohttp.ClientError, OSError, TimeoutError, ValueError, RecursionError) as error:
        raise _unreachable(daemon, error) from None


def recording_of(daemon: Daemon) -> str | None:
    """The folder that the daemon records into now, None if it does not record. Raises DaemonError."""
    return asyncio.run(_recording_of(daemon))


async def _recording_of(daemon: Daemon) -> str | None:
    async with contextlib.aclosing(messages(daemon)) as reported:
        hello = (await anext(reported)).get('hello')
    if not isinstance(hello, dict):
        raise DaemonError(f'{daemon.url}: no page of this program is there')
    folder = hello.get('recording')
    return folder if isinstance(folder, str) else None


def _unreachable(daemon: Daemon, error: Exception) -> DaemonError:
    why = error.strerror if isinstance(error, OSError) and error.strerror else str(error) or 'no answer in time'
    return DaemonError(
        f'{daemon.url}: no daemon answers ({why}); start one with `psd-deflection monitor` or '
        '`psd-deflection estimator --monitor`, or give the address that it printed'
    )
