"""Foxglove without ROS: a viewer written from the protocol's description, and messages decoded by mcap-ros2-support."""

from __future__ import annotations

import asyncio
import builtins
import json
import signal
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from psd_deflection.base.errors import ConfigError
from psd_deflection.cli.main import main
from psd_deflection.rig.config import load_rig
from psd_deflection.run.monitor.foxglove import FoxgloveServer
from tools.program import PSD_DEFLECTION, WAIT_S, Program

pytest.importorskip('foxglove')

BAGS = Path(__file__).parents[3] / 'bags'

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

    async def _take_text(self, ws: aiohttp.ClientWebSocketResponse, said: dict[str, Any]) -> None:
        if said['op'] == 'serverInfo':
            self.info = said
        elif said['op'] == 'advertise':
            for channel in said['channels']:
                assert (channel['encoding'], channel['schemaEncoding']) == ('cdr', 'ros2msg')
                self._topics[channel['id']] = channel['topic']
                self.offered[channel['topic']] = Schema(
                    id=1, name=channel['schemaName'], encoding='ros2msg', data=channel['schema'].encode()
                )
                asked = [{'id': channel['id'], 'channelId': channel['id']}]
                await ws.send_json({'op': 'subscribe', 'subscriptions': asked})


def test_a_viewer_without_ros_sees_the_running_rig(start: Callable[..., Program]) -> None:
    program = start('monitor', '--foxglove', '--http-port', '0')
    url = program.until(r'foxglove: (ws://127\.0\.0\.1:\d+)')[1]
    viewer = Viewer()
    wanted = ('/link_tip/deflection', '/link_tip/wrench', '/psd/samples', '/diagnostics', '/link_tip/rig')
    viewer.look(url, lambda got: all(topic in got for topic in wanted) and len(got['/link_tip/deflection']) > 50)
    # Nobody can steer the rig from there.
    assert viewer.info['capabilities'] == []
    pose, wrench = viewer.decoded('/link_tip/deflection'), viewer.decoded('/link_tip/wrench')
    assert pose.header.frame_id == 'link_tip_rest'
    t_ns = pose.header.stamp.sec * 10**9 + pose.header.stamp.nanosec
    assert t_ns == viewer.messages['/link_tip/deflection'][-1][0]
    assert abs(wrench.wrench.force.y) < 100.0
    assert json.loads(viewer.decoded('/link_tip/rig').data)['parameters']['psd_1.center'] == [0.0, 0.07]
    assert any('acquisition' in s.name for s in viewer.decoded('/diagnostics').status)
    # Another one that comes later gets the rig too.
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
        server = FoxgloveServer(load_rig(overrides={'foxglove_port': port}))
        assert server.address.startswith('ws://127.0.0.1:')
        assert not server.address.endswith(f':{port}')
        server.close()


def test_an_address_that_is_not_ours_is_named() -> None:
    with pytest.raises(ConfigError, match=r'foxglove_address 192\.0\.2\.1: .*assign'):
        FoxgloveServer(load_rig(overrides={'foxglove_address': '192.0.2.1'}))


def test_without_the_sdk_the_error_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    found = builtins.__import__

    def missing(name: str, *rest: Any, **more: Any) -> Any:
        if name == 'foxglove':
            raise ImportError(name)
        return found(name, *rest, **more)

    monkeypatch.setattr(builtins, '__import__', missing)
    monkeypatch.chdir(tmp_path)
    assert main(['monitor', str(BAGS / 'clean'), '--foxglove']) == 3
    assert "pip install 'psd_deflection[foxglove]'" in capsys.readouterr().err
