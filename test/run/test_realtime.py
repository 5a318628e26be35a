# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is asked of a system that rejects; systemd's socket; lines that come again and again."""

import errno
import os
import resource
import socket
from pathlib import Path
from typing import Any

import pytest

from psd_deflection.base.log import WARNING, texts
from psd_deflection.run.processing import OutageLog
from psd_deflection.run.rate_limited_log import FIRST_WAIT_S, LONGEST_WAIT_S, MOST_REASONS, RateLimitedLog
from psd_deflection.run.realtime import Watchdog, lock_memory, prefer_reader


class Systemd:
    """Its end of the notification socket."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))
        self.socket.setblocking(False)

    def heard(self) -> list[str]:
        out = []
        while True:
            try:
                out.append(self.socket.recv(100).decode())
            except BlockingIOError:
                return out


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize(
    ('environment', 'heard'),
    [
        ({}, []),
        ({'NOTIFY_SOCKET': '/nowhere/notify'}, []),
        ({'WATCHDOG_USEC': 'x'}, []),
        ({'NOTIFY_SOCKET': 'ours', 'WATCHDOG_USEC': 'x'}, ['READY=1', 'STOPPING=1']),
        ({'NOTIFY_SOCKET': 'ours', 'WATCHDOG_USEC': '4000000', 'WATCHDOG_PID': '1'}, ['READY=1', 'STOPPING=1']),
        (
            {'NOTIFY_SOCKET': 'ours', 'WATCHDOG_USEC': '4000000', 'WATCHDOG_PID': 'own'},
            ['READY=1', *['WATCHDOG=1'] * 5, 'STOPPING=1'],
        ),
    ],
)
def test_watchdog_signals_twice_per_interval_if_asked_to(
    environment: dict[str, str], heard: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    systemd, clock = Systemd(tmp_path / 'notify'), Clock()
    for name in ('NOTIFY_SOCKET', 'WATCHDOG_USEC', 'WATCHDOG_PID'):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, {'ours': str(tmp_path / 'notify'), 'own': str(os.getpid())}.get(value, value))
    watchdog = Watchdog(clock)
    watchdog.ready()
    for _ in range(100):
        watchdog.alive()
        clock.now += 0.1
    watchdog.stopping()
    assert systemd.heard() == heard
    systemd.socket.close()


def test_rejected_system_resources_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def reject(*args: Any) -> None:
        raise PermissionError(errno.EPERM, 'Operation not permitted')

    monkeypatch.setattr(os, 'sched_setscheduler', reject)
    assert 'SCHED_FIFO 50 is rejected (Operation not permitted' in prefer_reader()
    monkeypatch.setattr(os, 'sched_setscheduler', lambda *args: None)
    assert prefer_reader() == 'reader: SCHED_FIFO 50'
    monkeypatch.setattr(os, 'geteuid', lambda: 1000)
    monkeypatch.setattr(resource, 'getrlimit', lambda which: (65536, 65536))
    assert 'not locked, the limit is 65536 bytes' in lock_memory()


def test_lines_about_estimates_come_once_a_second_with_counts() -> None:
    logged: list[str] = []
    outages = OutageLog(texts(logged.append))
    # Fifty blocks a second, every other one without an estimate, for ten seconds.
    for i in range(500):
        lost = i % 2 == 1
        outages.block('LASER_LOST' if lost else '', 'no estimate: laser 1 lost' if lost else '', 10.0 + 0.02 * i)
    assert 9 <= len(logged) <= 11
    assert logged[0] == 'no estimate: laser 1 lost'
    assert '25 blocks affected' in logged[1] or '26 blocks affected' in logged[1]
    before = len(logged)
    for i in range(500):
        outages.block('', '', 30.0 + 0.02 * i)
    assert len(logged) <= before + 1
    outages.block('SATURATED', 'no estimate: x1 saturated', 50.0)
    outages.block('', '', 52.0)
    assert logged[-2:] == ['no estimate: x1 saturated', 'estimates are back']


def test_line_per_second_for_a_day_is_few_lines() -> None:
    logged: list[str] = []
    rate_limited_log = RateLimitedLog(texts(logged.append))
    for k in range(86_400):
        # The words may differ each time: it is the kind that counts.
        rate_limited_log.log('hello', f'HELLO {k} rejected', WARNING, 1000.0 + k)
    assert logged[:2] == ['HELLO 0 rejected', 'HELLO 10 rejected (and 9 more like it)']
    assert len(logged) < 40
    rate_limited_log.settle(1000.0 + 86_400 + LONGEST_WAIT_S)
    last = logged.pop()
    repeats = sum(int(line.split('(and ')[1].split()[0]) for line in logged if '(and ' in line)
    assert repeats + len(logged) + int(last.split(' more in')[0]) == 86_400


def test_what_was_counted_is_reported_when_it_is_due() -> None:
    logged: list[str] = []
    rate_limited_log = RateLimitedLog(texts(logged.append))
    for _ in range(3):
        rate_limited_log.log('restart', 'started anew', WARNING, 5.0)
    assert logged == ['started anew']
    rate_limited_log.settle(5.0 + 0.9 * FIRST_WAIT_S)
    assert len(logged) == 1
    rate_limited_log.settle(5.0 + FIRST_WAIT_S)
    # It may be over by now, so the line says when it was.
    assert logged[1:] == ['2 more in the last 10 s: started anew']
    rate_limited_log.settle(1e6)
    assert len(logged) == 2


def test_first_lines_and_those_after_quiet_are_logged() -> None:
    logged: list[str] = []
    rate_limited_log = RateLimitedLog(texts(logged.append))
    for k in range(5):
        rate_limited_log.log('away', f'gone {k}', WARNING, float(k), at_once=3)
    assert logged == ['gone 0', 'gone 1', 'gone 2']
    rate_limited_log.settle(1e5)
    rate_limited_log.log('away', 'gone again', WARNING, 2e5, at_once=3)
    assert logged[3:] == ['2 more in the last 99998 s: gone 4', 'gone again']


def test_new_reason_is_logged_at_once_and_counts_alone() -> None:
    logged: list[str] = []
    rate_limited_log = RateLimitedLog(texts(logged.append))
    for k in range(5):
        rate_limited_log.log('load', f"frame_id 'world{k}' at {k}.5e-3 s", WARNING, 100.0 + k)
    rate_limited_log.log('load', 'force x = nan', WARNING, 105.0)
    rate_limited_log.log('load', 'force x = nan', WARNING, 105.1)
    assert logged == ["frame_id 'world0' at 0.5e-3 s", 'force x = nan']
    rate_limited_log.settle(116.0)
    assert logged[2:] == [
        "4 more in the last 16 s: frame_id 'world4' at 4.5e-3 s",
        '1 more in the last 11 s: force x = nan',
    ]


def test_reasons_without_end_are_few_lines_and_none_is_forgotten() -> None:
    logged: list[str] = []
    rate_limited_log = RateLimitedLog(texts(logged.append))
    for k in range(1000):
        rate_limited_log.log('load', 'x' * (k + 1), WARNING, 100.0)
    assert len(logged) == MOST_REASONS + 1
    rate_limited_log.settle(1e6)
    assert logged[-1].startswith(f'{1000 - MOST_REASONS - 1} more in the last ')
    # Those that are quiet make room.
    rate_limited_log.log('load', 'another', WARNING, 2e6)
    assert logged[-1] == 'another'
