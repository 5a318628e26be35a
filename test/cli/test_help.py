# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What ``--help`` says: as wide as the terminal, options with their defaults, examples that run."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest

from psd_deflection.base.errors import EXIT_STATUSES
from psd_deflection.cli.main import COMMANDS, GROUPS, main, make_parser
from psd_deflection.cli.params import NEEDED

ROOT = Path(__file__).parent.parent.parent
OURS = 'psd-deflection '
ENDLESS = (
    'camera frames',
    'camera /dev/video0',
    'camera intrinsics',
    'check',
    'echo',
    'zero',
    'record',
    'load',
    'mark',
    'estimator',
    'chain',
    'compensator',
    'shaper',
    'monitor',
    'discover',
    'devices',
    'simulate --serve',
    'validate',
    'calibrate',
    'identify',
    'thesis compare-methods --out',
)
"""Examples that go on until Ctrl-C, take long, or want a device or a reference: only their options are parsed."""


def help_of(command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, columns: int) -> str:
    monkeypatch.setenv('COLUMNS', str(columns))
    with pytest.raises(SystemExit):
        main([command, '--help'] if command else ['--help'])
    return capsys.readouterr().out


def test_it_is_no_wider_than_the_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for command in ('', *COMMANDS):
        text = help_of(command, capsys, monkeypatch, 80)
        assert [line for line in text.splitlines() if len(line) > 80] == [], command
    # Prose fills a narrow terminal too; examples and tables stay as they are.
    for command in ('', 'estimator', 'discover'):
        narrow = help_of(command, capsys, monkeypatch, 60).partition('\n\n')[2]
        assert [line for line in narrow.splitlines() if len(line) > 60 and not line.startswith(' ')] == [], command


def test_it_reports_the_exit_statuses(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    text = ' '.join(help_of('', capsys, monkeypatch, 80).split())
    reported = re.findall(r'(\d+) [a-zC]', text.partition('exit status: ')[2])
    assert [int(status) for status in reported] == list(EXIT_STATUSES)


def test_help_fits_one_screen_with_each_command_in_one_group(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = help_of('', capsys, monkeypatch, 80)
    assert len(text.splitlines()) < 24
    listed = re.findall(r'^  ([a-z]+) +([a-z-]+(?:, [a-z-]+)*)$', text, re.M)
    assert [(title, tuple(names.split(', '))) for title, names in listed] == [
        *GROUPS.items(),
        ('shell', ('completion',)),
    ]
    assert sorted(name for _, names in listed for name in names.split(', ')) == sorted(COMMANDS)


def test_no_argument_prints_help(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    reported = help_of('', capsys, monkeypatch, 80)
    assert main([]) == 0
    assert capsys.readouterr().out == reported


def test_the_short_list_of_parameters_is_short(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['params', '--short']) == 0
    named = re.findall(r'^(\S+) = ', capsys.readouterr().out, re.M)
    assert set(named) == set(NEEDED)
    assert main(['params', '--short', '--json']) == 0
    assert set(json.loads(capsys.readouterr().out)) == set(NEEDED)


def options_of(command: str) -> set[str]:
    return set(make_parser([command]).parse_args([command]).known_options)


def test_one_thing_has_one_name_in_all_commands() -> None:
    """What was called otherwise once still works."""
    for command in ('estimator', 'monitor'):
        assert {'--monitor-port', '--monitor-address', '--port', '--params-file'} <= options_of(command)
    monitor = make_parser(['monitor']).parse_args(['monitor', '--http-port', '1', '--address', '::1'])
    assert (monitor.monitor_port, monitor.monitor_address) == (1, '::1')
    assert '--true-pose' in options_of('simulate')
    assert make_parser(['simulate']).parse_args(['simulate', '--reference']).reference is True


def test_json_is_named_on_the_page(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    words = (ROOT / 'docs' / 'commands.md').read_text().partition('take `--json`')[0].rpartition('standard error. ')[2]
    named = {command for command in COMMANDS if re.search(f'`{command}[` ]', words)}
    assert {command for command in COMMANDS if '--json' in help_of(command, capsys, monkeypatch, 80)} == named


def examples(command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command lines that its help shows, without what is said beside them."""
    lines = help_of(command, capsys, monkeypatch, 80).splitlines()
    return [re.split(r' {2,}', line.strip())[0] for line in lines if line.startswith(f'  {OURS}')]


@pytest.mark.slow
@pytest.mark.parametrize('command', COMMANDS)
def test_its_examples_run(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = examples(command, capsys, monkeypatch)
    assert found
    for link, target in (('bags', 'bags'), ('config', 'config'), ('my_rig.yaml', 'config/thesis_rig.yaml')):
        (tmp_path / link).symlink_to(ROOT / target)
    shutil.copytree(ROOT / 'bags' / 'clean', tmp_path / 'recordings' / 'psd_20260101_120000')
    shutil.copy(ROOT / 'bags' / 'clean' / 'clean_0.mcap', tmp_path / 'lone.mcap')
    monkeypatch.chdir(tmp_path)
    assert main(['convert', 'bags/clean', '--out', 'run.csv']) == 0
    if command == 'certificate':
        loads = 'steps:0,0,0;0,-40,-20;40,0,15;-40,30,0;0,40,20;-40,-30,-15;20,0,-20;0,0,0:1'
        words = ['--reference-noise', '1e-5,5e-4', '--effect', 'sensor_rotation,psd=2,angle=0.012']
        assert main(['simulate', '--out', 'moved.csv', '--loads', loads, *words]) == 0
        assert main(['calibrate', 'moved.csv', '--out', 'calibrated', '--quiet']) == 0
    for line in found:
        argv = shlex.split(line)[1:]
        args = make_parser([argv[0]]).parse_args(argv)
        assert args.command == command
        rerun = getattr(args, 'out', None) is not None and str(args.out).endswith('.rrd')
        if rerun or line.removeprefix(OURS).startswith(ENDLESS):
            continue
        # A recording of another machine may differ in its last bits.
        assert main(argv) in ((0, 1) if '--compare' in argv else (0,)), line
