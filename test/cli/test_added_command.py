# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Another package adds a command and a study: `psd-deflection NAME` runs them."""

from pathlib import Path

import pytest

from psd_deflection.cli.main import COMMANDS, main
from test.plug_in import install_plug_in

BAGS = Path(__file__).parent.parent.parent / 'bags'
CODE = """
'''Count the letters of a word.'''


from psd_deflection.studies.study import StudyResult


def add_arguments(parser):
    parser.add_argument('word')


def run(args):
    print(len(args.word))
    return 0


class Length(StudyResult):
    study, title, json_name = 'length', 'How long', 'length.json'

    def __init__(self, seconds):
        self.seconds = seconds

    def tree(self):
        return {'length': self.seconds}

    def sentences(self):
        return [f'{self.seconds:.2f} s of samples.']

    def sections(self):
        return []

    def table(self):
        return {}


def length(opened):
    '''Measure how long a recording is.'''
    blocks = list(opened.recording.blocks())
    return Length((blocks[-1].t_ns[-1] - blocks[0].t_ns[0]) / 1e9)
"""
POINTS = """
[psd_deflection.commands]
letters = my_package.extra
absent = my_package.nowhere
hollow = my_package

[psd_deflection.studies]
length = my_package.extra:length
"""


@pytest.fixture(autouse=True)
def added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plug_in(tmp_path, monkeypatch, 'extra', CODE, POINTS)


def test_a_command_of_another_package_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['letters', 'tip']) == 0
    assert capsys.readouterr().out == '3\n'


def test_a_study_of_another_package_answers_and_writes_its_page(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for earlier in (False, True):
        assert main(['length', str(BAGS / 'clean'), '--out', str(tmp_path / 'out')]) == 0
        printed = capsys.readouterr()
        assert ' s of samples.' in printed.out
        assert (f'note: --out {tmp_path / "out"}: replaces the results of 20' in printed.err) is earlier
    assert sorted(p.name for p in (tmp_path / 'out').iterdir()) == ['length.json', 'report.html']


def test_help_lists_what_is_added_and_of_which_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert '\n  plug-ins   absent, hollow, length, letters\n' in capsys.readouterr().out


@pytest.mark.parametrize('name', ['absent', 'hollow'])
def test_an_added_command_that_is_none_is_rejected(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert f"command '{name}': my_package" in line


def test_a_command_of_ours_cannot_be_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = tmp_path / 'my_package-1.0.dist-info' / 'entry_points.txt'
    points.write_text('[psd_deflection.commands]\ninfo = my_package.extra\n')
    assert main([]) == 0
    assert 'plug-ins' not in capsys.readouterr().out
    assert 'info' in COMMANDS
