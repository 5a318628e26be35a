# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command line: help that teaches, and one clear line for what goes wrong."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from psd_deflection.cli.main import main

ROOT = Path(__file__).parent.parent.parent
BAGS = ROOT / 'bags'


@pytest.mark.parametrize(('typed', 'hint'), [('inf', 'did you mean info?'), ('frobnicate', '--help` lists them')])
def test_an_unknown_command_is_one_line_with_a_hint(typed: str, hint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([typed]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.count('\n') == 1
    assert typed in err
    assert hint in err


@pytest.mark.parametrize(
    ('argv', 'hint'),
    [
        (['info', 'x', '--form', '1'], '; did you mean --from?'),
        (['replay', 'x', '--comapre'], '; did you mean --compare?'),
        (['estimator', '--prot=/dev/ttyACM0'], '; did you mean --port?'),
        (['info', 'x', '--xyzzy'], 'unrecognized arguments: --xyzzy\n'),
    ],
)
def test_an_option_that_is_mistyped_is_named_with_the_nearest(
    argv: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(argv)
    assert hint in capsys.readouterr().err


def test_ros_arguments_go_through_untouched(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[list[str]] = []

    def run(args: argparse.Namespace) -> int:
        taken.append(args.ros_arguments)
        return 0

    monkeypatch.setattr('psd_deflection.cli.run.estimator.run', run)
    ros = ['--ros-args', '-p', 'port:=/dev/ttyACM0', '--remap', 'a:=b', '--no-such-option']
    assert main(['estimator', *ros]) == 0
    assert taken == [ros]


def rejected(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str]:
    status = main(list(argv))
    err = capsys.readouterr().err.strip()
    assert err.count('\n') == 0, err
    assert err.startswith(f'psd-deflection {argv[0]}: ')
    return status, err


def test_a_bag_that_lost_its_tail_is_read_up_to_the_cut(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    integer = (BAGS / 'clean' / 'clean_0.mcap').read_bytes()
    cut = tmp_path / 'cut_0.mcap'
    cut.write_bytes(integer[: len(integer) * 6 // 10])
    assert main(['replay', str(cut)]) == 0
    out, err = capsys.readouterr()
    assert 'warning' in err
    assert 'cut_0.mcap' in err
    samples = int(out.split(': ')[1].split(' samples')[0])
    assert 1000 < samples < 4000


def test_bad_parameters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text('/**:\n  ros__parameters:\n    block_size: 0\n')
    status, err = rejected(capsys, 'replay', str(BAGS / 'clean'), '--params-file', str(rig))
    assert status == 3
    assert f'{rig}: block_size = 0 samples: must be at least 1' in err
    rig.write_text('/**: [')
    status, err = rejected(capsys, 'params', '--params-file', str(rig))
    assert status == 3
    assert f'{rig}:2:1: malformed YAML' in err


@pytest.mark.parametrize(
    ('argv', 'reported'),
    [(['simulate'], '--out OUT (a recording) or --serve'), (['design', '--out', 'a.png'], 'give --params-file')],
    ids=['simulate', 'design'],
)
def test_options_that_do_not_go_together_are_usage(
    argv: list[str], reported: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, err = rejected(capsys, *argv)
    assert status == 2
    assert reported in err


def test_params_lists_each_with_unit_and_bounds(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['params']) == 0
    out = capsys.readouterr().out
    assert 'link.length = 0.585 m' in out
    assert 'above 0 and at most 1000' in out
