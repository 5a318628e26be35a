# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``chain``, ``compensator`` and ``shaper`` without ROS, and commands that need it on a machine without it."""

import argparse
import csv
import importlib.util
import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from psd_deflection.arms.compensation.settings import SETTINGS, SHAPING, shaper_of
from psd_deflection.base.errors import UsageError
from psd_deflection.cli import _options
from psd_deflection.cli._options import of_options
from psd_deflection.cli.main import main, make_parser
from psd_deflection.model.link.shapers import Shaper, in_series, recommended, shaper
from psd_deflection.rig.parameters import Parameter, Section
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


SECTIONS: list[Section[Any]] = [SETTINGS, SHAPING]


def as_written(declared: Parameter) -> str:
    """The default, as a person writes it."""
    default = declared.default
    if isinstance(default, bool):
        return str(default).lower()
    return ','.join(map(str, default)) if isinstance(default, list) else str(default)


@pytest.mark.parametrize('section', SECTIONS)
def test_the_default_of_every_option_can_be_written(section: Section[Any]) -> None:
    parser = argparse.ArgumentParser()
    _options.section_options(parser, section)
    written = [(p.name.replace('_', '-'), as_written(p)) for p in section.parameters.values()]
    words = [f'--{name}={text}' for name, text in written if text]
    assert words
    given = parser.parse_args(words)
    assert _options.of_options(given, section) == _options.of_options(parser.parse_args([]), section)


def test_a_switch_takes_true_and_false() -> None:
    parser = argparse.ArgumentParser()
    _options.section_options(parser, SECTIONS[0])
    assert parser.parse_args(['--takeover', 'false']).takeover is False
    assert parser.parse_args(['--takeover', 'True']).takeover is True
    with pytest.raises(UsageError, match='must be true or false'):
        parser.parse_args(['--takeover=maybe'])
