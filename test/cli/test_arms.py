# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``chain``, ``compensator`` and ``shaper`` without ROS, and commands that need it on a machine without it."""

import csv
import importlib.util
import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from psd_deflection.arms.compensation.settings import SHAPING, shaper_of
from psd_deflection.arms.shapers import Shaper, in_series, recommended, shaper
from psd_deflection.cli._options import of_options
from psd_deflection.cli.main import main, make_parser
from tools.program import ROOT

CONFIG = Path(__file__).parents[2] / 'config'
EXAMPLE = str(CONFIG / 'two_links.yaml')
URDF = str(CONFIG / 'two_links.urdf')


def test_two_simulated_links_as_json_and_csv(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'end.csv'
    assert main(['chain', EXAMPLE, '--no-ros', '--json', '--count', '5', '--out', str(out)]) == 0
    blocks = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    rows = list(csv.DictReader(out.read_text(encoding='utf-8').splitlines()))
    assert len(blocks) == len(rows) == 5
    composed = [(b, r) for b, r in zip(blocks, rows, strict=True) if b['deflection']]
    assert composed
    for block, row in composed:
        for axis, value in block['deflection'].items():
            assert float(row[axis]) == value
        deviations = np.sqrt(np.diag(block['covariance']))
        assert [float(row[f'sd_{axis}']) for axis in block['deflection']] == pytest.approx(deviations)
        assert float(row['t']) == pytest.approx(block['t'], abs=1e-6)
    # With both joints turned the arm leans out.
    assert composed[0][0]['pose']['position'] == pytest.approx([1.2589, 0.0, 0.1745], abs=1e-2)


@pytest.mark.parametrize(
    ('argv', 'status', 'message'),
    [
        (['chain', EXAMPLE, '--json'], 2, '--out, --json and --count need --no-ros'),
        (['chain', EXAMPLE, '--no-ros', '--out', 'x.txt'], 2, 'must end in .csv'),
        (['chain', EXAMPLE, '--no-ros', '--out', 'gone/x.csv'], 4, 'there is no folder gone'),
        (['chain', 'gone.yaml', '--no-ros'], 3, 'gone.yaml: no such chain file'),
        (['compensator', '--urdf', URDF, '--tip', 'tol'], 3, 'tip: no link tol; did you mean tool?'),
        (['compensator', '--tip', 'tool', '--axes', 'x,u'], 2, "--axes = ['x', 'u']: each must be one of"),
        (['compensator', '--urdf', URDF], 3, 'tip: the link of the end effector must be named'),
        (['compensator', '--drive'], 3, 'tip: the link of the end effector must be named'),
        (['compensator', '--urdf', URDF, '--tip', 'tool', '--stale', 'nan'], 2, '--stale = nan s: must be finite'),
        (['compensator', '--urdf', 'gone.urdf', '--tip', 'tool'], 3, 'gone.urdf: no such URDF file'),
    ],
)
def test_rejected(argv: list[str], status: int, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == status
    output = capsys.readouterr().err
    assert message in output
    assert output.count('\n') == 1


RIG = str(CONFIG / 'thesis_rig.yaml')


def chosen(*options: str) -> Shaper:
    return shaper_of(of_options(make_parser(['shaper']).parse_args(['shaper', *options]), SHAPING))[0]


@pytest.mark.slow
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


@pytest.mark.slow
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
def test_shaper_rejects(options: list[str], status: int, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['shaper', *options]) == status
    output = capsys.readouterr().err
    assert message in output
    assert output.count('\n') == 1


@pytest.mark.slow
def test_a_rig_file_without_modes_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text('/**:\n  ros__parameters:\n    link.length: 0.6\n')
    assert main(['shaper', '--params-file', str(rig)]) == 3
    output = capsys.readouterr().err
    assert f'{rig}: has no dynamics.bending_frequency; `psd-deflection identify` finds it' in output


CHAIN = str(ROOT / 'config' / 'two_links.yaml')
COMMANDS = [
    ['estimator'],
    ['chain', CHAIN],
    ['compensator', '--tip', 'tool'],
    ['shaper', '--frequency', '12'],
    ['camera'],
]


@pytest.mark.parametrize('words', COMMANDS, ids=lambda words: words[0])
def test_full_shared_memory_is_reported_before_ros_starts(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """ROS 2 would end the process by SIGBUS."""
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, 'find_spec', lambda name: find('sys' if name == 'rclpy' else name))
    asked: list[Any] = []

    def full(path: str) -> Any:
        asked.append(path)
        return SimpleNamespace(f_bavail=15, f_frsize=4096)

    monkeypatch.setattr(os, 'statvfs', full)
    assert main(words) == 71
    assert asked == ['/dev/shm']
    assert '/dev/shm has 61440 bytes left, ROS 2 needs 65536: delete what nobody uses' in capsys.readouterr().err
