# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a recording, a file or a device says reaches the terminal in printable lines only."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from psd_deflection.cli.main import main
from psd_deflection.cli.recordings import info
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording

CLEAN = Path(__file__).parent.parent.parent / 'bags' / 'clean'
ESCAPE = '\x1b[31mred\x1b]0;title\x07\nstate complete'


def clean_of(text: str) -> None:
    assert all(line.isprintable() for line in text.splitlines())
    assert '\nstate complete' not in text


def test_info_prints_no_control_characters(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def opened(path: Path, namespace: str | None = None, **_: object) -> Recording:
        recording = info_of(path)
        recording.hello = {'serial': ESCAPE, ESCAPE: '\ud800', 'firmware': 'x' * 10_000}
        recording.version = ESCAPE
        recording.parameters = {ESCAPE: ESCAPE}
        return recording

    info_of = open_recording
    monkeypatch.setattr(info, 'open_recording', opened)
    assert main(['info', str(CLEAN)]) == 0
    out = capsys.readouterr().out
    clean_of(out)
    assert '\\x1b[31mred' in out


@pytest.mark.slow
def test_names_of_files_reach_the_terminal_in_printable_lines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / 'copy\x1b[31m\nstate complete'
    shutil.copytree(CLEAN, copy)
    (copy / 'metadata.yaml').unlink()
    for command in (
        ['recover', str(copy)],
        ['replay', str(copy), '--out', str(copy) + '.csv'],
        ['convert', str(copy), '--out', str(copy) + '.mcap'],
        ['plot', str(copy), '--out', str(copy) + '.svg'],
    ):
        assert main(command) == 0
        output = capsys.readouterr()
        clean_of(output.out)
        assert '\\x1b[31m\\nstate' in output.out, command


def test_a_message_about_a_file_prints_none_either(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / 'rig.yaml'
    rig.write_text('/**: {ros__parameters: {"\\e[31mRED": 1}}')
    assert main(['params', '--params-file', str(rig)]) == 3
    copy = tmp_path / 'copy\x1b[31m'
    shutil.copytree(CLEAN, copy)
    (copy / 'metadata.yaml').write_text('x: [')
    assert main(['info', str(copy)]) == 4
    output = capsys.readouterr().err
    clean_of(output)
    assert '\\x1b[31m' in output
