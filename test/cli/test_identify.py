# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``psd-deflection identify``: what it prints and writes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from psd_deflection.cli.main import main
from psd_deflection.rig.config import load_rig

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two steps of a link at 11 Hz; its rig file says 14 Hz."""
    path = tmp_path_factory.mktemp('run') / 'run.csv'
    world = ['--world', 'dynamics.bending_frequency=11.0', '--world', 'dynamics.torsion_damping_ratio=0.01']
    assert main(['simulate', '--out', str(path), '--loads', 'steps:0,0,0;3,-10,-5.85;0,0,0:2', *world]) == 0
    return path


def test_the_modes_of_the_link_not_of_the_file(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['identify', str(run), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    for axis in ('dx', 'dy'):
        (mode,) = found['axes'][axis]['modes']
        assert found['axes'][axis]['how'] == 'ring-down'
        assert mode['frequency'] == pytest.approx(11.0, rel=5e-4)
        assert mode['damping_ratio'] == pytest.approx(0.02, rel=0.03)
    (torsion,) = found['axes']['theta']['modes']
    assert torsion['frequency'] == pytest.approx(21.0, rel=5e-4)
    assert torsion['damping_ratio'] == pytest.approx(0.01, rel=0.03)
    assert found['axes']['dy']['shaper']['name'] in ('zv', 'mzv', 'zvd', 'ei')
    assert set(found['parameters']) < set(load_rig(None).values)


def test_a_link_at_rest_says_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'still.csv'
    assert main(['simulate', '--out', str(path), '--loads', 'constant:0,0,0:2']) == 0
    capsys.readouterr()
    assert main(['identify', str(path)]) == 0
    assert capsys.readouterr().out.count('no mode stands out of the noise. Knock on the link') == 3
