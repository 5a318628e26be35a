# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The workflow of docs/ci.md: valid for GitHub, and its lines run in a repository as the page describes it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from tools.program import ROOT
from tools.run_commands import FENCE

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
