# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What holds for every device that is declared, whoever adds one."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from psd_deflection.devices import PowerUp, survey
from psd_deflection.devices.registry import DEVICES, SIMULATED, find_device
from psd_deflection.rig.config import load_rig, rig_from_values

ROOT = Path(__file__).parent.parent.parent


@pytest.mark.parametrize('name', DEVICES)
def test_a_device_has_the_name_that_it_is_listed_by(name: str) -> None:
    device = find_device(name)
    assert device.name == name
    assert device.help


def test_registry_import_loads_no_device_or_simulation() -> None:
    code = (
        'import sys, psd_deflection.devices.registry as registry\n'
        'print([m for m in registry.DEVICES.values() if m in sys.modules], "serial" in sys.modules)\n'
        'for name in registry.DEVICES: registry.find_device(name)\n'
        'heavy = ("simulation.simulator", "simulation.loads", "simulation.modes", "devices.serve")\n'
        'print([m for m in heavy if "psd_deflection." + m in sys.modules])'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.splitlines() == ['[] False', '[]']


@pytest.mark.parametrize('name', [n for n in DEVICES if find_device(n).probe is not None])
def test_simulated_device_probe_suggests_its_rig(
    name: str, served: Any, unloaded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Each of them answers: however late, it is waited for.
    monkeypatch.setattr(survey, 'ANSWER_S', 0.1)
    monkeypatch.setattr(survey, 'ONCE_A_SECOND_S', 60.0)
    monkeypatch.setattr(survey, 'BOOT_S', 60.0)
    device = find_device(name)
    assert device.simulate is not None, 'what can be recognised can be tried without hardware'
    assert device.probe is not None
    twins = device.simulate(unloaded(load_rig()), PowerUp())
    assert len(twins) == device.probe.ports
    ports = survey.survey([device], [str(served(twin).link) for twin in twins])
    assert [port.source for port in ports] == [name] * len(twins)
    (suggested,) = survey.suggestions([device], ports)
    rig = rig_from_values(suggested)
    assert (rig.acquisition.source, rig.acquisition.port) == (name, ','.join(port.port for port in ports))


def test_an_unknown_device_cannot_be_simulated() -> None:
    assert 'nonsense' not in SIMULATED
    assert 3 not in SIMULATED
