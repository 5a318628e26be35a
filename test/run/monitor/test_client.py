# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The commands that speak to a running daemon without ROS."""

import json
import os
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from psd_deflection.cli.main import COMMANDS, main
from psd_deflection.records import BlockStatus
from psd_deflection.run.monitor import client
from psd_deflection.run.monitor.served import Served, announce, served_pages
from test.heard import WAIT_S
from tools.program import ROOT

from .serving import START_NS, Serving
from .test_server import listen

Serve = Callable[..., Serving]
Capsys = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def nobody_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """A daemon of somebody else on the usual port is not asked."""
    monkeypatch.setattr(client, 'DEFAULT_URL', 'http://127.0.0.1:9/')


def test_zero_record_load_and_mark_reach_the_daemon(serve: Serve, capsys: Capsys) -> None:
    serving = serve()
    assert (main(['zero']), main(['record'])) == (0, 0)
    assert (main(['record', 'stop']), main(['load', '0', '-10', '0.5'])) == (0, 0)
    assert (main(['load', '--add', '-1e1', '0', '0']), main(['load', '0', '0', '1', '--ago', '3.4'])) == (0, 0)
    assert main(['load', '0', '0', '1', '--ago', 'step']) == 0
    assert serving.shown.agos == [0.0, 0.0, 3.4, None]
    assert main(['mark', 'bumped', 'it']) == 0
    assert serving.shown.marks == ['bumped it']
    # A zero, four loads and a mark, of the time at which this program was started.
    assert len(serving.shown.lates) == 6
    assert 0.0 < serving.shown.lates[0] < serving.shown.lates[-1]
    assert (serving.shown.zeros, serving.shown.recordings) == (1, ['recordings/test', None])
    assert serving.shown.loads[:2] == [(0.0, -10.0, 0.5, False), (-10.0, 0.0, 0.0, True)]
    answers = ['unloaded dots taken', 'recording', 'recording ended', *['load noted'] * 4, 'mark: bumped it']
    assert capsys.readouterr().out.splitlines() == answers


def test_a_rejection_is_an_error_with_its_reason(serve: Serve, capsys: Capsys) -> None:
    serving = serve()
    serving.shown.rejection = 'not zeroed: no data flows'
    assert main(['zero']) == 7
    assert capsys.readouterr().err == f'psd-deflection zero: {serving.url}: not zeroed: no data flows\n'


@pytest.mark.parametrize('command', ['zero', 'mark', 'load', 'record', 'echo'])
def test_what_speaks_to_a_daemon_starts_without_scipy(command: str) -> None:
    code = f'from psd_deflection.cli.main import make_parser; make_parser([{command!r}])'
    code += f'; import psd_deflection.cli.run.{command}, sys; sys.exit("scipy" in sys.modules)'
    assert subprocess.run([sys.executable, '-c', code], cwd=ROOT, check=False).returncode == 0


def test_zero_waits_for_a_link_that_moves(serve: Serve, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    serving = serve()
    serving.shown.rejection = 'not zeroed: the link moves: y1 varied by 80.0 µm rms'
    assert main(['zero', '--wait', '0']) == 7
    assert 'the link moves: y1 varied' in capsys.readouterr().err
    waited: list[float] = []

    def rests(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) == 3:
            serving.shown.rejection = ''

    monkeypatch.setattr('psd_deflection.cli.run.zero.time.sleep', rests)
    assert main(['zero']) == 0
    assert len(waited) == 3
    assert serving.shown.lates[1] > 0.0 == serving.shown.lates[-1]  # It waited for the rest: that is of its end.
    assert capsys.readouterr() == ('unloaded dots taken\n', '')


CALIBRATE = ['calibrate', '--live', '--params-file', str(ROOT / 'config' / 'thesis_rig.yaml'), '--out']


@pytest.mark.skipif('calibrate' not in COMMANDS, reason='an optional room')
def test_calibrate_needs_the_recording_on_this_machine(serve: Serve, tmp_path: Path, capsys: Capsys) -> None:
    serving = serve()
    assert main([*CALIBRATE, str(tmp_path / 'out')]) == 4
    assert 'recordings/test: is not on this machine' in capsys.readouterr().err
    assert serving.shown.recordings == ['recordings/test', None]


def test_echo_prints_new_blocks(serve: Serve, capsys: Capsys) -> None:
    serving = serve()
    serving.give(0, 3)
    listen(serving.url, lambda m: 'rows' in m)
    connected = threading.Event()
    reported = client.messages

    async def noticed(daemon: client.Daemon) -> object:
        async for message in reported(daemon):
            connected.set()
            yield message

    def give() -> None:
        assert connected.wait(WAIT_S)
        serving.give(3, 1)
        serving.give(4, 1, status=BlockStatus.LASER_LOST, lost=2)

    for arguments in ([], ['--json']):
        connected.clear()
        giver = threading.Thread(target=give)
        giver.start()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(client, 'messages', noticed)
            assert main(['echo', '--count', '2', *arguments]) == 0
        giver.join()
        first, second = capsys.readouterr().out.splitlines()
        if arguments:
            row = json.loads(first)
            assert (row['t'], row['block'], row['status']) == (START_NS / 1e9 + 0.06, 3, 'ok')
            assert row['dx'] == pytest.approx(1e-3 * 0.29552, rel=1e-4)
            assert row['sd_theta'] == 3e-6
            assert json.loads(second)['dx'] is None
        else:
            assert 'ΔX   +295.52 ± 0.20 µm  ΔY   -955.34 ± 0.30 µm  θ   +169.32 ± 0.17 mdeg' in first
            assert second.endswith('no estimate: laser lost  lost 2')


def test_the_token_of_an_own_daemon_on_the_network_is_found(serve: Serve, capsys: Capsys) -> None:
    serving = serve(monitor_control=True, monitor_address='0.0.0.0')
    assert main(['zero']) == 0
    url = f'http://127.0.0.1:{serving.port}/'
    # Under another name it is not known to be the same; then the address must hold the token.
    assert main(['zero', '--url', url]) == 7
    assert 'the token is missing or wrong' in capsys.readouterr().err
    assert main(['zero', '--url', f'{url}#token={serving.server.token}']) == 0
    assert main(['zero', '--url', f'127.0.0.1:{serving.port}/#token={serving.server.token}']) == 0
    assert serving.shown.zeros == 3


def test_the_page_is_announced_to_its_user_alone(serve: Serve, own_state: Path) -> None:
    serving = serve()
    (file,) = own_state.glob('page_*')
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert served_pages() == [Served(serving.url, '', 'test', os.getpid())]
    serving.server.close()
    assert list(own_state.glob('page_*')) == []


def test_what_a_killed_daemon_left_is_removed(own_state: Path) -> None:
    gone = subprocess.Popen([sys.executable, '-c', ''])
    gone.wait()
    announce(Served('http://127.0.0.1:1/', '', 'gone', gone.pid))
    (own_state / 'page_1_1.json').write_text('[' * 100_000)
    assert served_pages() == []
    assert [p.name for p in own_state.glob('page_*')] == ['page_1_1.json']


def test_several_daemons_are_listed(serve: Serve, capsys: Capsys) -> None:
    first, second = serve(), serve()
    assert main(['zero']) == 7
    output = capsys.readouterr().err
    assert first.url in output
    assert second.url in output
    assert '--url' in output
    assert main(['zero', '--url', second.url]) == 0
    assert (first.shown.zeros, second.shown.zeros) == (0, 1)


@pytest.mark.parametrize('command', [['zero'], ['record'], ['load', '0', '0', '0'], ['mark', 'x'], ['echo']])
def test_without_a_daemon_the_error_says_how_to_start_one(command: list[str], capsys: Capsys) -> None:
    assert main(command) == 7
    output = capsys.readouterr().err
    assert 'http://127.0.0.1:9/: no daemon answers (' in output
    assert 'psd-deflection estimator --monitor' in output
    assert output.count('\n') == 1


@pytest.mark.parametrize('text', ['-1,5', '1_0', 'ten'])
def test_a_load_that_is_no_number_says_so(text: str, capsys: Capsys) -> None:
    assert main(['load', '0', text, '0']) == 2
    output = capsys.readouterr().err
    assert f'FY {text}: must be a number' in output
    assert ('decimals have a point' in output) == (',' in text)


@pytest.fixture
def stranger() -> Iterator[str]:
    """A web server of somebody else."""

    class Answers(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b'<html>\x1b[31m')

        def do_GET(self) -> None:
            self.do_POST()

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(('127.0.0.1', 0), Answers)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f'http://127.0.0.1:{server.server_port}/'
    server.shutdown()
    thread.join()
    server.server_close()


def test_another_server_is_no_daemon(stranger: str, capsys: Capsys) -> None:
    assert main(['zero', '--url', stranger]) == 7
    output = capsys.readouterr().err
    assert 'is no answer of a daemon' in output
    assert '\x1b' not in output
    assert main(['echo', '--url', stranger]) == 7
    assert 'no daemon answers' in capsys.readouterr().err


def test_messages_of_another_version_are_an_error(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    async def strange(daemon: client.Daemon) -> object:
        yield {'hello': {'columns': ['t', 'dx'], 'statuses': []}}
        yield {'rows': [[1.0, 2.0, 3.0]]}

    serving = serve()
    monkeypatch.setattr(client, 'messages', strange)
    assert main(['echo', '--url', serving.url]) == 7
