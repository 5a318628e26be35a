# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a reader takes from docs/deploy and docs/ci.md is understood by the programs that read it, and runs."""

import configparser
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from psd_deflection.cli.main import COMMANDS, make_parser
from psd_deflection.rig.declarations import BY_NAME
from tools.program import ROOT
from tools.run_commands import FENCE

UNIT = ROOT / 'docs' / 'deploy' / 'psd-deflection.service'


def verified(text: str, folder: Path) -> tuple[int, str]:
    """Exit status and complaints of ``systemd-analyze verify``, with a program that is on this machine."""
    if shutil.which('systemd-analyze') is None:
        pytest.skip('the unit file is verified by systemd: apt install systemd')
    unit = folder / UNIT.name
    unit.write_text(text.replace('/opt/psd_deflection/bin/psd-deflection', sys.executable))
    done = subprocess.run(['systemd-analyze', 'verify', unit], capture_output=True, text=True, check=False)
    return done.returncode, '\n'.join(line for line in done.stderr.splitlines() if UNIT.name in line)


def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    assert verified(UNIT.read_text(), tmp_path) == (0, '')


def test_the_unit_asks_for_what_the_daemon_uses() -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(UNIT)
    service = unit['Service']
    assert service['Type'] == 'notify'
    assert int(service['WatchdogSec']) > 5
    assert service['LimitRTPRIO'] == '50'
    assert service['LimitMEMLOCK'] == 'infinity'
    program, command, *arguments = service['ExecStart'].split()
    assert program.endswith('/psd-deflection')
    assert command in COMMANDS
    ours = arguments[: arguments.index('--ros-args')]
    make_parser([command]).parse_args([command, *ours])
    assert arguments[len(ours) :] == ['--ros-args', '-p', 'realtime:=true']
    assert not BY_NAME['realtime'].default


def test_the_paths_of_the_unit_are_those_that_the_page_makes() -> None:
    page = (UNIT.parent / 'README.md').read_text()
    (rig,) = re.findall(r'--params-file (\S+)', UNIT.read_text())
    (user,) = re.findall(r'^User=(\S+)', UNIT.read_text(), re.M)
    assert f'config/thesis_rig.yaml {rig}' in page
    assert re.search(rf'^useradd .*\b{user}$', page, re.M)


PAGE = ROOT / 'docs' / 'ci.md'
BLOCKS = {block['kind']: block['text'] for block in FENCE.finditer(PAGE.read_text())}
STEPS: list[dict[str, Any]] = yaml.safe_load(BLOCKS['yaml'])['jobs']['replay']['steps']


def test_github_takes_the_workflow(tmp_path: Path) -> None:
    pytest.importorskip('check_jsonschema')
    workflow = tmp_path / 'recordings.yml'
    workflow.write_text(BLOCKS['yaml'])
    check = [sys.executable, '-m', 'check_jsonschema', '--builtin-schema', 'vendor.github-workflows']
    done = subprocess.run([*check, workflow], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_lines_run(tmp_path: Path) -> None:
    for name in ('bags', 'config'):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / 'check_recording.py').write_text(BLOCKS['python'])
    lines = [step['run'] for step in STEPS if 'run' in step]
    # `make release STEP=wheel` builds it and installs it so.
    assert lines.pop(0) == 'pip install wheels/psd_deflection-*.whl'
    assert len(lines) == 3
    programs = f'{Path(sys.executable).parent}:/usr/bin:/bin'
    for line in lines:
        done = subprocess.run(
            ['bash', '-e', '-c', line],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
            env={'PATH': programs, 'PYTHONPATH': str(ROOT)},
        )
        # Last bits may differ on a machine of another kind, as the page says.
        assert done.returncode == 0 or (done.returncode == 1 and '--compare' in line), done.stdout + done.stderr
    assert done.stdout.endswith('mdeg\n')
    assert (tmp_path / 'estimates.csv').read_text().startswith('t,dx,dy,theta,')


def test_a_changed_rig_file_fails_the_check(tmp_path: Path) -> None:
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    (tmp_path / 'config').mkdir()
    changed = (ROOT / 'config' / 'thesis_rig.yaml').read_text().replace('[-0.100, 0.0]', '[-0.099, 0.0]')
    (tmp_path / 'config' / 'thesis_rig.yaml').write_text(changed)
    done = subprocess.run(
        [sys.executable, '-c', BLOCKS['python']],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={'PYTHONPATH': str(ROOT)},
    )
    assert done.returncode == 1
    assert 'AssertionError: the estimates have changed' in done.stderr
