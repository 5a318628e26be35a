# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command line: help that teaches, options, completion, effects, one clear line for what goes wrong."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from psd_deflection.base.errors import EXIT_STATUSES
from psd_deflection.cli.main import COMMANDS, main, make_parser
from psd_deflection.cli.params import NEEDED
from psd_deflection.cli.run.estimator import simulates_at_once
from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.rig.config import load_rig
from psd_deflection.run import simulated_rig
from psd_deflection.run.simulated_rig import SimulatedRigProcess, started_early

ROOT = Path(__file__).parent.parent.parent
BAGS = ROOT / 'bags'
Capsys = pytest.CaptureFixture[str]


@pytest.mark.parametrize(('typed', 'hint'), [('inf', 'did you mean info?'), ('frobnicate', '--help` lists them')])
def test_an_unknown_command_is_one_line_with_a_hint(typed: str, hint: str, capsys: Capsys) -> None:
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
def test_an_option_that_is_mistyped_is_named_with_the_nearest(argv: list[str], hint: str, capsys: Capsys) -> None:
    with pytest.raises(SystemExit):
        main(argv)
    assert hint in capsys.readouterr().err


def test_ros_arguments_go_through_untouched(monkeypatch: pytest.MonkeyPatch) -> None:
    run = Mock(return_value=0)
    monkeypatch.setattr('psd_deflection.cli.run.estimator.run', run)
    ros = ['--ros-args', '-p', 'port:=/dev/ttyACM0', '--remap', 'a:=b', '--no-such-option']
    assert main(['estimator', *ros]) == 0
    assert [call.args[0].ros_arguments for call in run.call_args_list] == [ros]


def test_params_lists_each_with_unit_and_bounds(capsys: Capsys) -> None:
    assert main(['params']) == 0
    out = capsys.readouterr().out
    assert 'link.length = 0.585 m' in out
    assert 'above 0 and at most 1000' in out


OURS = 'psd-deflection '
ENDLESS = (
    *('camera frames', 'camera /dev/video0', 'camera intrinsics', 'check', 'echo', 'zero', 'record', 'load', 'mark'),
    *('estimator', 'chain', 'compensator', 'shaper', 'monitor', 'discover', 'devices', 'simulate --serve'),
    *('validate', 'calibrate', 'identify', 'thesis compare-methods --out'),
)
"""Examples that go on until Ctrl-C, take long, or want a device or a reference: only their options are parsed."""


def help_of(command: str, capsys: Capsys, monkeypatch: pytest.MonkeyPatch, columns: int) -> str:
    monkeypatch.setenv('COLUMNS', str(columns))
    with pytest.raises(SystemExit):
        main([command, '--help'] if command else ['--help'])
    return capsys.readouterr().out


def test_it_reports_the_exit_statuses(capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    text = ' '.join(help_of('', capsys, monkeypatch, 80).split())
    reported = re.findall(r'(\d+) [a-zC]', text.partition('exit status: ')[2])
    assert [int(status) for status in reported] == list(EXIT_STATUSES)


def test_no_argument_prints_help(capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    reported = help_of('', capsys, monkeypatch, 80)
    assert main([]) == 0
    assert capsys.readouterr().out == reported


def test_the_short_list_of_parameters_is_short(capsys: Capsys) -> None:
    assert main(['params', '--short']) == 0
    named = re.findall(r'^(\S+) = ', capsys.readouterr().out, re.M)
    assert set(named) == set(NEEDED)
    assert main(['params', '--short', '--json']) == 0
    assert set(json.loads(capsys.readouterr().out)) == set(NEEDED)


def test_json_is_named_on_the_page(capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    words = (ROOT / 'docs' / 'commands.md').read_text().partition('take `--json`')[0].rpartition('standard error. ')[2]
    named = {command for command in COMMANDS if re.search(f'`{command}[` ]', words)}
    assert {command for command in COMMANDS if '--json' in help_of(command, capsys, monkeypatch, 80)} == named


def examples(command: str, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command lines that its help shows, without what is said beside them."""
    lines = help_of(command, capsys, monkeypatch, 80).splitlines()
    return [re.split(r' {2,}', line.strip())[0] for line in lines if line.startswith(f'  {OURS}')]


@pytest.mark.slow
@pytest.mark.parametrize('command', COMMANDS)
def test_its_examples_run(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys) -> None:
    lines = examples(command, capsys, monkeypatch)
    assert lines
    for link, target in (('bags', 'bags'), ('config', 'config'), ('my_rig.yaml', 'config/thesis_rig.yaml')):
        (tmp_path / link).symlink_to(ROOT / target)
    shutil.copytree(ROOT / 'bags' / 'clean', tmp_path / 'recordings' / 'psd_20260101_120000')
    shutil.copy(ROOT / 'bags' / 'clean' / 'clean_0.mcap', tmp_path / 'lone.mcap')
    monkeypatch.chdir(tmp_path)
    assert main(['convert', 'bags/clean', '--out', 'run.csv']) == 0
    table = np.loadtxt('run.csv', str, delimiter=',')
    for name, columns in (('first', [0, 1, 2, 3]), ('second', [0, 4, 5, 6])):
        np.savetxt(f'{name}.csv', table[:, columns], '%s', ',')
    if command == 'certificate':
        loads = 'steps:0,0,0;0,-40,-20;40,0,15;-40,30,0;0,40,20;-40,-30,-15;20,0,-20;0,0,0:1'
        words = ['--reference-noise', '1e-5,5e-4', '--effect', 'sensor_rotation,psd=2,angle=0.012']
        assert main(['simulate', '--out', 'moved.csv', '--loads', loads, *words]) == 0
        assert main(['calibrate', 'moved.csv', '--out', 'calibrated', '--quiet']) == 0
    for line in lines:
        argv = shlex.split(line)[1:]
        args = make_parser([argv[0]]).parse_args(argv)
        assert args.command == command
        rerun = getattr(args, 'out', None) is not None and str(args.out).endswith('.rrd')
        if rerun or line.removeprefix(OURS).startswith(ENDLESS):
            continue
        # A recording of another machine may differ in its last bits.
        assert main(argv) in ((0, 1) if '--compare' in argv else (0,)), line


def test_the_list_has_every_effect(capsys: Capsys) -> None:
    assert main(['effects']) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, effect in catalogue().items():
        assert [line for line in lines if line.startswith(name + ' ') and effect.summary in line]


@pytest.mark.parametrize('name', catalogue())
def test_an_effect_is_explained_with_a_command_that_runs(name: str, tmp_path: Path, capsys: Capsys) -> None:
    assert main(['effects', name]) == 0
    text = capsys.readouterr().out
    effect = catalogue()[name]
    assert effect.equation in text
    for p in effect.parameters:
        assert f'{p.name}: {p.description}' in text
    command = next(line.split('psd-deflection ')[1] for line in text.splitlines() if line.startswith('  try'))
    words = shlex.split(command)
    words[words.index('--out') + 1] = str(tmp_path / 'run.csv')
    words[words.index('--loads') + 1] = 'constant:0,-50,0:0.1'
    assert main(words) == 0
    assert name in capsys.readouterr().out


def test_programs_get_the_declaration(capsys: Capsys) -> None:
    assert main(['effects', 'sensor_rotation', '--json']) == 0
    effect = json.loads(capsys.readouterr().out)['sensor_rotation']
    assert (effect['corrected'], effect['parameters']['angle']['unit']) == ('reading', 'rad')
    assert effect['parameters']['psd']['choices'] == [1, 2, 3, 4, 5, 6]


def test_a_wrong_name_is_reported_with_the_right_one(capsys: Capsys) -> None:
    assert main(['effects', 'sensor_rotatoin']) == 2
    assert 'did you mean sensor_rotation' in capsys.readouterr().err


# Nothing else shows a process that nobody has taken yet.
WAITING = simulated_rig._waiting


@pytest.mark.parametrize(
    ('overrides', 'ros_arguments', 'wanted'),
    [
        ({}, (), True),
        ({'source': 'dataq'}, ('--ros-args', '-p', 'record:=true'), True),
        ({'port': '/dev/ttyACM0'}, (), False),
        ({'source': 'replay'}, (), False),
        ({'source': 'nonsense'}, (), False),
        ({}, ('--ros-args', '-p', 'port:=/dev/ttyACM0'), False),
        ({}, ('--ros-args', '--params-file', 'rig.yaml'), False),
    ],
)
def test_it_is_started_where_no_port_is_known(
    overrides: dict[str, object], ros_arguments: tuple[str, ...], wanted: bool
) -> None:
    assert simulates_at_once(overrides, ros_arguments) is wanted


def test_early_rig_is_taken_by_first_user_or_closed() -> None:
    with started_early(True):
        (process,) = WAITING
        rig = SimulatedRigProcess(load_rig())
        assert rig.port.startswith('/dev/')
        assert WAITING == []
        assert process.poll() is None
        rig.close()
        assert process.poll() is not None
    with started_early(True):
        (unused,) = WAITING
    assert unused.poll() is not None
    with started_early(False):
        assert WAITING == []


def test_it_ends_without_a_word_when_its_daemon_is_gone_before() -> None:
    command = [sys.executable, '-m', 'psd_deflection.devices.serve']
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
