# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``psd-deflection design``: what it prints and rejects."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from psd_deflection.cli.main import main
from psd_deflection.studies.thesis.scaling import ERRATA_B1, ERRATA_B2, MATERIALS

RIG = str(Path(__file__).parents[2] / 'config' / 'thesis_rig.yaml')


def test_both_tables_are_printed_with_every_erratum(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['design']) == 0
    out = capsys.readouterr().out
    assert '113.5 (113.6)' in out
    assert '0.00267 (0.00268)' in out
    for reason in (*ERRATA_B1.values(), *ERRATA_B2.values()):
        assert reason in out
    for material in MATERIALS:
        assert material.name in out


def test_a_rigs_placement_is_compared(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['design', '--params-file', RIG, '--sigma', '2e-6']) == 0
    out = capsys.readouterr().out
    rows = {line.split('  ')[0]: line.split() for line in reversed(out.splitlines())}
    assert rows['this rig'][-5:] == ['1.630', '1.828', '1.328', '2.451', '16.446']
    assert rows['best in the room'][-5:] == ['1.414', '1.414', '0.810', '1.000', '10.000']
    assert 'ΔX 1.15, ΔY 1.29, θ 1.64 times smaller' in out
    assert rows['this rig, two sensors'][-1] == 'unseen'


def test_programs_get_the_same_placements_in_si_units(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['design', '--params-file', RIG, '--sigma', '2e-6', '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    own, _, best = found['placements']
    assert own['centers'] == [[0.0, 0.07], [-0.1, 0.0]]
    assert own['sd'] == pytest.approx({'dx': 1.630e-6, 'dy': 1.828e-6, 'theta': math.radians(1.328e-3)}, rel=1e-3)
    assert best['sd'] == pytest.approx({'dx': 1.414e-6, 'dy': 1.414e-6, 'theta': math.radians(0.810e-3)}, rel=1e-3)


def test_sensors_on_one_spot_are_unseen_not_a_crash(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text('/**:\n  ros__parameters:\n    psd_2:\n      center: [0.0, 0.07]\n')
    assert main(['design', '--params-file', str(rig)]) == 0
    assert 'unseen' in capsys.readouterr().out
    assert main(['design', '--params-file', str(rig), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['placements'][0]['sd'] == {'dx': None, 'dy': None, 'theta': None}


@pytest.mark.parametrize('name', ['plan.png', 'plan.svg'])
def test_the_drawing_is_written(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / name
    arguments = ['--keep-out', '0.03', '--box', '-0.12', '0', '0.12', '0.12', '--out', str(out)]
    assert main(['design', '--params-file', RIG, *arguments]) == 0
    assert str(out) in capsys.readouterr().out
    assert out.read_bytes()[:5] in (b'\x89PNG\r', b'<?xml')


@pytest.mark.parametrize(
    ('arguments', 'status', 'message'),
    [
        (['--params-file', RIG, '--sigma', '0'], 2, '--sigma'),
        (['--params-file', RIG, '--radius', '-1'], 2, '--radius'),
        (['--params-file', RIG, '--out', 'plan.txt'], 2, '.png, .svg or .pdf'),
        (['--params-file', RIG, '--out', 'no/such/folder/plan.png'], 4, 'cannot be written'),
    ],
)
def test_bad_input_is_rejected_in_one_line(
    arguments: list[str], status: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['design', *arguments]) == status
    error = capsys.readouterr().err
    assert message in error
    assert error.count('\n') == 1
