"""What is asked of a session while its device is there, away, or silent."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator

import pytest

from psd_deflection.config import load_rig
from psd_deflection.protocol.frames import SampleFrame
from psd_deflection.runner import processing
from psd_deflection.runner import session as module
from psd_deflection.runner.diagnostics import STALE, HealthReporter
from psd_deflection.runner.session import Session
from test.heard import WAIT_S
from test.runner.conftest import Estimates, ScriptedDevice

Sample = Callable[..., SampleFrame]


class Running:
    """A session on ``device``, past its first estimates."""

    def __init__(self, device: ScriptedDevice, sample: Sample) -> None:
        self.said: queue.SimpleQueue[str] = queue.SimpleQueue()
        rig = load_rig(overrides={'port': str(device.link), 'keep_zero': False, 'realtime': False})
        self.session = Session(rig, self.said.put)
        estimates = Estimates(5)
        self.session.processing.sinks.append(estimates)
        self.session.start()
        device.send_frames(*(sample(seq) for seq in range(200)))
        assert estimates.enough.wait(WAIT_S)

    def heard(self, text: str) -> None:
        while text not in self.said.get(timeout=WAIT_S):
            pass


@pytest.fixture
def running(device: ScriptedDevice, sample: Sample, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    # However busy the machine is: only what a test does makes a device silent or a request late.
    monkeypatch.setattr(module, 'SILENT_S', 1e3)
    monkeypatch.setattr(processing, 'REQUEST_TIMEOUT_S', WAIT_S)
    one = Running(device, sample)
    yield one
    one.session.close()


def test_no_zero_is_taken_of_a_device_that_is_away(running: Running, device: ScriptedDevice) -> None:
    assert running.session.zero() is not None
    device.unplug()
    running.heard('waiting for it to come back')
    with pytest.raises(TimeoutError, match='no data flows'):
        running.session.zero()


def test_diagnostics_report_no_dots_while_the_device_is_away(running: Running, device: ScriptedDevice) -> None:
    def said_of_dots() -> list[tuple[int, str]]:
        report = health.report(time.time_ns())
        return [(e.level, e.message) for e in report.entries if e.name.startswith('psd_deflection: psd_')]

    health = HealthReporter(running.session)
    assert STALE not in dict(said_of_dots())
    device.unplug()
    running.heard('waiting for it to come back')
    # What came before the unplugging is told once more.
    said_of_dots()
    assert said_of_dots() == [(STALE, 'no samples')] * 2


def test_a_step_of_the_system_clock_moves_no_stamp_of_the_run(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    acquisition = running.session.acquisition
    before = acquisition.now_ns()
    real = time.time_ns
    monkeypatch.setattr(time, 'time_ns', lambda: real() - 3600 * 10**9)
    assert before <= acquisition.now_ns() < before + 600 * 10**9
    assert acquisition.system_clock_step_ns() == pytest.approx(-3600e9, abs=1e9)


def test_no_zero_is_taken_of_a_device_that_has_said_nothing_for_long(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, 'SILENT_S', -1e3)
    with pytest.raises(TimeoutError, match='no data flows'):
        running.session.zero()


def test_the_start_says_what_another_rig_has_as_in_the_thesis(device: ScriptedDevice) -> None:
    said: list[str] = []
    rig = load_rig(
        overrides={'port': str(device.link), 'keep_zero': False, 'realtime': False, 'dynamics.torsion_frequency': 9.0}
    )
    Session(rig, said.append).close()
    (line,) = [text for text in said if 'as in the thesis rig' in text]
    assert 'dynamics.bending_frequency = 14.0 Hz' in line
    assert 'torsion_frequency' not in line
