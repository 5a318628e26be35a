# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``devices``: what answers on a port, from the simulated devices and from none."""

import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from psd_deflection.cli.main import main
from psd_deflection.devices import survey as port_survey
from psd_deflection.devices.contract_frames import SimulatedFrames
from psd_deflection.devices.ports import SerialPort
from psd_deflection.devices.registry import known_devices
from psd_deflection.devices.survey import serial_ports, survey
from psd_deflection.rig.config import load_rig

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_survey, 'BOOT_S', 0.3)


def test_a_name_that_is_no_port_is_a_mistake_of_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['devices', 'tcp://rig:4000']) == 2
    assert 'did you mean socket://?' in capsys.readouterr().err


def test_a_host_that_is_not_there_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(('127.0.0.1', 0)) as free:
        name = f'socket://127.0.0.1:{free.getsockname()[1]}'
    assert main(['devices', name]) == 5
    assert f'{name}: the host is there, but nothing listens' in capsys.readouterr().err


def test_a_port_in_use_or_missing_is_named_and_left_alone(
    served: Any, unloaded: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = str(served(SimulatedFrames(unloaded(load_rig()))).link)
    mine = SerialPort(name, 921_600)
    busy, missing = survey(known_devices()[0], [name, str(tmp_path / 'none')])
    assert main(['devices', name]) == 5
    mine.close()
    assert (main(['devices', name]), main(['devices', '--json', name, str(tmp_path / 'none')])) == (0, 5)
    assert 'no such port' in capsys.readouterr().out
    assert 'another program has the port open' in busy.answer
    assert 'no such port' in missing.answer
    assert busy.source == missing.source == ''


def test_something_else_is_reported_to_be_something_else(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_survey, 'BOOT_S', 20.0)
    monkeypatch.setattr(port_survey, 'ANSWER_S', 0.1)
    monkeypatch.setattr(port_survey, 'ONCE_A_SECOND_S', 0.1)

    class Other:
        def greeting(self) -> bytes:
            return b''

        def due_in_ns(self, since_power_up_ns: int) -> int:
            return 1_000_000

        def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
            return b''

        def take(self, since_power_up_ns: int, room: int = 4096) -> bytes:
            return b'$GPGGA,123519\r\n'

    (device,) = survey(known_devices()[0], [str(served(Other()).link)])
    assert device.source == ''
    assert 'bytes that we cannot read at 921600 baud' in device.answer


def test_the_system_s_list_is_taken_without_the_fixed_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = [
        SimpleNamespace(device='/dev/ttyS0', hwid='n/a', description='n/a', serial_number=None),
        SimpleNamespace(device='/dev/ttyACM0', hwid='USB VID:PID=1209:0001', description='PSD', serial_number='A7'),
    ]
    monkeypatch.setattr('serial.tools.list_ports.comports', lambda: listed)
    (port,) = serial_ports()
    assert (port.port, port.description) == ('/dev/ttyACM0', 'PSD')


def test_no_ports_at_all(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr('serial.tools.list_ports.comports', list)
    assert main(['devices']) == 0
    assert 'no serial ports' in capsys.readouterr().out
