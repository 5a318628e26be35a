# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``effects``: the catalogue as a list, and each effect with a command that shows it."""

import json
import shlex
from pathlib import Path

import pytest

from psd_deflection.cli.main import main
from psd_deflection.model.simulation.catalogue import catalogue


def test_the_list_has_every_effect(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['effects']) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, effect in catalogue().items():
        assert [line for line in lines if line.startswith(name + ' ') and effect.summary in line]


@pytest.mark.parametrize('name', catalogue())
def test_an_effect_is_explained_with_a_command_that_runs(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['effects', name]) == 0
    text = capsys.readouterr().out
    effect = catalogue()[name]
    assert effect.equation in text
    for p in effect.parameters:
        assert f'{p.name}: {p.description}' in text
    command = next(line.split('psd-deflection ')[1] for line in text.splitlines() if line.startswith('  try'))
    words = shlex.split(command)
    words[words.index('--out') + 1] = str(tmp_path / 'run.csv')
    words[words.index('--loads') + 1] = 'constant:0,-50,0:0.1'
    assert main(words) == 0
    assert name in capsys.readouterr().out


def test_programs_get_the_declaration(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['effects', 'sensor_rotation', '--json']) == 0
    found = json.loads(capsys.readouterr().out)['sensor_rotation']
    assert found['corrected'] == 'reading'
    assert found['parameters']['angle']['unit'] == 'rad'
    assert found['parameters']['psd']['choices'] == [1, 2, 3, 4, 5, 6]


def test_a_wrong_name_is_reported_with_the_right_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['effects', 'sensor_rotatoin']) == 2
    assert 'did you mean sensor_rotation' in capsys.readouterr().err
