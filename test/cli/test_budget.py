# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``psd-deflection budget``: what it prints, draws and rejects."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.cli.main import main
from psd_deflection.studies.budget.evaluate import CAUSES
from psd_deflection.studies.budget.inputs import INPUTS

pytestmark = pytest.mark.slow

RIG = str(Path(__file__).parent.parent.parent / 'config' / 'thesis_rig.yaml')


def test_the_page_has_a_bar_for_every_cause_and_the_same_numbers(tmp_path: Path) -> None:
    assert main(['budget', '--params-file', RIG, '--out', str(tmp_path)]) == 0
    terms = json.loads((tmp_path / 'budget.json').read_text())['terms']
    page = (tmp_path / 'report.html').read_text()
    bars = dict(re.findall(r'<th scope="row">([^<]+(?:<wbr>[^<]+)*)</th>(.*?)</tr>', page))
    drawn = {name.replace('<wbr>', '').partition(' ')[0]: row for name, row in bars.items()}
    # What is mere rounding has none.
    assert drawn.keys() == {'total', *(t['name'] for t in terms if max(t['rms']) > 1e-12)}
    for term in terms:
        if term['name'] in drawn:
            shown = [float(v) for v in re.findall(r'</i>([^<]+)<', drawn[term['name']])]
            wanted = np.array(term['rms']) * (1e6, 1e6, math.degrees(1e3))
            assert shown == pytest.approx(wanted, rel=6e-3)
    # No script is needed for them.
    assert '<script' not in page


SMALL = """\
link: {length: 0.8, outer_radius: 0.006, inner_radius: 0.0045, youngs_modulus: 2.0e11, shear_modulus: 8.0e10}
    psd_1: {center: [0.0, 0.05], active_area: [0.004, 0.004], zero: [0.0005, -0.0005]}
    psd_2: {center: [-0.06, 0.0]}
"""


def test_a_rig_without_room_says_which_dot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'rig.yaml'
    path.write_text('/**:\n  ros__parameters:\n    psd_1: {active_area: [0.004, 0.004], zero: [0.0, 0.003]}\n')
    assert main(['budget', '--params-file', str(path)]) == 3
    assert 'psd_1 would lie at y = 3.00 mm, outside its ±2 mm' in capsys.readouterr().err


def test_json_has_the_figures_in_si(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / 'chart.svg'
    arguments = ['--json', '--out', str(out), '--method', 'beam', '--load', '1', '-2', '0.5', '--monte-carlo', '100']
    assert main(['budget', *arguments, '--set', 'air_gradient=0', '--set', 'air_step = 0']) == 0
    got = json.loads(capsys.readouterr().out)
    assert got['method'] == 'beam'
    assert got['load'] == [1.0, -2.0, 0.5]
    assert [t['name'] for t in got['terms']] == [c.name for c in CAUSES]
    refraction = next(t for t in got['terms'] if t['name'] == 'refraction')
    assert refraction['rms'] == [0.0, 0.0, 0.0]
    assert refraction['inputs']['air_gradient'] == 0.0
    assert set(got['totals']) == {'per_estimate', 'systematic', 'known', 'total', 'monte_carlo'}
    assert got['totals']['total']['rms'][0] < 1e-4
    assert out.read_text(encoding='utf-8').startswith('<?xml')


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


def test_the_method_follows_the_rigs_solver(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text('/**:\n  ros__parameters:\n    solver: wls\n')
    assert main(['budget', '--params-file', str(rig), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['method'] == 'wls'


@pytest.mark.parametrize(
    ('arguments', 'status', 'message'),
    [
        (['--set', 'nothing'], 2, 'NAME=VALUE'),
        (['--set', 'nothing=1'], 2, 'no such input'),
        (['--monte-carlo', '1'], 2, '--monte-carlo'),
        (['--monte-carlo', '1000', '--seed', '-1'], 2, '--seed'),
        (['--load', 'nan', '0', '0'], 2, 'must be finite'),
        (['--load', '0', '-500', '0'], 2, 'take a smaller load'),
        (['--load', '1e300', '0', '0'], 2, 'than the link is long'),
        (['--out', 'budget.txt'], 2, '.png, .svg or .pdf'),
        (['--inputs', 'absent.yaml'], 3, 'absent.yaml'),
        (['--params-file', 'absent.yaml'], 3, 'absent.yaml'),
    ],
)
def test_bad_input_is_rejected_in_one_line(
    arguments: list[str], status: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['budget', *arguments]) == status
    error = capsys.readouterr().err
    assert message in error
    assert error.count('\n') == 1
