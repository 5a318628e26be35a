# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``budget``, ``design`` and ``certificate``: what they print, draw and reject; the tables alone give every U."""

import contextlib
import csv
import json
import math
import re
from pathlib import Path

import pytest

from psd_deflection.cli.main import main
from psd_deflection.studies.budget.evaluate import CAUSES
from psd_deflection.studies.budget.inputs import INPUTS

RIG = str(Path(__file__).parents[2] / 'config' / 'thesis_rig.yaml')


def rig_file(folder: Path, line: str) -> str:
    (folder / 'rig.yaml').write_text(f'/**:\n  ros__parameters:\n    {line}\n')
    return str(folder / 'rig.yaml')


@pytest.mark.slow
def test_a_rig_without_room_says_which_dot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = rig_file(tmp_path, 'psd_1: {active_area: [0.004, 0.004], zero: [0.0, 0.003]}')
    assert main(['budget', '--params-file', path]) == 3
    assert 'psd_1 would lie at y = 3.00 mm, outside its ±2 mm' in capsys.readouterr().err


@pytest.mark.slow
def test_json_has_the_figures_in_si(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / 'chart.svg'
    arguments = ['--json', '--out', str(out), '--method', 'beam', '--load', '1', '-2', '0.5', '--monte-carlo', '100']
    assert main(['budget', *arguments, '--set', 'air_gradient=0', '--set', 'air_step = 0']) == 0
    got = json.loads(capsys.readouterr().out)
    assert (got['method'], got['load']) == ('beam', [1.0, -2.0, 0.5])
    assert [t['name'] for t in got['terms']] == [c.name for c in CAUSES]
    refraction = next(t for t in got['terms'] if t['name'] == 'refraction')
    assert (refraction['rms'], refraction['inputs']['air_gradient']) == ([0.0, 0.0, 0.0], 0.0)
    assert set(got['totals']) == {'per_estimate', 'systematic', 'known', 'total', 'monte_carlo'}
    assert got['totals']['total']['rms'][0] < 1e-4
    assert out.read_text(encoding='utf-8').startswith('<?xml')


@pytest.mark.slow
def test_everything_is_explained(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['budget', '--explain', '--set', 'pointing_drift=2e-6']) == 0
    out = capsys.readouterr().out
    assert 'pointing_drift = 2e-06 rad' in out
    assert 'spot on the sensor (3.1): 1.1110 mm' in out
    assert 'stop window of thesis_iteration: 57.30 mdeg' in out
    for cause in CAUSES:
        assert cause.formula in out
    for entry in INPUTS:
        assert entry.source in out


@pytest.mark.slow
def test_the_method_follows_the_rigs_solver(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['budget', '--params-file', rig_file(tmp_path, 'solver: wls'), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['method'] == 'wls'


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
    tree = json.loads(capsys.readouterr().out)
    current, _, best = tree['placements']
    assert current['centers'] == [[0.0, 0.07], [-0.1, 0.0]]
    assert current['sd'] == pytest.approx({'dx': 1.630e-6, 'dy': 1.828e-6, 'theta': math.radians(1.328e-3)}, rel=1e-3)
    assert best['sd'] == pytest.approx({'dx': 1.414e-6, 'dy': 1.414e-6, 'theta': math.radians(0.810e-3)}, rel=1e-3)


def test_sensors_on_one_spot_are_unseen_not_a_crash(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = rig_file(tmp_path, 'psd_2: {center: [0.0, 0.07]}')
    assert main(['design', '--params-file', rig]) == 0
    assert 'unseen' in capsys.readouterr().out
    assert main(['design', '--params-file', rig, '--json']) == 0
    assert json.loads(capsys.readouterr().out)['placements'][0]['sd'] == {'dx': None, 'dy': None, 'theta': None}


@pytest.mark.parametrize('name', ['plan.png', 'plan.svg'])
def test_the_drawing_is_written(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / name
    arguments = ['--keep-out', '0.03', '--box', '-0.12', '0', '0.12', '0.12', '--out', str(out)]
    assert main(['design', '--params-file', RIG, *arguments]) == 0
    assert str(out) in capsys.readouterr().out
    assert out.read_bytes()[:5] in (b'\x89PNG\r', b'<?xml')


LOADS = 'steps:0,0,0;0,-40,-20;40,0,15;-40,30,0;0,40,20;-40,-30,-15;20,0,-20;0,0,0:1'
WRONG = ('--effect', 'sensor_rotation,psd=2,angle=0.012', '--effect', 'sensor_gain,psd=1,x=0.01,y=-0.005')
AXES = ('dx', 'dy', 'theta')


@pytest.fixture(scope='module')
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('calibrated')
    recording = str(folder / 'run.csv')
    simulate = ['simulate', '--out', recording, '--reference-noise', '1e-5,5e-4', '--loads', LOADS]
    assert main([*simulate, *WRONG]) == 0
    assert main(['calibrate', recording, '--params-file', RIG, '--out', str(folder / 'new'), '--quiet']) == 0
    return folder / 'new'


@pytest.fixture(scope='module')
def certified(calibrated: Path) -> Path:
    out = calibrated.parent / 'certificate'
    fields = calibrated.parent / 'fields.yaml'
    fields.write_text('number: A-17\npsd_1: S1880 no. 4\nreference_certificate: 12345\npressure: 1013\n')
    more = ['--fields', str(fields), '--limit', '1e-4', '1e-4', '2e-3', '--set', 'reference_scale=2e-5']
    assert main(['certificate', str(calibrated), '--out', str(out), *more]) == 0
    return out


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


def test_the_page_has_the_same_numbers(certified: Path) -> None:
    page = (certified / 'certificate.html').read_text(encoding='utf-8')
    # What is shown to six digits in the page's table of inputs is the table's number.
    for row in _rows(certified / 'inputs.csv'):
        assert f'<td>{float(row["u"]):.6g}</td>' in page
    largest = _rows(certified / 'results.csv')[1]
    for axis, scale in zip(AXES, (1e6, 1e6, math.degrees(1e3)), strict=True):
        assert f'<td>{scale * float(largest[f"U_{axis}"]):.3f}</td>' in page
    for words in ('A-17', 'S1880 no. 4', '12345', '1013', 'date, signature', 'guard band U', '. . . .'):
        assert words in page
    assert re.search(r'motion slower than 45 Hz', page)


@pytest.mark.parametrize(
    ('more', 'status', 'words'),
    [
        (['--pose', '0', '-0.5', '0'], 2, 'outside its'),
        (['--pose', 'nan', '0', '0'], 2, 'finite'),
        (['--limit', 'inf', '0', '0'], 2, 'finite'),
        (['--set', 'reference_scal=1'], 2, 'did you mean reference_scale'),
        (['--fields', 'absent.yaml'], 3, 'absent.yaml'),
        (['--fields', 'fields.yaml'], 3, 'psd1: no such field; did you mean psd_1'),
    ],
)
def test_certificate_rejects_bad_input_in_one_line(
    more: list[str], status: int, words: str, calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'fields.yaml').write_text('psd1: S1880\n')
    with contextlib.chdir(tmp_path):
        assert main(['certificate', str(calibrated), '--out', str(tmp_path), *more]) == status
    error = capsys.readouterr().err
    assert words in error
    assert error.count('\n') == 1
