# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""docs/deploy: the files that a reader installs as root are understood by the programs that read them."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from psd_deflection.cli.main import COMMANDS, make_parser
from psd_deflection.rig.declarations import BY_NAME
from tools.program import ROOT

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
