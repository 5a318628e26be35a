# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Alarms handed on: a real program and a real web server on this machine."""

import contextlib
import dataclasses
import json
import os
import shlex
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from unittest.mock import Mock

import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import texts
from psd_deflection.cli.main import main
from psd_deflection.measure.watch import Alarm
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import rig_at_start
from psd_deflection.run import alarm_out as module
from psd_deflection.run.alarm_out import AlarmOut, finding
from test.heard import WAIT_S

ALARM = Alarm(1_700_000_000_250_000_000, 1_700_000_004_000_000_000, 'x1', 5e-6, 0.2e-6, ('y1',))
NOT_HANDED_ON = '; an alarm was not handed on, and further ones are counted'


class Server:
    """Answers each POST with the next of ``answers``, then 200; ``got``: the bodies."""

    def __init__(self) -> None:
        self.answers: list[int] = []
        self.got: list[bytes] = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                server.got.append(self.rfile.read(int(self.headers['Content-Length'])))
                self.send_response(server.answers.pop(0) if server.answers else 200)
                self.send_header('Location', '/elsewhere')
                self.send_header('Content-Length', '0')
                self.end_headers()

            def do_GET(self) -> None:
                server.got.append(b'GET')
                self.send_response(200)
                self.end_headers()

            def log_message(self, format: str, *args: object) -> None:
                pass

        self._http = HTTPServer(('127.0.0.1', 0), Handler)
        self.url = f'http://127.0.0.1:{self._http.server_port}/hook'
        self._thread = threading.Thread(target=self._http.serve_forever, args=(0.01,))
        self._thread.start()

    def close(self) -> None:
        self._http.shutdown()
        self._thread.join()
        self._http.server_close()


@pytest.fixture
def server() -> Iterator[Server]:
    with contextlib.closing(Server()) as made:
        yield made


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, 'PAUSES_S', [0.0] * len(module.PAUSES_S))
    monkeypatch.setenv('no_proxy', '127.0.0.1')


def python(program: str, *arguments: str) -> str:
    """A command line that runs a line of Python."""
    return shlex.join([sys.executable, '-c', program, *arguments])


KEEP = 'import sys, pathlib; pathlib.Path(sys.argv[1]).open("a").write(sys.stdin.read())'


def forwarded(command: str = '', webhook: str = '', times: int = 1) -> tuple[AlarmOut, list[str]]:
    logged: list[str] = []
    out = AlarmOut(command, webhook, texts(logged.append), {'device': 'abc'})
    for _ in range(times):
        out.put(ALARM)
    assert out.close(2.0 * WAIT_S)
    return out, logged


def test_command_and_web_address_get_the_same_finding(tmp_path: Path, server: Server) -> None:
    output = tmp_path / 'it is; $(kept)'
    out, stated = forwarded(python(KEEP, str(output)), server.url)
    expected = finding(ALARM, {'device': 'abc'})
    assert (json.loads(output.read_text()), [json.loads(body) for body in server.got]) == (expected, [expected])
    assert stated == []
    assert (out.sent, out.failed) == (2, 0)
    assert expected['since'] == '2023-11-14T22:13:20.250Z'
    assert (expected['channel'], expected['shift'], expected['unit']) == ('x1', 5e-6, 'm')
    assert expected['text'] == f'since 2023-11-14T22:13:20.250Z: {ALARM.words}'
    # Of a CSV that counts from 0.
    assert finding(dataclasses.replace(ALARM, since_ns=3_489_000_000), {})['since'] == '3.489 s'


def test_no_shell_reads_the_command(tmp_path: Path) -> None:
    output = tmp_path / 'kept'
    forwarded(python(KEEP, str(output)) + f' ; touch {tmp_path}/made $(touch {tmp_path}/made)')
    assert [path.name for path in tmp_path.iterdir()] == ['kept']


def test_a_command_that_fails_is_reported_once_and_counted() -> None:
    out, stated = forwarded(python('import sys; sys.exit(3)'), times=3)
    assert (out.sent, out.failed) == (0, 3)
    failure = f'command {sys.executable}: ended with status 3'
    assert stated == [f'watch: {failure}{NOT_HANDED_ON}']
    assert out.values() == [('alarms handed on', '0'), ('alarms not handed on', f'3 {failure}')]


def test_a_command_that_hangs_is_killed_with_what_it_started(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    end_of = subprocess.Popen.communicate
    monkeypatch.setattr(subprocess.Popen, 'communicate', lambda p, text, timeout: end_of(p, text, timeout / 50.0))
    # What it started keeps the pipe open: the end is read only if that is killed too.
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    hang = f'exec 3>{shlex.quote(str(pipe))}; {python("import signal; signal.pause()")} & wait'
    out = AlarmOut(shlex.join(['sh', '-c', hang]), '', texts(lambda text: None))
    out.put(ALARM)
    with pipe.open() as end:
        assert end.read() == ''
    assert out.close(2.0 * WAIT_S)
    assert out.failure.endswith('did not end within 10 s, and was killed')


def test_a_command_that_reads_nothing_is_no_failure() -> None:
    out, stated = forwarded('true', times=2)
    assert (out.sent, stated) == (2, [])


def test_webhook_is_tried_three_times_for_each_alarm(server: Server) -> None:
    server.answers = [503, 500, 429, 503, 200]
    out, stated = forwarded('', server.url, times=2)
    assert len(server.got) == 5
    assert (out.sent, out.failed) == (1, 1)
    assert stated == [f'watch: webhook at 127.0.0.1: answers 429{NOT_HANDED_ON}']


@pytest.mark.parametrize('answer', [302, 404])
def test_permanent_error_or_redirection_is_tried_once(server: Server, answer: int) -> None:
    server.answers = [answer]
    out, _ = forwarded('', server.url)
    assert len(server.got) == 1
    assert (out.failed, out.failure) == (1, f'webhook at 127.0.0.1: answers {answer}')


def test_a_server_that_is_away_is_reported() -> None:
    with socket.create_server(('127.0.0.1', 0)) as taken:
        port = taken.getsockname()[1]
    out, stated = forwarded('', f'http://127.0.0.1:{port}/')
    assert out.failed == 1
    assert stated[0].startswith('watch: webhook at 127.0.0.1: cannot be reached (Connection refused)')


def test_alarms_that_wait_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    none = Mock(**{'return_value.is_alive.return_value': False})
    monkeypatch.setattr(threading, 'Thread', none)
    out, stated = forwarded('true', times=102)
    assert (out.failed, stated) == (2, [f'watch: alarms: 100 wait already{NOT_HANDED_ON}'])


def test_an_address_that_is_a_secret_stays_in_its_file(server: Server, tmp_path: Path) -> None:
    (tmp_path / 'address').write_text(f'{server.url}/secret\n')
    out, _ = forwarded('', str(tmp_path / 'address'))
    assert (len(server.got), out.sent) == (1, 1)
    (tmp_path / 'address').write_text('file:///secret')
    with pytest.raises(ConfigError) as rejected:
        AlarmOut('', str(tmp_path / 'address'), texts(lambda text: None))
    assert 'secret' not in str(rejected.value)


@pytest.mark.parametrize(
    ('command', 'webhook', 'words'),
    [
        ('"', '', 'is no command line'),
        (' ', '', 'no program of that name'),
        ('/nowhere/notify', '', 'no program of that name'),
        ('', 'file:///etc/passwd', 'must be an address http'),
        ('', 'http://', 'must be an address http'),
        ('', 'http://a b', 'must be an address http'),
        ('', 'http://a:0', 'must be an address http'),
        ('', 'http://a:b', 'must be an address http'),
        ('', '/nowhere/address', 'no file that can be read'),
    ],
)
def test_what_cannot_be_used_is_rejected_at_the_start(command: str, webhook: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        AlarmOut(command, webhook, texts(lambda text: None))


def drifting(path: Path, *more: str) -> Path:
    """A recording in which a laser wanders."""
    effect = 'laser_pointing_drift,psd=1,rate_x=3e-7'
    assert main(['simulate', '--out', str(path), '--loads', 'constant:0,0,0:20', '--effect', effect, *more]) == 0
    return path


def test_a_replay_hands_on_its_alarms(server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, output = drifting(tmp_path / 'drift.csv'), tmp_path / 'kept'
    argv = ['replay', str(path), '--watch', '--watch-command', python(KEEP, str(output)), '--watch-webhook', server.url]
    assert main(argv) == 0
    reported = json.loads(output.read_text())
    assert (reported, reported['recording']) == (json.loads(server.got[0]), str(path))
    assert reported['text'].partition(': ')[2] in capsys.readouterr().out
    assert main(['replay', str(path), '--watch-command', 'true']) == 2
    assert main(['replay', str(path), '--watch', '--watch-command', '/nowhere/notify']) == 2
    assert '--watch-command = ' in capsys.readouterr().err


@pytest.mark.slow
def test_no_recording_makes_a_replay_run_anything(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Parameters of a stranger's recording are no commands of the user's."""
    made = tmp_path / 'made'
    rig = f'/**:\n  ros__parameters:\n    watch: "on"\n    watch_command: touch {made}\n'
    (tmp_path / 'rig.yaml').write_text(rig)
    drifting(tmp_path / 'rec', '--params-file', str(tmp_path / 'rig.yaml'))
    recorded = rig_at_start(open_recording(tmp_path / 'rec'))
    assert recorded.acquisition.watch_command == f'touch {made}'
    assert main(['replay', str(tmp_path / 'rec'), '--watch']) == 0
    assert 'no longer matches its model' in capsys.readouterr().out
    assert not made.exists()
