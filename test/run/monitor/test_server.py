# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The server as any client sees it, Prometheus too: what it sends, whom it obeys, the calibration that it starts."""

import asyncio
import base64
import json
import math
import re
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import AsyncMock, Mock, call
from urllib.parse import urlencode

import aiohttp
import numpy as np
import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parsed

from psd_deflection import simulate
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import null_log
from psd_deflection.base.plugins import optional
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.watch import Alarm
from psd_deflection.recordings.conversion import Beside, convert
from psd_deflection.records import RESTART, AppliedLoad, BlockStatus, Mark, ParameterChange, ReferencePose
from psd_deflection.rig.config import load_rig
from psd_deflection.run.monitor import server
from psd_deflection.run.monitor.feed import BlockResult, Feed
from psd_deflection.run.monitor.gated import CONNECTIONS, VIEWERS, is_loopback, is_own_host, is_own_page, is_token
from psd_deflection.run.monitor.metrics import CONTENT_TYPE, Family, counters, of_block, of_pipeline, text_of
from psd_deflection.run.monitor.served import need_server
from psd_deflection.run.monitor.server import MonitorServer
from test.heard import WAIT_S

from .serving import BLOCK_NS, START_NS, Serving, StillShown, estimate_of, spots_of

Serve = Callable[..., Serving]
KEEPS = optional('psd_deflection.run.monitor.kept_history')


def ask(
    url: str, method: str = 'POST', *, body: object = None, headers: dict[str, str] | None = None
) -> tuple[int, str, dict[str, str]]:
    """Status, text and headers of one request."""

    async def go() -> tuple[int, str, dict[str, str]]:
        async with aiohttp.ClientSession() as session:
            content = {'data': body} if isinstance(body, str) else {'json': {} if body is None else body}
            async with session.request(method, url, headers=headers, **(content if method == 'POST' else {})) as answer:
                return answer.status, await answer.text(), dict(answer.headers)

    return asyncio.run(asyncio.wait_for(go(), WAIT_S))


def listen(url: str, until: Callable[[dict[str, Any]], bool], headers: dict[str, str] | None = None) -> list[Any]:
    """Messages of the websocket up to the one that ``until`` accepts."""

    async def go() -> list[Any]:
        got: list[Any] = []
        connect = aiohttp.ClientSession.ws_connect
        async with aiohttp.ClientSession() as http, connect(http, url + 'ws', headers=headers, max_msg_size=0) as ws:
            async for message in ws:
                got.append(json.loads(message.data))
                if until(got[-1]):
                    break
        return got

    return asyncio.run(asyncio.wait_for(go(), WAIT_S))


def rows_in(messages: list[Any]) -> list[Any]:
    return [row for m in messages for row in m.get('rows', [])]


def test_a_browser_gets_the_last_minute_then_new_rows(serve: Serve) -> None:
    serving = serve()
    serving.give(0, 5)
    serving.server.notify('a message')
    observed: list[Any] = []

    def more(message: dict[str, Any]) -> bool:
        observed.extend(message.get('rows', []))
        # A message without rows may come while there are five.
        if len(observed) == 5 and 'rows' in message:
            serving.give(5, 3, status=BlockStatus.LASER_LOST)
        return len(observed) >= 8 and any('health' in m for m in (message, *got))

    got: list[Any] = []
    messages = listen(serving.url, lambda m: (got.append(m), more(m))[1])  # type: ignore[func-returns-value]
    hello = messages[0]['hello']
    assert (hello['columns'][:2], hello['active_areas']) == (['t', 'block'], [[0.01, 0.01], [0.01, 0.01]])
    assert hello['control'] is True
    assert (hello['why_no_control'], hello['spectrum_s']) == ('', 4.0)
    rows = rows_in(messages)
    assert [r[1] for r in rows] == list(range(8))
    assert {len(r) for r in rows} == {len(hello['columns'])}
    assert rows[6][8:14] == [None] * 6
    reported = [text for m in messages for _, text in m.get('messages', [])]
    assert reported == ['a message']
    health = next(m['health'] for m in messages if 'health' in m)
    assert (health['entries'][0]['name'], health['sum_min']) == ('acquisition', serving.rig.estimator.sum_min)


def test_the_page_is_whole_and_loads_nothing_from_elsewhere(serve: Serve) -> None:
    serving = serve()
    status, page, headers = ask(serving.url, 'GET')
    assert status == 200
    assert "default-src 'none'" in headers['Content-Security-Policy']
    assert headers['X-Frame-Options'] == 'DENY'
    names = [part.split('"')[0] for part in page.replace('src="', 'href="').split('href="')[1:]]
    # All modules are asked for at once, not each after the one that imports it.
    imported = [re.findall(r"from '(/page/\S+)'", path.read_text()) for path in server.PAGE.glob('*.js')]
    assert {name for names_of in imported for name in names_of} <= set(names)
    names += ['/page/vendor/uPlot.LICENSE']
    for name in names:
        assert name.startswith('/page/')
        status, text, headers = ask(serving.url + name[1:], 'GET')
        assert status == 200, name
        assert headers['X-Content-Type-Options'] == 'nosniff'
        assert 'https://' not in text.replace('https://github.com/leeoniya/uPlot', ''), name
    for name in ('page/../server.py', 'page/%2e%2e/server.py', 'page/', 'server.py'):
        assert ask(serving.url + name, 'GET')[0] in (403, 404)


@pytest.mark.parametrize(
    ('overrides', 'reason'),
    [
        ({'monitor_address': '0.0.0.0'}, 'because the network can reach this page'),
        ({'monitor_control': False}, 'switched off'),
        ({'monitor_control': 'off', 'monitor_address': '0.0.0.0'}, 'switched off'),
    ],
)
def test_buttons_are_off_on_network_and_when_disabled(serve: Serve, overrides: dict[str, object], reason: str) -> None:
    serving = serve(**overrides)
    url = f'http://127.0.0.1:{serving.port}/'
    for path in ('api/zero', 'api/record', 'api/load', 'api/mark', 'api/play'):
        status, text, _ = ask(url + path)
        assert status == 403
        assert 'monitor_control' in text
        assert reason in text
    assert (serving.shown.zeros, serving.shown.recordings, serving.shown.loads) == (0, [], [])
    hello = listen(url, lambda m: 'hello' in m)[0]['hello']
    assert hello['control'] is False
    assert reason in hello['why_no_control']
    # A token would be for nothing.
    assert hello['needs_token'] is False
    assert 'token' not in serving.logged[0]


@pytest.mark.parametrize(
    ('headers', 'body', 'status'),
    [
        ({'Host': 'evil.example'}, None, 403),
        ({'Origin': 'http://evil.example'}, None, 403),
        ({'Origin': 'null'}, None, 403),
        ({'Sec-Fetch-Site': 'cross-site'}, None, 403),
        # What a form or an image of another site can send without asking first.
        ({'Content-Type': 'text/plain'}, '{}', 415),
        ({'Content-Type': 'application/x-www-form-urlencoded'}, 'record=true', 415),
        ({'Content-Type': 'application/json'}, '{', 400),
        ({'Content-Encoding': 'gzip'}, '{}', 415),
        ({}, [], 400),
        ({}, {'record': 'yes'}, 400),
    ],
)
def test_requests_from_another_site_are_rejected(
    serve: Serve, headers: dict[str, str], body: object, status: int
) -> None:
    serving = serve(monitor_control=True)
    for path in ('api/zero', 'api/record', 'api/load', 'api/mark', 'api/play'):
        assert ask(serving.url + path, body=body, headers=headers)[0] == status
    shown = serving.shown
    assert (shown.zeros, shown.recordings, shown.loads, shown.marks) == (0, [], [], [])


def test_a_moment_is_marked(serve: Serve) -> None:
    serving = serve()
    assert ask(serving.url + 'api/mark', body={'text': 'bumped it'})[0] == 200
    assert ask(serving.url + 'api/mark', body={'text': 3})[0] == 400
    assert ask(serving.url + 'api/mark', body={'text': 'x' * 5000})[0] == 413
    assert serving.shown.marks == ['bumped it']


def test_a_load_is_noted(serve: Serve) -> None:
    serving = serve()
    assert ask(serving.url + 'api/load', body={'fx': 0, 'fy': -10.5, 'tz': 0.25})[0] == 200
    assert ask(serving.url + 'api/load', body={'fx': 1, 'fy': 0, 'tz': 0, 'add': True})[0] == 200
    assert serving.shown.loads == [(0.0, -10.5, 0.25, False), (1.0, 0.0, 0.0, True)]
    for ago in (3.4, 'step'):
        assert ask(serving.url + 'api/load', body={'fx': 0, 'fy': 1, 'tz': 0, 'ago': ago})[0] == 200
    assert serving.shown.agos == [0.0, 0.0, 3.4, None]
    assert json.loads(ask(serving.url + 'api/step', body={})[1])['message'] == '3.40'
    assert ask(serving.url + 'api/play', body={'paused': True, 'seek': 2.5})[0] == 200
    assert serving.shown.played == [(True, 2.5)]
    assert [line for line in serving.logged if 'asked for' in line] == ['monitor: load was asked for by 127.0.0.1'] * 4


@pytest.mark.parametrize(
    ('path', 'body'),
    [
        ('load', {}),
        ('load', {'fx': 1, 'fy': 2}),
        ('load', {'fx': 1, 'fy': 2, 'tz': True}),
        ('load', {'fx': 1, 'fy': 2, 'tz': '3'}),
        ('load', {'fx': 1, 'fy': 2, 'tz': 3, 'add': 1}),
        ('load', {'fx': 1, 'fy': 2, 'tz': 3, 'late': -1}),
        ('mark', {'text': 'x', 'late': 'noon'}),
        ('load', {'fx': 1, 'fy': 2, 'tz': 3, 'ago': 'noon'}),
        ('step', {'at': 1}),
        ('load', '{"fx": NaN, "fy": 0, "tz": 0}'),
        ('load', '{"fx": -Infinity, "fy": 0, "tz": 0}'),
        ('play', {'seek': -1.0}),
        ('play', '{"seek": NaN}'),
        ('play', {'paused': 'yes'}),
        ('play', {}),
        ('record', {}),
        ('zero', {'record': True}),
    ],
)
def test_a_body_of_another_kind_is_rejected(serve: Serve, path: str, body: object) -> None:
    serving = serve()
    status, text, _ = ask(f'{serving.url}api/{path}', body=body, headers={'Content-Type': 'application/json'})
    assert (status, json.loads(text)['message'].startswith('rejected: expected')) == (400, True)
    assert (serving.shown.loads, serving.shown.played, serving.shown.zeros) == ([], [], 0)


@pytest.mark.parametrize(
    ('body', 'words'),
    [
        ({'tz': 1e7}, 'not noted: Tz of more than 1e+06 N·m'),
        ({'fx': 10**400}, 'not noted: Fx of more than 1e+06 N'),
        ({'ago': -1}, 'not noted: a load has hung for 0 to 600 s when it is noted'),
        ({'ago': 601}, 'not noted: a load has hung for 0 to 600 s when it is noted'),
    ],
)
def test_a_load_out_of_bounds_is_rejected_in_a_person_s_words(serve: Serve, body: dict[str, float], words: str) -> None:
    serving = serve()
    status, text, _ = ask(f'{serving.url}api/load', body={'fx': 0, 'fy': 0, 'tz': 0, **body})
    assert (status, json.loads(text)['message']) == (400, words)
    assert serving.shown.loads == []


def test_loads_zeros_and_references_are_shown(serve: Serve) -> None:
    serving = serve()
    serving.feed.put(AppliedLoad(START_NS, 0.0, -10.0, 0.5))
    serving.feed.put(ParameterChange(START_NS + BLOCK_NS, 1, (('psd_1.zero', (0.0, 0.0)), ('psd_2.zero', (0.0, 0.0)))))
    serving.feed.put(ParameterChange(START_NS + BLOCK_NS, 1, (('sum_min', 2.0),)))
    # A tracker may be faster than the blocks: one of it for each block is enough.
    for k in range(40):
        serving.feed.put(ReferencePose(START_NS + k * BLOCK_NS // 10, 1e-3, -2e-3, 0.01 * k))
    serving.give(0, 1)
    messages = listen(serving.url, lambda m: 'rows' in m)
    t = START_NS / 1e9
    marks = [mark for m in messages for mark in m.get('marks', ())]
    assert marks == [[t, 'load', 0, -10, 0.5], [pytest.approx(t + 0.02, abs=1e-6), 'zero']]
    references = [r for m in messages for r in m.get('references', ())]
    wanted = [[pytest.approx(t + 0.02 * k, abs=1e-6), 0.001, -0.002, pytest.approx(0.1 * k)] for k in range(4)]
    assert references == wanted


def history_of(serving: Serving, seconds: float, **more: object) -> dict[str, Any]:
    """The answer for so many seconds from the first block on."""
    query = urlencode({'from': START_NS / 1e9, 'to': START_NS / 1e9 + seconds, **more})
    status, text, headers = ask(f'{serving.url}api/history?{query}', 'GET')
    assert (status, headers['Content-Type']) == (200, 'application/json; charset=utf-8')
    return dict(json.loads(text))


def column(answer: dict[str, Any], name: str) -> list[float]:
    return [float(v) for v in np.frombuffer(base64.b64decode(answer['columns'][name]), '<f4')]


@pytest.mark.skipif(not KEEPS, reason='an optional room')
def test_the_history_has_what_came_with_its_losses_and_marks(serve: Serve) -> None:
    serving = serve()
    serving.give(0, 100)
    serving.feed.put(Mark(START_NS + BLOCK_NS, 'bumped it'))
    serving.feed.put(ParameterChange(START_NS + BLOCK_NS, 1, (('psd_1.zero', (0.0, 0.0)),)))
    # Two blocks of which nothing came, four of which some did, two without light.
    serving.give(102, 4, lost=3)
    serving.give(106, 2, status=BlockStatus.LASER_LOST)
    # A number that no sample had, as the device began anew.
    serving.feed.put(ParameterChange(START_NS, 108, ((RESTART, (2160.0, 3000.0)),)))
    serving.give(150, 50)
    shown(serving, 199)
    serving.shown.alarmed = Alarm(START_NS + 2 * BLOCK_NS, START_NS + 4 * BLOCK_NS, 'x1', 3e-6, 1e-7)
    listen(serving.url, lambda m: any(mark[1] == 'alarm' for mark in m.get('marks', ())))
    answer = history_of(serving, 4.0)
    assert (answer['start'], answer['width'], answer['marks_left_out']) == (START_NS / 1e9, 1.0, 0)
    assert (column(answer, 'blocks'), column(answer, 'estimates')) == ([50, 50, 6, 50], [50, 50, 4, 50])
    assert column(answer, 'lost') == [0, 0, 2 * 20 + 4 * 3, 0]
    assert column(answer, 'dx_high')[0] == pytest.approx(1e-3, rel=1e-2)
    assert column(answer, 'dx_low')[0] == pytest.approx(-1e-3, rel=1e-2)
    assert column(answer, 'sum1') == [5.0] * 4
    assert [mark[1] for mark in answer['marks']] == ['mark', 'zero', 'alarm']
    assert answer['marks'][-1][2].startswith('x1 is +3.00 µm off')
    assert column(history_of(serving, 40.0, points=10), 'blocks') == [156]


@pytest.mark.skipif(not KEEPS, reason='an optional room')
@pytest.mark.parametrize(
    ('query', 'headers', 'status', 'words'),
    [
        ('from=1&to=noon', {}, 400, "rejected: to = 'noon': must be a time in s since 1970"),
        ('', {}, 400, 'rejected: from is missing'),
        ('from=1&to=2', {'Host': 'evil.example'}, 403, 'not the name of this machine'),
        ('from=1&to=2', {'Origin': 'http://evil.example'}, 403, 'asked for by another site'),
        ('from=1&to=2', {'Sec-Fetch-Site': 'cross-site'}, 403, 'asked for by another site'),
    ],
)
def test_who_may_not_see_the_page_does_not_get_its_history(
    serve: Serve, query: str, headers: dict[str, str], status: int, words: str
) -> None:
    answered, text, _ = ask(f'{serve().url}api/history?{query}', 'GET', headers=headers)
    assert (answered, words in text) == (status, True)


@pytest.mark.parametrize('headers', [{'Origin': 'http://evil.example'}, {'Host': 'evil.example'}])
def test_another_site_cannot_listen(serve: Serve, headers: dict[str, str]) -> None:
    serving = serve()
    with pytest.raises(aiohttp.WSServerHandshakeError, match='403'):
        listen(serving.url, lambda m: True, headers)


@pytest.mark.parametrize(
    ('request_line', 'rest', 'status'),
    [
        ('GET /page/' + 'a' * 4000, b'', 404),
        ('GET /' + 'a' * 9000, b'', 400),
        ('\x16\x03\x01\x02', b'', 400),
        ('POST /api/record', b'[' * 4000, 400),
        ('POST /api/record', b'\xff\xfe', 400),
        ('POST /api/record', b'', 400),
        ('POST /api/record', b'{}', 400),
        ('POST /api/record', b'x' * 5000, 413),
        ('PUT /', b'', 405),
        ('HEAD /', b'', 200),
    ],
)
def test_bad_requests_get_an_answer_and_no_log_line(
    serve: Serve, caplog: pytest.LogCaptureFixture, request_line: str, rest: bytes, status: int
) -> None:
    serving = serve(monitor_control=True)
    head = f'Host: 127.0.0.1\r\nContent-Type: application/json; charset=none\r\nContent-Length: {len(rest)}\r\n'
    with socket.create_connection(('127.0.0.1', serving.port), WAIT_S) as stranger:
        stranger.sendall(f'{request_line} HTTP/1.1\r\n{head}Connection: close\r\n\r\n'.encode() + rest)
        answer = stranger.makefile('rb').readline()
    assert (int(answer.split()[1]), caplog.records, len(serving.logged)) == (status, [], 1)
    assert ask(serving.url, 'GET')[0] == 200


def test_idle_connections_do_not_use_up_the_daemons_files(serve: Serve) -> None:
    serving = serve()

    async def go() -> None:
        async with aiohttp.ClientSession() as session, session.ws_connect(serving.url + 'ws') as browser:
            assert 'hello' in (await browser.receive()).data
            idle = [await asyncio.open_connection('127.0.0.1', serving.port) for _ in range(CONNECTIONS + 20)]
            for reader, _ in idle[:20]:
                assert await reader.read() == b''
            reader, writer = idle[-1]
            writer.write(b'GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n')
            assert b' 200 ' in await reader.readline()
            serving.give(0, 1)
            while 'rows' not in json.loads((await browser.receive()).data):
                pass
            for _, writer in idle:
                writer.close()

    asyncio.run(asyncio.wait_for(go(), WAIT_S))


def test_a_browser_silent_for_15_s_is_disconnected(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is asked after 10 s and has 5 s, by a clock that is put forward."""
    ahead = [0.0]

    def now(_: asyncio.BaseEventLoop) -> float:
        return time.monotonic() + ahead[0] * (threading.current_thread().name == 'monitor')

    monkeypatch.setattr(asyncio.BaseEventLoop, 'time', now)
    serving = serve()

    async def go() -> None:
        async with aiohttp.ClientSession() as http, http.ws_connect(serving.url + 'ws', autoping=False) as browser:
            assert 'hello' in (await browser.receive()).data
            for n, (ahead[0], wanted) in enumerate(((7.0, ''), (13.0, 'PING'), (16.5, ''), (20.0, 'CLOSED'))):
                kinds = set()
                for row in range(3 * n, 3 * n + 3):
                    serving.give(row, 1)
                    while (got := await browser.receive()).type.name == 'TEXT' and 'rows' not in got.data:
                        pass
                    kinds.add(got.type.name)
                assert ''.join(kinds - {'TEXT'}) == wanted

    asyncio.run(asyncio.wait_for(go(), WAIT_S))


def test_new_rows_are_looked_for_every_30_ms(monkeypatch: pytest.MonkeyPatch) -> None:
    slept = AsyncMock(side_effect=[None, asyncio.CancelledError])
    monkeypatch.setattr(asyncio, 'sleep', slept)
    rig = load_rig(overrides={'monitor_history': False})
    pump, health = MonitorServer(StillShown(rig), Feed(), rig.monitor, null_log).jobs()
    health.close()
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(pump)
    assert slept.call_args_list == [call(0.03)] * 2


def test_one_browser_too_many_gets_the_reason(serve: Serve) -> None:
    serving = serve()

    async def go() -> tuple[int | None, str]:
        async with aiohttp.ClientSession() as session:
            lookers = [await session.ws_connect(serving.url + 'ws') for _ in range(VIEWERS)]
            for looker in lookers:
                await looker.receive()
            late = await session.ws_connect(serving.url + 'ws')
            reported = await late.receive()
            for looker in lookers:
                await looker.close()
            return reported.data, reported.extra or ''

    assert asyncio.run(asyncio.wait_for(go(), WAIT_S)) == (1013, '16 viewers look on already')


def test_on_the_network_the_buttons_need_the_token(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    serving = serve(monitor_control=True, monitor_address='0.0.0.0')
    url = f'http://127.0.0.1:{serving.port}/'
    assert serving.logged[0].endswith(f'#token={serving.server.token}')
    assert len(serving.server.token) >= 20
    assert ask(url + 'api/zero')[0] == 401
    assert ask(url + 'api/zero', headers={'X-Monitor-Token': serving.server.token[:-1]})[0] == 401
    assert serving.shown.zeros == 0
    assert ask(url + 'api/zero', headers={'X-Monitor-Token': serving.server.token})[0] == 200
    assert serving.shown.zeros == 1
    hello = listen(url, lambda m: 'hello' in m)[0]['hello']
    assert hello['needs_token'] is True
    assert serving.server.token not in json.dumps(hello)
    monkeypatch.setenv('PSD_DEFLECTION_MONITOR_TOKEN', 'of my own')
    assert serve(monitor_control=True, monitor_address='0.0.0.0').server.token == 'of my own'


def test_a_port_in_use_is_reported_and_another_taken(serve: Serve) -> None:
    first = serve()
    second = serve(monitor_port=first.port)
    assert second.port != first.port
    assert 'is in use' in second.logged[0]
    assert ask(second.url, 'GET')[0] == 200


def test_an_address_of_another_machine_is_rejected() -> None:
    rig = load_rig(overrides={'monitor_address': '192.0.2.1', 'monitor_port': 0})
    server = MonitorServer(StillShown(rig), Feed(), rig.monitor, null_log)
    with pytest.raises(ConfigError, match=r"monitor_address = '192\.0\.2\.1'"):
        server.start()
    server.close()


OWN = socket.gethostname().lower()


@pytest.mark.parametrize(
    ('host', 'address', 'local'),
    [
        ('127.0.0.1:8790', '127.0.0.1', True),
        ('localhost:8790', '127.0.0.1', True),
        ('LOCALHOST', '127.0.0.1', True),
        ('[::1]:8790', '127.0.0.1', True),
        ('localhost.:8790', '127.0.0.1', True),
        # A foreign name that was made to point here.
        ('evil.example:8790', '127.0.0.1', False),
        ('localhost.evil.example', '127.0.0.1', False),
        ('127.0.0.1.evil.example', '127.0.0.1', False),
        ('192.0.2.1', '127.0.0.1', False),
        ('', '127.0.0.1', False),
        ('[::1', '127.0.0.1', False),
        ('evil.example', '0.0.0.0', False),
        ('192.0.2.1:8790', '0.0.0.0', True),
        ('[2001:db8::1]:8790', '::', True),
        (f'{OWN}:8790', '0.0.0.0', True),
        (f'{OWN}.local', '0.0.0.0', True),
        ('rig.example', 'rig.example', True),
        ('127.0.0.1%25x', '127.0.0.1', False),
        ('[::1%eth0]:8790', '127.0.0.1', True),
        ('127.0.0.1/.evil.example', '127.0.0.1', False),
        ('127.0.0.1#.evil.example', '127.0.0.1', False),
        ('evil.example@127.0.0.1', '127.0.0.1', False),
        ('127.0.0.1:8790:1', '127.0.0.1', False),
    ],
)
def test_a_host_header_must_name_this_machine(host: str, address: str, local: bool) -> None:
    assert is_own_host(host, address) is local


@pytest.mark.parametrize(
    ('headers', 'local'),
    [
        ({'Host': '127.0.0.1:8790'}, True),
        ({'Host': '127.0.0.1:8790', 'Origin': 'http://127.0.0.1:8790'}, True),
        ({'Host': '127.0.0.1:8790', 'Origin': 'http://127.0.0.1:8790', 'Sec-Fetch-Site': 'same-origin'}, True),
        ({'Host': '127.0.0.1:8790', 'Sec-Fetch-Site': 'none'}, True),
        ({'Host': '127.0.0.1:8790', 'Origin': 'http://127.0.0.1:8000'}, False),
        ({'Host': '127.0.0.1:8790', 'Origin': 'http://localhost:8790'}, False),
        ({'Host': '127.0.0.1:8790', 'Origin': 'https://evil.example'}, False),
        ({'Host': '127.0.0.1:8790', 'Origin': 'null'}, False),
        ({'Host': '127.0.0.1:8790', 'Sec-Fetch-Site': 'cross-site'}, False),
        ({'Host': '127.0.0.1:8790', 'Sec-Fetch-Site': 'same-site'}, False),
    ],
)
def test_a_request_must_come_from_our_own_page_or_from_none(headers: dict[str, str], local: bool) -> None:
    assert is_own_page(headers) is local


def test_loopback_and_a_token_are_told_from_others() -> None:
    assert all(map(is_loopback, ('127.0.0.1', '127.1.2.3', '::1', 'localhost', '127.0.0.1%x')))
    assert not any(map(is_loopback, ('0.0.0.0', '::', '192.0.2.1', 'rig', '')))
    assert is_token('abc', 'abc')
    assert not any(is_token(given, 'abc') for given in (None, '', 'ab', 'abcd', 'ähc', 'ab\udce9'))


def test_outdated_library_is_rejected_by_version(monkeypatch: pytest.MonkeyPatch) -> None:
    for version in ('3.9.0', '3.14.5', '4.0.0a1', '10.0'):
        monkeypatch.setattr('importlib.metadata.version', Mock(return_value=version))
        need_server()
    for version in ('3.8.4', '2.99.0'):
        monkeypatch.setattr('importlib.metadata.version', Mock(return_value=version))
        with pytest.raises(ConfigError, match=rf'needs aiohttp 3\.9 or later, {version} is installed'):
            need_server()


def numbers(text: str) -> dict[tuple[str, ...], float]:
    """Name and label values of each sample."""
    return {(s.name, *s.labels.values()): s.value for family in parsed(text) for s in family.samples}


def scraped(serving: Serving) -> dict[tuple[str, ...], float]:
    status, text, headers = ask(f'{serving.url}metrics', 'GET')
    assert status == 200
    assert headers['Content-Type'] == CONTENT_TYPE
    return numbers(text)


def shown(serving: Serving, index: int) -> None:
    """Wait until the page has this block."""
    listen(serving.url, lambda m: any(r[1] == index for r in m.get('rows', [])))


def test_a_scrape_has_counters_and_the_newest_estimate(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, 'FRESH_S', math.inf)
    serving = serve()
    before = scraped(serving)
    assert before[('psd_deflection_samples_total',)] == 40.0
    assert not any('meters' in key[0] for key in before)
    serving.give(0, 3)
    shown(serving, 2)
    after = scraped(serving)
    best = estimate_of(2)
    assert after[('psd_deflection_deflection_meters', 'y')] == best.dy
    assert after[('psd_deflection_deflection_sd_meters', 'x')] == pytest.approx(2e-7)
    assert (after[('psd_deflection_twist_radians',)], after[('psd_deflection_sum_volts', '2')]) == (best.theta, 5.0)
    assert after[('psd_deflection_page_dropped_total',)] == 0.0


def test_the_estimate_of_a_device_that_is_away_is_no_estimate(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(server, 'time', SimpleNamespace(**{**vars(time), 'monotonic': lambda: clock[0]}))
    serving = serve()
    serving.give(0, 1)
    shown(serving, 0)
    for clock[0], fresh in ((1.9, True), (2.1, False)):
        assert any('meters' in key[0] or 'volts' in key[0] for key in scraped(serving)) is fresh


@pytest.mark.parametrize(('headers', 'status'), [({'Host': 'evil.example'}, 403), ({}, 200)])
def test_it_has_the_gate_of_the_page(serve: Serve, headers: dict[str, str], status: int) -> None:
    url = serve().url
    assert ask(url, 'GET', headers=headers)[0] == status
    assert ask(f'{url}metrics', 'GET', headers=headers)[0] == status


def test_names_types_and_units_are_those_of_openmetrics() -> None:
    pipeline = Pipeline(load_rig())
    families: list[Any] = list(parsed(text_of([*of_pipeline(pipeline), *of_block(BlockResult(spots_of(1), None))])))
    types = {family.name: (family.type, family.unit) for family in families}
    assert types['psd_deflection_blocks'] == ('counter', '')
    assert types['psd_deflection_sum_volts'] == ('gauge', 'volts')
    assert types['psd_deflection_build'] == ('info', '')
    assert all(family.documentation for family in families)


def test_words_of_a_device_cannot_break_the_text() -> None:
    words = 'a "quoted" \\ word\nof two lines'
    text = text_of([counters('samples_lost', 'cause', 'Lost', {words: 3, '\udce9': 1})])
    values = numbers(text)
    assert values[('psd_deflection_samples_lost_total', words)] == 3.0
    assert values[('psd_deflection_samples_lost_total', '?')] == 1.0


def test_a_number_that_is_none_is_reported_as_one() -> None:
    text = text_of([Family('sum_volts', 'gauge', 'Sum', (({}, math.nan), ({'psd': '1'}, math.inf)), 'volts')])
    values = list(numbers(text).values())
    assert math.isnan(values[1])
    assert values[2] == math.inf


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A recording with a reference, as if it were being written."""
    folder = tmp_path / 'bag'
    made = simulate(None, [(0, 0, 0), (30, 0, 0), (0, -50, -29), (-40, 40, 20)], seconds=1, seed=4)
    convert(made, folder, made.parameters, Beside.of(made), made.blocks())
    return folder


def calibrations(url: str, until: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """What the page is told of the calibration, as soon as ``until`` accepts it."""

    def accepted(message: dict[str, Any]) -> bool:
        calibration = (message.get('health') or {}).get('calibration')
        return calibration is not None and until(calibration)

    last: dict[str, Any] = listen(url, accepted)[-1]['health']['calibration']
    return last


def asked(url: str, wanted: object) -> tuple[int, str]:
    status, text, _ = ask(url + 'api/calibrate', body={'calibrate': wanted})
    return status, json.loads(text)['message']


def test_it_shows_what_is_determined_and_ends_with_its_files(serve: Serve, bag: Path, tmp_path: Path) -> None:
    serving = serve(bag_dir=str(tmp_path / 'made'))
    serving.shown.folder = str(bag)
    assert asked(serving.url, True) == (200, 'calibrating: zero the unloaded link, then hang known loads and note each')
    assert asked(serving.url, True) == (409, 'a calibration runs already')
    progress = calibrations(serving.url, lambda c: 'parameters' in c)
    assert progress['running']
    assert progress['kind'] == 'reference'
    assert 0 < progress['determined'] < len(progress['parameters'])
    assert 1 <= len(progress['needs']) <= 4
    assert {'name', 'words', 'value', 'filled', 'determined'} <= set(progress['parameters'][0])
    status, words = asked(serving.url, False)
    assert (status, words) == (200, f'the calibration ends; its files: {progress["out"]}')
    ended = calibrations(serving.url, lambda c: not c['running'])
    assert ended['last'] == 'calibrated'
    assert {path.name for path in Path(ended['out']).iterdir()} == {'rig.yaml', 'report.html', 'calibration.json'}
    assert serving.shown.recordings == [str(bag), None]
    assert asked(serving.url, False) == (409, 'no calibration runs')


def test_why_it_could_not_is_reported(serve: Serve, tmp_path: Path) -> None:
    serving = serve(bag_dir=str(tmp_path))
    assert asked(serving.url, True)[0] == 200
    ended = calibrations(serving.url, lambda c: not c['running'])
    assert 'recordings/test: is not on this machine' in ended['last']


def test_a_played_recording_and_nonsense_are_rejected(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    serving = serve()
    assert asked(serving.url, 1) == (400, 'rejected: expected {"calibrate": true} or {"calibrate": false}')
    monkeypatch.setattr(serving.shown, 'describe', lambda: {'kind': 'replay', 'name': 'test', 'recording': None})
    assert asked(serving.url, True) == (409, 'a recording is played; psd-deflection calibrate takes it')
