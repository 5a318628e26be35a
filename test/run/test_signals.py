# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""SIGINT, SIGTERM and SIGHUP without ROS: they end the waiting for a device at once, and nothing else at once."""

from __future__ import annotations

import errno
import io
import os
import signal
import threading
from typing import Any

import pytest

from psd_deflection.cli._display import Display, live_line
from psd_deflection.run.headless import run_headless
from psd_deflection.run.monitor.start import start_views
from psd_deflection.run.session import Session
from psd_deflection.run.signals import Signals, StopRequestedError


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_waiting_for_a_silent_device(
    device: Any, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    device.answer = b''
    monkeypatch.setattr('psd_deflection.run.reading.acquisition.SILENCE_S', 60.0)
    # Under nohup the tests themselves are started with SIGHUP ignored.
    before = signal.signal(number, signal.SIG_DFL)

    def end() -> None:
        device.greeted.wait(60.0)
        os.kill(os.getpid(), number)

    threading.Thread(target=end, daemon=True).start()
    try:
        assert run_headless({'port': str(device.link)}, Display().log, lambda session: None, start_views) == 0
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, before)


def test_a_signal_ends_the_waiting_for_one_that_is_away(device: Any, sample: Any) -> None:
    """The port is back and nothing answers: the daemon hears it out, and stops when it is told."""

    def look(session: Session) -> None:
        if session.acquisition.counters.samples < 20:
            device.send_frames(*[sample(s) for s in range(len(sent), len(sent) + 20)])
            sent.extend(range(20))
        elif not away:
            away.append(True)
            device.unplug()
        elif session.acquisition.away and not shown:
            shown.append(live_line(session, 0.0))
            device.answer = b''
            device.plug()
            threading.Thread(target=end, daemon=True).start()

    def end() -> None:
        device.greeted.wait(60.0)
        os.kill(os.getpid(), signal.SIGINT)

    sent: list[int] = []
    away: list[bool] = []
    shown: list[str] = []
    values: dict[str, object] = {'port': str(device.link), 'keep_zero': False, 'realtime': False}
    assert run_headless(values, Display().log, look, start_views) == 0
    assert away
    assert 'no samples: the device is away' in shown[0]


def test_what_runs_is_not_torn() -> None:
    signals = Signals()
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        assert signals.stop
        with pytest.raises(StopRequestedError):
            signals.interruptible(lambda: None)
    finally:
        signals.restore()


def test_a_hang_up_that_is_to_be_passed_over_is() -> None:
    """``nohup``."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        signals = Signals()
        os.kill(os.getpid(), signal.SIGHUP)
        assert not signals.stop
        signals.restore()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_display_survives_a_closed_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.EIO, 'Input/output error')

    display = Display()
    monkeypatch.setattr('sys.stderr', Gone())
    display.log('unheard')
    heard = io.StringIO()
    monkeypatch.setattr('sys.stderr', heard)
    display.log('heard')
    assert heard.getvalue() == 'heard\n'
