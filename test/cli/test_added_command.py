# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A command joins by its module and one line of ``COMMANDS``, as docs/extending.md says."""

from __future__ import annotations

from pathlib import Path

import pytest

import psd_deflection.cli
from psd_deflection.cli.main import COMMANDS, main
from tools import hooks

MODULE = '''"""Print the square of a number.

  psd-deflection made-up --size 3
"""

from psd_deflection.base.errors import ConfigError


def add_arguments(parser):
    parser.add_argument('--size', type=float, metavar='SIZE', required=True, help='what is squared')


def run(args):
    if args.size < 0:
        raise ConfigError(f'--size = {args.size}: must be at least 0')
    print(args.size**2)
    return 0
'''


@pytest.fixture(autouse=True)
def made_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'made_up.py').write_text(MODULE)
    monkeypatch.setattr(psd_deflection.cli, '__path__', [*psd_deflection.cli.__path__, str(tmp_path)])
    monkeypatch.setitem(COMMANDS, 'made-up', 'print the square of a number')


def test_it_runs_and_its_errors_have_a_status(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['made-up', '--size', '3']) == 0
    assert capsys.readouterr().out == '9.0\n'
    assert main(['made-up', '--size', '-3e0']) == 3
    assert capsys.readouterr().err == 'psd-deflection made-up: --size = -3.0: must be at least 0\n'
    with pytest.raises(SystemExit) as usage:
        main(['made-up', '--sise', '3'])
    assert usage.value.code == 2
    assert '--size' in capsys.readouterr().err


def test_help_site_and_completion_know_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(['--help'])
    assert 'print the square of a number' in capsys.readouterr().out
    assert 'usage: psd-deflection made-up' in hooks.command_help()
    assert main(['completion', 'bash']) == 0
    assert 'made-up' in capsys.readouterr().out
