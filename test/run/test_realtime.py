# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is asked of the system, with a system that rejects; systemd's socket with ourselves behind it."""

from __future__ import annotations

import errno
import os
import resource
import socket
from pathlib import Path
from typing import Any

import pytest

from psd_deflection.base.log import texts
from psd_deflection.run.processing import OutageLog
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


def test_watchdog_signals_twice_per_interval(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    systemd, clock = Systemd(tmp_path / 'notify'), Clock()
    monkeypatch.setenv('NOTIFY_SOCKET', str(tmp_path / 'notify'))
    monkeypatch.setenv('WATCHDOG_USEC', '4000000')
    monkeypatch.setenv('WATCHDOG_PID', str(os.getpid()))
    watchdog = Watchdog(clock)
    watchdog.ready()
    for _ in range(100):
        watchdog.alive()
        clock.now += 0.1
    watchdog.stopping()
    assert systemd.heard() == ['READY=1', *['WATCHDOG=1'] * 5, 'STOPPING=1']
    systemd.socket.close()


@pytest.mark.parametrize(
    'environment',
    [
        {},
        {'NOTIFY_SOCKET': '/nowhere/notify'},
        {'WATCHDOG_USEC': 'x'},
        {'NOTIFY_SOCKET': 'ours', 'WATCHDOG_USEC': 'x'},
        {'NOTIFY_SOCKET': 'ours', 'WATCHDOG_USEC': '4000000', 'WATCHDOG_PID': '1'},
    ],
)
def test_watchdog_does_nothing_without_systemd(
    environment: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    systemd, clock = Systemd(tmp_path / 'notify'), Clock()
    for name in ('NOTIFY_SOCKET', 'WATCHDOG_USEC', 'WATCHDOG_PID'):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, str(tmp_path / 'notify') if value == 'ours' else value)
    watchdog = Watchdog(clock)
    watchdog.ready()
    for _ in range(100):
        watchdog.alive()
        clock.now += 0.1
    watchdog.stopping()
    asked = environment.get('NOTIFY_SOCKET') == 'ours'
    assert systemd.heard() == (['READY=1', 'STOPPING=1'] if asked else [])
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
