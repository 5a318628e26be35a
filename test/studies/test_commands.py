# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``calibrate``, ``identify`` and ``validate`` from files to files, and what they reject."""

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import PsdDeflectionError
from psd_deflection.cli.main import main
from psd_deflection.rig.config import load_rig

pytestmark = pytest.mark.slow
RIG = Path(__file__).parents[2] / 'config' / 'thesis_rig.yaml'
HIDDEN = [
    *('--effect', 'sensor_rotation,psd=2,angle=0.012', '--effect', 'plane_tilt,slope_ratio=1.6'),
    *('--world', 'psd_1.zero=[0.0003, -0.0002]'),
]
LOADS = 'steps:0,0,0;0,-50,-29;50,0,20;-40,30,0;0,40,29;-50,-40,-20:1'
NAMES = {
    *(
        f'psd_{n}.{name}'
        for n in (1, 2)
        for name in [
            *('rotation', 'gain_x', 'gain_y', 'crosstalk_xy', 'crosstalk_yx', 'center_x', 'center_y'),
            *('height', 'nonlinearity'),
        ]
    ),
    *(f'beam_{n}.angle_{axis}' for n in (1, 2) for axis in 'xy'),
    *('link.slope_ratio', 'clamp.bending_compliance', 'clamp.torsional_compliance'),
}


@pytest.fixture(scope='module')
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording and its calibration."""
    folder = tmp_path_factory.mktemp('calibrate')
    recording = ['--out', str(folder / 'run.csv'), '--loads', LOADS, '--reference-noise', '1e-5,5e-4']
    assert main(['simulate', *recording, *HIDDEN]) == 0
    done = main(
        ['calibrate', str(folder / 'run.csv'), '--params-file', str(RIG), '--out', str(folder / 'out'), '--quiet']
    )
    assert done == 0
    return folder


def test_calibration_json_has_the_documented_shape(made: Path) -> None:
    tree: dict[str, Any] = json.loads((made / 'out' / 'calibration.json').read_text())
    assert set(tree['parameters']) == NAMES
    for parameter in tree['parameters'].values():
        assert set(parameter) == {'value', 'sd', 'unit', 'file', 'used'}
    matrix = np.array(tree['covariance']['matrix'])
    at = tree['covariance']['names']
    assert set(at) == NAMES
    assert np.sqrt(np.diag(matrix)) == pytest.approx([tree['parameters'][n]['sd'] for n in at])
    assert set(tree['noise']) == {'x1', 'y1', 'x2', 'y2'}
    assert tree['noise']['x1'] == pytest.approx(2e-3, rel=0.15)
    assert tree['gap']['heldout_after'] < 0.5 * tree['gap']['heldout_before']
    for direction in tree['undetermined']:
        assert sum(v * v for v in direction['direction'].values()) == pytest.approx(1.0, abs=0.2)
        assert direction['needs']
    (recording,) = tree['provenance']['recordings']
    assert len(recording['sha256']) == 64
    # It was turned by 12 mrad, of which the crosstalk takes its share.
    assert tree['parameters']['psd_2.rotation']['value'] > 0.009


def test_the_rig_file_is_the_one_that_was_given_and_corrects(made: Path, tmp_path: Path) -> None:
    text = (made / 'out' / 'rig.yaml').read_text()
    assert text.startswith('# Calibrated by psd-deflection ')
    assert 'run.csv (sha256 ' in text
    assert 'k of phi = -k dY/L: 3/2 for a force at the tip' in text
    rig = load_rig(made / 'out' / 'rig.yaml')
    assert rig.psds[0].zero == pytest.approx((3e-4, -2e-4), abs=5e-6)
    assert rig.values['min_samples'] == 10
    errors = {}
    loads = 'steps:0,0,0;20,-40,-10:1'
    later = str(tmp_path / 'later.csv')
    assert main(['simulate', '--out', later, '--loads', loads, '--reference', '--seed', '4', *HIDDEN]) == 0
    for name, file in (('before', RIG), ('after', made / 'out' / 'rig.yaml')):
        out = tmp_path / f'{name}.csv'
        assert main(['replay', later, '--params-file', str(file), '--out', str(out)]) == 0
        got = np.genfromtxt(out, delimiter=',', names=True)
        truth = np.genfromtxt(later, delimiter=',', names=True)
        truth = truth[np.isfinite(truth['ref_dx'])]
        dx = np.interp(got['t'], truth['t'], truth['ref_dx'])[-20:]
        errors[name] = float(np.abs(got['dx'][-20:] - dx).mean())
        if name == 'after':
            assert got['sd_dx'][-1] > 1e-6
    assert errors['after'] < 0.1 * errors['before']


@pytest.fixture(scope='module')
def off(made: Path) -> Path:
    """Both lasers off, in light that is 2 % and 1 % of theirs."""
    light = [
        *('--effect', 'ambient_light,psd=1,level=0.1,x=0.0015,y=-0.001'),
        *('--effect', 'ambient_light,psd=2,level=0.05,x=-0.002,y=0.0005'),
    ]
    out = ['--out', str(made / 'off.csv'), '--loads', 'steps:0,0,0:5', '--world', 'amplifier.sum_nominal=1e-9']
    assert main(['simulate', *out, *light]) == 0
    run = ['--out', str(made / 'lit.csv'), '--loads', LOADS, '--reference-noise', '1e-5,5e-4', '--seed', '3']
    assert main(['simulate', *run, *light, *HIDDEN]) == 0
    return made / 'off.csv'


def test_dark_levels_alone_change_nothing_else(off: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['calibrate', '--dark', str(off), '--params-file', str(RIG), '--out', str(tmp_path), '--quiet']) == 0
    assert 'psd_2 with its laser off' in capsys.readouterr().out
    first, *rest = (tmp_path / 'rig.yaml').read_text().splitlines()
    assert first.startswith('# Dark levels by psd-deflection ')
    assert [line for line in rest if 'dark:' not in line] == RIG.read_text().splitlines()
    assert len(rest) == len(RIG.read_text().splitlines()) + 2
    again = ['--params-file', str(tmp_path / 'rig.yaml'), '--out', str(tmp_path / 'again'), '--json']
    assert main(['calibrate', '--dark', str(off), *again]) == 0
    tree = json.loads(capsys.readouterr().out)['dark']['psd_1']['sum']
    assert tree['file'] == pytest.approx(tree['value'], rel=1e-5)


@pytest.mark.parametrize(
    ('argv', 'status', 'words'),
    [
        (['RUN'], 2, '--out DIR .* or --check'),
        (['RUN', '--check', str(RIG), '--out', 'x'], 2, 'give none of --params-file, --out'),
        (['RUN', '--reference', 'a', '--reference', 'b', '--out', 'x'], 2, '--reference is given 2 times for 1 rec'),
        (['RUN', '--check', str(RIG)], 3, 'calibration.names: not there; --check takes the rig.yaml of a calibration'),
        (['--out', 'x'], 2, 'REC is missing'),
        (['--self', '--dark', 'OFF', '--out', 'x'], 2, 'REC is missing'),
        (['RUN', '--check', 'RIG', '--dark', 'OFF'], 2, '--check RIG.yaml is for itself: .*--dark'),
        (['RUN', '--each', '--dark', 'OFF', '--out', 'x'], 2, '--dark: not with --each'),
        (['--dark', 'RUN', '--params-file', str(RIG), '--out', 'x'], 4, 'the laser of psd_1 is off for 0.0 s'),
        (
            ['--dark', 'OFF', '--params-file', 'RIG', '--out', 'x'],
            3,
            'psd_1.dark: this rig file was calibrated without',
        ),
    ],
)
def test_what_does_not_fit_is_rejected(
    made: Path, off: Path, argv: list[str], status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    named = {'RUN': str(made / 'run.csv'), 'OFF': str(off), 'RIG': str(made / 'out' / 'rig.yaml')}
    try:
        ended = main(['calibrate', *(named.get(word, word) for word in argv)])
    except SystemExit as stop:
        ended = int(str(stop.code))
    assert ended == status
    assert re.search(words, capsys.readouterr().err)
    assert not Path('x').exists()


@pytest.fixture(scope='module')
def rung(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two steps of a link at 11 Hz; its rig file says 14 Hz."""
    path = tmp_path_factory.mktemp('run') / 'run.csv'
    world = ['--world', 'dynamics.bending_frequency=11.0', '--world', 'dynamics.torsion_damping_ratio=0.01']
    assert main(['simulate', '--out', str(path), '--loads', 'steps:0,0,0;3,-10,-5.85;0,0,0:2', *world]) == 0
    return path


def test_the_modes_of_the_link_not_of_the_file(rung: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['identify', str(rung), '--json']) == 0
    tree = json.loads(capsys.readouterr().out)
    for axis in ('dx', 'dy'):
        (mode,) = tree['axes'][axis]['modes']
        assert tree['axes'][axis]['how'] == 'ring-down'
        assert mode['frequency'] == pytest.approx(11.0, rel=5e-4)
        assert mode['damping_ratio'] == pytest.approx(0.02, rel=0.03)
    (torsion,) = tree['axes']['theta']['modes']
    assert torsion['frequency'] == pytest.approx(21.0, rel=5e-4)
    assert torsion['damping_ratio'] == pytest.approx(0.01, rel=0.03)
    assert tree['axes']['dy']['shaper']['name'] in ('zv', 'mzv', 'zvd', 'ei')
    assert set(tree['parameters']) < set(load_rig(None).values)


def test_a_link_at_rest_says_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'still.csv'
    assert main(['simulate', '--out', str(path), '--loads', 'constant:0,0,0:2']) == 0
    capsys.readouterr()
    assert main(['identify', str(path)]) == 0
    assert capsys.readouterr().out.count('no mode stands out of the noise. Knock on the link') == 3


@pytest.fixture(scope='module')
def moved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight seconds with two steps, and the true pose in it as a reference."""
    path = tmp_path_factory.mktemp('run') / 'run.csv'
    loads = 'steps:0,0,0;0,-10,-5.85;0,0,0:2.5'
    assert main(['simulate', '--out', str(path), '--loads', loads, '--reference']) == 0
    return path


@pytest.fixture(scope='module')
def late(moved: Path) -> Path:
    """The reference in a table of its own, 12.5 ms late, with one rejected frame."""
    path = moved.parent / 'camera.csv'
    with moved.open() as stream, path.open('w') as out:
        out.write('t,dx,dy,theta,sd_dx,sd_dy,sd_theta,status\n')
        for row in csv.DictReader(stream):
            if row['ref_dx']:
                pose = ','.join(row[name] for name in ('ref_dx', 'ref_dy', 'ref_theta'))
                out.write(f'{float(row["t"]) + 0.0125:.6f},{pose},1e-7,1e-7,1e-6,ok\n')
        out.write('7.6,,,,,,,blurred\n')
    return path


def test_offset_is_reported_and_removed_if_asked(moved: Path, late: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['validate', str(moved), '--reference', str(late), '--json']) == 0
    tree = json.loads(capsys.readouterr().out)
    # The blocks' stamps lie in the middle of 20 samples; the row of the reference is the next one, half a sample on.
    assert tree['offset']['value'] == pytest.approx(-0.0125, abs=0.6e-3)
    assert tree['offset']['determined']
    assert not tree['offset']['applied']
    assert tree['rejected'] == {'blurred': 1}
    without = tree['solvers']['exact']['dy']['rms']
    assert main(['validate', str(moved), '--reference', str(late), '--align', '--json']) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree['offset']['applied']
    assert tree['solvers']['exact']['dy']['rms'] < 0.01 * without


def test_unsuitable_solver_is_reported_if_named(moved: Path) -> None:
    # Both centres on one line through the middle.
    rig = load_rig(overrides={'psd_2.center': [0.0, -0.07]})
    assert 'appendix_d' not in psd_deflection.validate(moved, rig=rig, solvers=['all']).agreements
    with pytest.raises(PsdDeflectionError, match='appendix_d divides by both'):
        psd_deflection.validate(moved, rig=rig, solvers=['appendix_d'])


def test_a_recording_without_a_reference_says_how_to_give_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'bare.csv'
    assert main(['simulate', '--out', str(path), '--loads', 'constant:0,0,0:1']) == 0
    capsys.readouterr()
    assert main(['validate', str(path)]) == 4
    assert 'holds no reference' in capsys.readouterr().err
