# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command line: help that teaches, and one clear line for what goes wrong."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import pytest

from psd_deflection.cli._program import program
from psd_deflection.cli.main import COMMANDS, main

ROOT = Path(__file__).parent.parent.parent
BAGS = ROOT / 'bags'


@pytest.mark.parametrize('command', sorted(COMMANDS))
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main([command, '--help'])
    assert done.value.code == 0
    text = capsys.readouterr().out
    assert f'psd-deflection {command}' in text
    assert len(text.splitlines()) > 4


def test_the_command_line_without_a_command_names_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    text = capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(['--help'])
    assert capsys.readouterr().out == text
    assert all(name in text for name in COMMANDS)


@pytest.mark.parametrize(('typed', 'hint'), [('inf', 'did you mean info?'), ('frobnicate', '--help` lists them')])
def test_an_unknown_command_is_one_line_with_a_hint(typed: str, hint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([typed]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.count('\n') == 1
    assert typed in err
    assert hint in err


@pytest.mark.parametrize(
    ('argv', 'hinted'),
    [
        (['estimator', '-p', 'port:=/dev/ttyACM0'], True),
        (['estimator', '-r', 'deflection:=tip'], True),
        (['estimator', 'port:=/dev/ttyACM0'], True),
        (['monitor', '--remap', 'a:=b'], True),
        (['estimator', '--prot', '/dev/ttyACM0'], False),
    ],
)
def test_arguments_that_are_none_are_rejected_by_the_command(
    argv: list[str], hinted: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as done:
        main(argv)
    assert done.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith(f'usage: psd-deflection {argv[0]} ')
    assert f'\npsd-deflection {argv[0]}: error: unrecognized arguments: {argv[1]}' in err
    assert ('; ROS arguments go behind --ros-args' in err) == hinted


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


def test_recordings_that_are_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / 'folder'
    folder.mkdir()
    empty = tmp_path / 'empty.mcap'
    empty.touch()
    text = tmp_path / 'notes.md'
    text.write_text('hello')
    fake = tmp_path / 'fake.mcap'
    fake.write_text('hello, this is no mcap')
    no_column = tmp_path / 'a.csv'
    no_column.write_text('t,x1,y1,sum1,x2,sum2\n0,0,0,5,0,5\n')
    no_number = tmp_path / 'b.csv'
    no_number.write_text('t,x1,y1,sum1,x2,y2,sum2\n0,0,0,5,0,0,5\n0.001,0,0,5,0,abc,5\n')
    for path, message in (
        (tmp_path / 'nowhere', 'no such recording'),
        (empty, 'is empty'),
        (text, 'is no recording'),
        (fake, 'is not an MCAP file'),
        (folder, 'is no bag'),
        (no_column, 'y2'),
        (no_number, "b.csv:3: column y2 holds 'abc'"),
    ):
        status, err = rejected(capsys, 'replay', str(path))
        assert status == 4
        assert message in err
        assert str(path) in err


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


def test_a_rig_that_cannot_be_solved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text('/**:\n  ros__parameters:\n    psd_2:\n      center: [0.0, 0.07]\n')
    status, err = rejected(capsys, 'replay', str(BAGS / 'clean'), '--params-file', str(rig))
    assert status == 6
    assert 'coincide' in err


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


def test_output_that_is_there_already_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'out.csv'
    out.write_text('mine')
    status, err = rejected(capsys, 'replay', str(BAGS / 'clean'), '--out', str(out))
    assert status == 4
    assert 'never overwritten' in err
    assert out.read_text() == 'mine'


def test_params_lists_each_with_unit_and_bounds(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['params']) == 0
    out = capsys.readouterr().out
    assert 'link.length = 0.585 m' in out
    assert 'above 0 and at most 1000' in out


def test_ctrl_c_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(args: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr('psd_deflection.cli.params.run', interrupted)
    assert main(['params']) == 130
    assert capsys.readouterr().err == 'psd-deflection: interrupted\n'


@pytest.mark.parametrize(
    ('found', 'called', 'reported'),
    [
        ('/usr/bin/psd-deflection', '.venv/bin/psd-deflection', 'psd-deflection'),
        (None, '.venv/bin/psd-deflection', '.venv/bin/psd-deflection'),
        (None, '/somewhere/__main__.py', f'{sys.executable} -m psd_deflection'),
    ],
)
def test_suggested_commands_can_be_typed(
    found: str | None, called: str, reported: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('shutil.which', lambda name: found)
    monkeypatch.setattr(sys, 'argv', [called, 'estimator'])
    assert program() == reported
