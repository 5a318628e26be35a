# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a shell completes."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from psd_deflection.cli.main import main


@pytest.mark.parametrize(
    ('typed', 'offered'),
    [
        (['monitor', '--port', 'so'], ['socket://']),
        (['estimator', '--port', ''], ['rfc2217://', 'rig.yaml', 'socket://', 'udp://']),
        (['devices', 'r'], ['rfc2217://', 'rig.yaml']),
        (['monitor', '--params-file', 'r'], ['rig.yaml']),
    ],
)
def test_bash_completes_a_port_by_scheme_or_file(
    typed: list[str], offered: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['completion', 'bash']) == 0
    (tmp_path / 'rig.yaml').touch()
    words = ' '.join(f"'{word}'" for word in ['psd-deflection', *typed])
    asked = f'COMP_WORDS=({words}); COMP_CWORD={len(typed)}; _shtab_psd_deflection; printf "%s\\n" "${{COMPREPLY[@]}}"'
    # compopt works only while a shell completes.
    script = f'compopt() {{ :; }}\n{capsys.readouterr().out}\n{asked}\n'
    ended = subprocess.run(
        ['bash', '--norc'], input=script, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True
    )
    assert sorted(ended.stdout.split()) == offered
