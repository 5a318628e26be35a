# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A made-up device, as ``docs/devices/README.md`` says to add one: in a package of its own, found by its entry point.

The page's own code and entry point are installed into a folder that this process and those that it starts look into.
"""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.base.log import null_log, texts
from psd_deflection.cli.main import main
from psd_deflection.devices import PowerUp
from psd_deflection.devices.registry import GROUP, SIMULATED, find_device, known_devices, make_source, source_names
from psd_deflection.devices.serve import simulated_devices
from psd_deflection.rig.config import load_rig
from psd_deflection.run.session import Session
from test.heard import WAIT_S
from test.plug_in import install_plug_in
from test.run.conftest import Estimates

PAGE = Path(__file__).parent.parent.parent / 'docs' / 'devices' / 'README.md'
NAME = 'my_converter'


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, code: str, entry_point: str) -> None:
    install_plug_in(folder, monkeypatch, 'converter', code, f'[{GROUP}]\n{entry_point}\n')


@pytest.fixture
def code() -> str:
    (block,) = re.findall(r'```python\n(.*?)```', PAGE.read_text(), re.DOTALL)
    return str(block)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    (entry_point,) = re.findall(rf'^    ({NAME} = .*)$', PAGE.read_text(), re.MULTILINE)
    install(tmp_path, monkeypatch, code, entry_point)


@pytest.mark.usefixtures('installed')
def test_it_is_listed_made_and_known_to_be_simulated() -> None:
    assert source_names()[-1] == NAME
    devices, rejections = known_devices()
    assert (devices[-1].name, devices[-1].help, rejections) == (NAME, 'six voltages a line', [])
    assert NAME in SIMULATED
    assert list(SIMULATED)[-1] == NAME
    source = make_source(load_rig(overrides={'source': NAME, 'port': '/nowhere'}))
    with pytest.raises(DeviceError, match=r'/nowhere: no such port'):
        source.open(0.1)


@pytest.mark.usefixtures('installed')
def test_a_session_without_a_port_runs_on_its_twin() -> None:
    logged: list[str] = []
    estimates = Estimates(4)
    session = Session(load_rig(overrides={'source': NAME}), texts(logged.append))
    try:
        session.processing.sinks.append(estimates)
        session.start()
        assert estimates.enough.wait(WAIT_S)
    finally:
        session.close()
    assert session.failed is None
    assert session.simulated
    assert session.acquisition.counters.bad <= 1, 'only what was half sent when the port was opened'
    assert any('my converter on' in text for text in logged)


@pytest.mark.usefixtures('installed')
def test_the_survey_recognises_it(
    served: Any, unloaded: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr('psd_deflection.devices.survey.ANSWER_S', 0.2)
    simulate = find_device(NAME).simulate
    assert simulate is not None
    (twin,) = simulate(unloaded(load_rig()), PowerUp())
    port = str(served(twin).link)
    assert main(['devices', '--json', port]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert (tree['suggested'], tree['ports'][0]['answer']) == ([{'source': NAME, 'port': port}], 'my converter 7')


def test_one_without_a_twin_is_rejected_where_a_twin_is_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str
) -> None:
    install(tmp_path, monkeypatch, code, f'{NAME} = my_package.converter:MyConverter')
    assert NAME in source_names()
    assert NAME not in SIMULATED
    with pytest.raises(ConfigError, match=rf"source = '{NAME}': cannot be simulated; serial, dataq, .* can"):
        simulated_devices(NAME, load_rig())
    with pytest.raises(DeviceError, match='no such port'):
        Session(load_rig(overrides={'source': NAME}), null_log)


def test_one_that_declares_another_name_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    install(tmp_path, monkeypatch, code, 'other = my_package.converter:DEVICE')
    with pytest.raises(ConfigError, match=f"source = 'other': .* declares itself as '{NAME}'"):
        find_device('other')


def test_broken_plug_in_does_not_hide_other_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, monkeypatch, 'import a_package_that_is_not_there', f'{NAME} = my_package.converter:DEVICE')
    monkeypatch.setattr('serial.tools.list_ports.comports', list)
    assert main(['devices']) == 0
    assert f"not asked for: source = '{NAME}'" in capsys.readouterr().err
