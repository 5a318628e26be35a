# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``shaper``: where it takes the mode from, and what it rejects."""

from __future__ import annotations

from pathlib import Path

import pytest

from psd_deflection.arms.compensation.shaping import SHAPING, shaper_of
from psd_deflection.arms.shapers import Shaper, in_series, recommended, shaper
from psd_deflection.cli._options import of_options
from psd_deflection.cli.main import main, make_parser

pytestmark = pytest.mark.slow

CONFIG = Path(__file__).parents[2] / 'config'
RIG = str(CONFIG / 'thesis_rig.yaml')


def chosen(*options: str) -> Shaper:
    return shaper_of(of_options(make_parser(['shaper']).parse_args(['shaper', *options]), SHAPING))[0]


def test_the_mode_comes_from_the_rig_file_or_the_options(tmp_path: Path) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text(
        '/**:\n  ros__parameters:\n    dynamics: {bending_frequency: 11.0, bending_damping_ratio: 0.03, '
        'torsion_frequency: 25.0, torsion_damping_ratio: 0.01}\n'
    )
    assert chosen('--params-file', str(rig)) == recommended(11.0, 0.0, 0.03)
    assert chosen('--params-file', str(rig), '--modes', 'torsion', '--shaper', 'zv') == shaper('zv', 25.0, 0.01)
    both = in_series([shaper('ei', 11.0, 0.03), shaper('ei', 25.0, 0.01)])
    assert chosen('--params-file', str(rig), '--modes', 'bending,torsion', '--shaper', 'ei') == both
    assert chosen('--frequency', '9', '--damping-ratio', '0', '--shaper', 'mzv') == shaper('mzv', 9.0, 0.0)
    assert chosen('--shaper', 'none').times == (0.0,)


@pytest.mark.parametrize(
    ('options', 'status', 'message'),
    [
        ([], 3, 'which mode: give params_file, or frequency and damping_ratio; or shaper: none'),
        (['--shaper', 'zvx'], 2, "--shaper = 'zvx': must be one of zv, mzv, zvd, ei, recommended, none"),
        (['--damping-ratio', '0.1'], 2, 'damping_ratio: must be given together with frequency'),
        (['--frequency', '-9', '--damping-ratio', '0'], 2, '--frequency = -9.0 Hz: must be at least 0'),
        (['--frequency', '0.01'], 2, '--frequency = 0.01 Hz: must be at least 0.1'),
        (['--frequency', '9', '--params-file', RIG], 2, 'frequency and params_file: must not be given together'),
        (['--params-file', RIG, '--modes', 'bending,bending'], 2, 'modes: none may be there twice'),
        (['--params-file', RIG, '--modes', 'shear'], 2, 'each must be one of bending, torsion'),
        (['--max-step', 'nan'], 2, '--max-step = nan rad or m: must be finite'),
        (['--params-file', 'gone.yaml'], 3, 'gone.yaml: no such parameter file'),
        (['--shaper', 'none', '--urdf', 'gone.urdf'], 3, 'gone.urdf: no such URDF file'),
    ],
)
def test_rejected(options: list[str], status: int, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['shaper', *options]) == status
    output = capsys.readouterr().err
    assert message in output
    assert output.count('\n') == 1


def test_a_rig_file_without_modes_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text('/**:\n  ros__parameters:\n    link.length: 0.6\n')
    assert main(['shaper', '--params-file', str(rig)]) == 3
    output = capsys.readouterr().err
    assert f'{rig}: has no dynamics.bending_frequency; `psd-deflection identify` finds it' in output
