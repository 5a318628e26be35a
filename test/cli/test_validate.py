# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``psd-deflection validate``: what it prints, writes and rejects."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

import psd_deflection
from psd_deflection.base.errors import PsdDeflectionError
from psd_deflection.cli.main import main
from psd_deflection.rig.config import load_rig

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight seconds with two steps, and the true pose in it as a reference."""
    path = tmp_path_factory.mktemp('run') / 'run.csv'
    loads = 'steps:0,0,0;0,-10,-5.85;0,0,0:2.5'
    assert main(['simulate', '--out', str(path), '--loads', loads, '--reference']) == 0
    return path


@pytest.fixture(scope='module')
def late(run: Path) -> Path:
    """The reference in a table of its own, 12.5 ms late, with one rejected frame."""
    path = run.parent / 'camera.csv'
    with run.open() as stream, path.open('w') as out:
        out.write('t,dx,dy,theta,sd_dx,sd_dy,sd_theta,status\n')
        for row in csv.DictReader(stream):
            if row['ref_dx']:
                pose = ','.join(row[name] for name in ('ref_dx', 'ref_dy', 'ref_theta'))
                out.write(f'{float(row["t"]) + 0.0125:.6f},{pose},1e-7,1e-7,1e-6,ok\n')
        out.write('7.6,,,,,,,blurred\n')
    return path


def test_the_offset_is_reported_and_removed_if_asked(run: Path, late: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['validate', str(run), '--reference', str(late), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    # The blocks' stamps lie in the middle of 20 samples; the row of the reference is the next one, half a sample on.
    assert found['offset']['value'] == pytest.approx(-0.0125, abs=0.6e-3)
    assert found['offset']['determined']
    assert not found['offset']['applied']
    assert found['rejected'] == {'blurred': 1}
    without = found['solvers']['exact']['dy']['rms']
    assert main(['validate', str(run), '--reference', str(late), '--align', '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['offset']['applied']
    assert found['solvers']['exact']['dy']['rms'] < 0.01 * without


def test_other_solvers_are_compared_if_asked(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def compared(*words: str) -> list[str]:
        assert main(['validate', str(run), '--json', *words]) == 0
        return list(json.loads(capsys.readouterr().out)['solvers'])

    assert compared() == ['exact']
    assert compared('--solver', 'wls', '--solver', 'beam') == ['exact', 'wls', 'beam']
    everyone = compared('--solver', 'all')
    assert everyone[0] == 'exact'
    assert {'wls', 'beam', 'appendix_d'} < set(everyone)
    with pytest.raises(SystemExit):
        main(['validate', str(run), '--solver', 'bean'])
    assert "invalid choice: 'bean'" in capsys.readouterr().err


def test_unsuitable_solver_is_reported_if_named(run: Path) -> None:
    # Both centres on one line through the middle.
    rig = load_rig(overrides={'psd_2.center': [0.0, -0.07]})
    assert 'appendix_d' not in psd_deflection.validate(run, rig=rig, solvers=['all']).agreements
    with pytest.raises(PsdDeflectionError, match='appendix_d divides by both'):
        psd_deflection.validate(run, rig=rig, solvers=['appendix_d'])


def test_a_recording_without_a_reference_says_how_to_give_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'bare.csv'
    assert main(['simulate', '--out', str(path), '--loads', 'constant:0,0,0:1']) == 0
    capsys.readouterr()
    assert main(['validate', str(path)]) == 4
    assert 'holds no reference' in capsys.readouterr().err
