# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Foxglove without ROS: a viewer written from the protocol's description, and messages decoded by mcap-ros2-support."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import signal
import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from msg_adapters import DEFLECTION, TOPIC_TYPES
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import texts
from psd_deflection.cli.main import main
from psd_deflection.rig.config import load_rig
from psd_deflection.run.monitor.foxglove import PROTOCOLS, FoxgloveServer, _Viewer
from psd_deflection.run.monitor.gated import VIEWERS
from test.heard import until
from tools.program import PSD_DEFLECTION, WAIT_S, Program

BAGS = Path(__file__).parents[3] / 'bags'
BUSY_S = 1.0
"""A busy machine may take longer."""
Messages = dict[str, list[tuple[int, bytes]]]


@pytest.fixture
def start() -> Iterator[Callable[..., Program]]:
    started: list[Program] = []

    def begin(*arguments: str) -> Program:
        started.append(Program([*PSD_DEFLECTION, *arguments]))
        return started[-1]

    yield begin
    for program in started:
        assert program.end(signal.SIGINT) == 0, program.lines


class Viewer:
    """Looks at every topic that is offered. ``messages``: (log time, payload) by topic."""

    def __init__(self) -> None:
        self.offered: dict[str, Schema] = {}
        self.info: dict[str, Any] = {}
        self.messages: Messages = {}
        self._topics: dict[int, str] = {}

    def look(self, url: str, enough: Callable[[Messages], bool]) -> None:
        asyncio.run(asyncio.wait_for(self._look(url, enough), WAIT_S))

    def decoded(self, topic: str) -> Any:
        decode = DecoderFactory().decoder_for('cdr', self.offered[topic])
        assert decode is not None
        return decode(self.messages[topic][-1][1])

    async def _look(self, url: str, enough: Callable[[Messages], bool]) -> None:
        async with aiohttp.ClientSession() as client, client.ws_connect(url, protocols=['foxglove.sdk.v1']) as ws:
            while not enough(self.messages):
                got = await ws.receive()
                if got.type is aiohttp.WSMsgType.TEXT:
                    await self._take_text(ws, json.loads(got.data))
                elif got.type is aiohttp.WSMsgType.BINARY and got.data[0] == 1:
                    subscription, t_ns = struct.unpack_from('<IQ', got.data, 1)
                    self.messages.setdefault(self._topics[subscription], []).append((t_ns, got.data[13:]))

    async def _take_text(self, ws: aiohttp.ClientWebSocketResponse, logged: dict[str, Any]) -> None:
        if logged['op'] == 'serverInfo':
            self.info = logged
        elif logged['op'] == 'advertise':
            for channel in logged['channels']:
                assert (channel['encoding'], channel['schemaEncoding']) == ('cdr', 'ros2msg')
                self._topics[channel['id']] = channel['topic']
                name, text = channel['schemaName'], channel['schema'].encode()
                self.offered[channel['topic']] = Schema(id=1, name=name, encoding='ros2msg', data=text)
                asked = [{'id': channel['id'], 'channelId': channel['id']}]
                await ws.send_json({'op': 'subscribe', 'subscriptions': asked})


def test_a_viewer_without_ros_sees_the_running_rig(start: Callable[..., Program]) -> None:
    program = start('monitor', '--foxglove', '--http-port', '0')
    url = program.until(r'foxglove: (ws://127\.0\.0\.1:\d+)')[1]
    viewer = Viewer()
    wanted = ('/link_tip/deflection', '/link_tip/wrench', '/psd/samples', '/diagnostics', '/link_tip/rig')
    viewer.look(url, lambda got: all(topic in got for topic in wanted) and len(got['/link_tip/deflection']) > 50)
    assert viewer.info['capabilities'] == []
    pose, wrench = viewer.decoded('/link_tip/deflection'), viewer.decoded('/link_tip/wrench')
    assert pose.header.frame_id == 'link_tip_rest'
    t_ns = pose.header.stamp.sec * 10**9 + pose.header.stamp.nanosec
    assert t_ns == viewer.messages['/link_tip/deflection'][-1][0]
    assert abs(wrench.wrench.force.y) < 100.0
    assert json.loads(viewer.decoded('/link_tip/rig').data)['parameters']['psd_1.center'] == [0.0, 0.07]
    assert any('acquisition' in s.name for s in viewer.decoded('/diagnostics').status)
    second = Viewer()
    second.look(url, lambda got: '/link_tip/rig' in got)


def test_a_recording_is_played_bit_for_bit(start: Callable[..., Program]) -> None:
    program = start('monitor', str(BAGS / 'clean'), '--foxglove', '--http-port', '0', '--speed', '4', '--loop')
    url = program.until(r'foxglove: (ws://\S+)')[1]
    viewer = Viewer()
    viewer.look(url, lambda got: len(got.get('/link_tip/deflection', ())) > 50 and '/link_tip/rig' in got)
    with next((BAGS / 'clean').glob('*.mcap')).open('rb') as stream:
        recorded = {(channel.topic, m.data) for _, channel, m in make_reader(stream).iter_messages()}
    for topic in ('/link_tip/deflection', '/link_tip/wrench'):
        assert {(topic, payload) for _, payload in viewer.messages[topic]} <= recorded


def test_a_port_in_use_gives_way_to_a_free_one() -> None:
    with socket.create_server(('127.0.0.1', 0)) as taken:
        port = taken.getsockname()[1]
        with contextlib.closing(FoxgloveServer(load_rig(overrides={'foxglove_port': port}))) as server:
            assert server.address.startswith('ws://127.0.0.1:')
            assert not server.address.endswith(f':{port}')


def test_an_address_that_is_not_ours_is_named() -> None:
    with pytest.raises(ConfigError, match=r"foxglove_address = '192\.0\.2\.1'.*assign"):
        FoxgloveServer(load_rig(overrides={'foxglove_address': '192.0.2.1'}))


def test_without_aiohttp_the_error_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, 'find_spec', lambda name: None if name == 'aiohttp' else find_spec(name))
    assert main(['monitor', str(BAGS / 'clean'), '--foxglove']) == 3
    assert "pip install 'psd_deflection[monitor]'" in capsys.readouterr().err


@pytest.fixture
def served() -> Iterator[Served]:
    server = Served()
    yield server
    server.server.close()


class Served:
    """A server that the test feeds; ``said``: its lines."""

    def __init__(self) -> None:
        self.logged: list[str] = []
        self.server = FoxgloveServer(load_rig(overrides={'foxglove_port': 0}), texts(self.logged.append))
        self.port = int(self.server.address.rpartition(':')[2])

    def give(self, count: int, size: int = 100) -> None:
        for n in range(count):
            self.server.put(DEFLECTION, TOPIC_TYPES[DEFLECTION], bytes(size), n)


async def connected(client: aiohttp.ClientSession, url: str, **headers: str) -> aiohttp.ClientWebSocketResponse:
    return await client.ws_connect(url, protocols=PROTOCOLS, headers=headers)


def status_of(url: str, **headers: str) -> int:
    """With which a viewer is answered; 101 if it may look."""

    async def go() -> int:
        async with aiohttp.ClientSession() as client:
            try:
                await connected(client, url, **headers)
            except aiohttp.WSServerHandshakeError as rejected:
                return rejected.status
        return 101

    return asyncio.run(asyncio.wait_for(go(), WAIT_S))


@pytest.mark.parametrize(
    'headers',
    [
        {'Origin': 'http://evil.com', 'Host': 'evil.com:{port}'},
        {'Origin': 'http://evil.com'},
        {'Host': 'evil.com:{port}'},
        {'Origin': 'null'},
        {'Origin': 'https://app.foxglove.dev.evil.com'},
        {'Sec-Fetch-Site': 'cross-site'},
    ],
)
def test_another_site_cannot_look(served: Served, headers: dict[str, str]) -> None:
    given = {name: value.format(port=served.port) for name, value in headers.items()}
    assert status_of(served.server.address, **given) == 403
    assert not served.logged


@pytest.mark.parametrize('origin', ['https://app.foxglove.dev', 'file://'])
def test_foxglove_itself_can_look(served: Served, origin: str) -> None:
    async def go() -> Any:
        async with aiohttp.ClientSession() as client:
            socket = await connected(client, served.server.address, Origin=origin, **{'Sec-Fetch-Site': 'cross-site'})
            return await socket.receive_json()

    assert asyncio.run(asyncio.wait_for(go(), WAIT_S))['op'] == 'serverInfo'


def test_which_pages_may_look_is_a_parameter() -> None:
    rig = load_rig(overrides={'foxglove_port': 0, 'foxglove_origins': ['https://viewer.example']})
    with contextlib.closing(FoxgloveServer(rig)) as server:
        assert status_of(server.address, Origin='https://viewer.example') == 101
        assert status_of(server.address, Origin='https://app.foxglove.dev') == 403


def deaf(served: Served) -> socket.socket:
    """A viewer that asks for everything and then reads nothing, not even the answer to its pings."""
    viewer = socket.create_connection(('127.0.0.1', served.port))
    viewer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    viewer.sendall(
        (
            f'GET / HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n'
            'Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n'
            'Sec-WebSocket-Protocol: foxglove.websocket.v1\r\n\r\n'
        ).encode()
    )
    assert b'101' in viewer.recv(100)
    asked = [{'id': n, 'channelId': n} for n in range(1, 12)]
    text = json.dumps({'op': 'subscribe', 'subscriptions': asked}).encode()
    # Masked with zeros, as a client must mask.
    viewer.sendall(bytes((0x81, 0x80 | 126)) + struct.pack('>H', len(text)) + bytes(4) + text)
    return viewer


def test_deaf_viewers_have_bounded_backlog_and_delay_no_end(served: Served) -> None:
    viewers = [deaf(served) for _ in range(VIEWERS)]
    deadline = time.monotonic() + WAIT_S
    backlogs = [_Viewer()]
    while not all(v.subscriptions for v in backlogs) or len(backlogs) < VIEWERS:
        assert time.monotonic() < deadline
        backlogs = list(served.server._looking.values())
    # More than all backlogs and all buffers of the system together.
    served.give(100, 1_000_000)
    assert all(6_000_000 < v._budget.held <= 8_000_000 for v in backlogs)
    began = time.monotonic()
    served.server.close()
    assert time.monotonic() - began < 1.0 + BUSY_S
    assert not served.server._thread.is_alive()
    for viewer in viewers:
        viewer.close()
    assert not served.logged


def test_viewers_that_vanish_cost_no_line(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(100):
        viewers = [deaf(served) for _ in range(8)]
        served.give(10, 10_000)
        for viewer in viewers:
            # Without leave: a reset.
            viewer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))
            viewer.close()

    def all_gone() -> bool:
        # Who is gone is noticed when something is sent.
        served.give(1)
        # A viewer that is no longer counted may have a message under way for one more turn of the loop.
        return not served.server.viewers and not served.server._looking

    until(all_gone)
    assert not served.logged
    assert not caplog.records


@pytest.mark.parametrize(
    'text',
    [
        'not JSON',
        '[' * 10_000,
        '3',
        '{"op": "subscribe"}',
        '{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 4294967296, "channelId": 1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 100000}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 1e300, "channelId": true}]}',
        '{"op": "unsubscribe", "subscriptionIds": [[]]}',
        '{"op": "advertise", "channels": []}',
    ],
)
def test_what_is_not_understood_is_not_answered_and_harms_nobody(served: Served, text: str) -> None:
    async def go() -> int:
        async with aiohttp.ClientSession() as client:
            viewer = await connected(client, served.server.address)
            await viewer.send_str(text)
            await viewer.send_json({'op': 'subscribe', 'subscriptions': [{'id': 7, 'channelId': 1}]})
            while True:
                served.server.put(*first_topic(served), b'x', 5)
                with contextlib.suppress(TimeoutError):
                    got = await asyncio.wait_for(viewer.receive(), 0.1)
                    if got.type is aiohttp.WSMsgType.BINARY:
                        return int.from_bytes(got.data[1:5], 'little')

    assert asyncio.run(asyncio.wait_for(go(), WAIT_S)) == 7
    assert not served.logged


def first_topic(served: Served) -> tuple[str, str]:
    first = served.server._channels[0]
    return str(first['topic']), str(first['schemaName'])
