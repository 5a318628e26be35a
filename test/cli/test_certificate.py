# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A certificate: its tables alone give every U again; what is rejected."""

from __future__ import annotations

import csv
import math
import re
from collections import defaultdict
from pathlib import Path

import pytest

from psd_deflection.cli.main import main

RIG = str(Path(__file__).parents[2] / 'config' / 'thesis_rig.yaml')
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


def _student(probability: float, freedom: float) -> float:
    """The quantile by summing the density up (Simpson) and halving the interval; no library of statistics."""
    if math.isinf(freedom):
        return 1.959963984540054
    scale = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(freedom * math.pi)

    def share(k: float) -> float:
        n = 2000
        values = [(1 + (k * i / n) ** 2 / freedom) ** (-(freedom + 1) / 2) for i in range(n + 1)]
        return float(scale * k / n / 3 * (values[0] + values[-1] + 4 * sum(values[1::2]) + 2 * sum(values[2:-1:2])) * 2)

    low, high = 0.0, 20.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if share(middle) < probability else (low, middle)
    return low


@pytest.mark.slow
def test_the_tables_give_every_u_again(certified: Path) -> None:
    """As a person does in a spreadsheet: from inputs.csv and correlations.csv alone."""
    inputs = _rows(certified / 'inputs.csv')
    correlations = {row['']: row for row in _rows(certified / 'correlations.csv')}
    results = _rows(certified / 'results.csv')
    assert len(results) == 7
    for result in results:
        for axis in AXES:
            variances: dict[str, float] = defaultdict(float)
            freedom = {row['cause']: float(row['nu']) for row in inputs}
            g = {
                (row['cause'], row['parameter']): float(row['u']) * float(row[f'c_{axis}_{result["pose"]}'])
                for row in inputs
            }
            for (cause, p), a in g.items():
                if cause != 'calibration':
                    variances[cause] += a * a
                    continue
                for q, one in correlations.items():
                    variances[cause] += a * float(one[p]) * g[cause, q]
            total = math.fsum(variances.values())
            doubt = math.fsum(v * v / freedom[cause] for cause, v in variances.items())
            effective = math.floor(total**2 / doubt)
            k = _student(0.95, effective)
            assert float(result[f'u_c_{axis}']) == pytest.approx(math.sqrt(total), rel=1e-9)
            assert float(result[f'nu_eff_{axis}']) == effective
            assert float(result[f'U_{axis}']) == pytest.approx(k * math.sqrt(total), rel=1e-6)


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


def test_as_found_is_what_the_old_rig_file_measures(calibrated: Path) -> None:
    """What the nominal rig file says of a held load, once it has come to rest, less the truth: by replay."""
    folder = calibrated.parent
    held, estimates = str(folder / 'held.csv'), folder / 'held_out.csv'
    assert main(['simulate', '--out', held, '--loads', 'steps:0,0,0;0,-40,0:5', *WRONG]) == 0
    assert main(['replay', held, '--params-file', RIG, '--out', str(estimates)]) == 0
    last = _rows(estimates)[-50:]
    dy = -40.0 * 0.585**3 / (3.0 * 69e9 * 2.171272689e-8)
    assert main(['certificate', str(calibrated), '--out', str(folder / 'at'), '--pose', '0', str(dy), '0']) == 0
    row = _rows(folder / 'at' / 'results.csv')[0]
    # The calibration itself is uncertain by two micrometres and two millidegrees.
    for axis, tolerance in zip(AXES, (5e-6, 5e-6, 1e-4), strict=True):
        error = sum(float(block[axis]) for block in last) / len(last) - float(row[axis])
        assert float(row[f'as_found_{axis}']) == pytest.approx(error, abs=tolerance)
    assert abs(float(row['as_found_dx'])) > 1e-5


@pytest.mark.parametrize(
    ('more', 'status', 'words'),
    [
        (['--pose', '0', '-0.5', '0'], 2, 'outside its'),
        (['--pose', 'nan', '0', '0'], 2, 'finite'),
        (['--limit', 'inf', '0', '0'], 2, 'finite'),
        (['--set', 'reference_scal=1'], 2, 'did you mean reference_scale'),
        (['--fields', 'absent.yaml'], 3, 'absent.yaml'),
    ],
)
def test_bad_input_is_rejected_in_one_line(
    more: list[str], status: int, words: str, calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['certificate', str(calibrated), '--out', str(tmp_path), *more]) == status
    error = capsys.readouterr().err
    assert words in error
    assert error.count('\n') == 1


def test_a_field_that_there_is_not_is_named(
    calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fields = tmp_path / 'fields.yaml'
    fields.write_text('psd1: S1880\n')
    assert main(['certificate', str(calibrated), '--out', str(tmp_path), '--fields', str(fields)]) == 3
    assert 'psd1: no such field; did you mean psd_1' in capsys.readouterr().err
