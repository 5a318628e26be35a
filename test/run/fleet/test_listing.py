# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which recordings the words of a command line mean."""

from __future__ import annotations

from pathlib import Path

import pytest

from psd_deflection.base.errors import RecordingError
from psd_deflection.run.fleet.listing import LARGEST_LIST, is_plain, listed


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ('a/run_1', 'a/run_2', 'b', 'b/notes'):
        (tmp_path / name).mkdir(parents=True)
    for name in ('a/run_1/run_1_0.mcap', 'a/run_1/metadata.yaml', 'a/run_2/run_2_0.mcap'):
        (tmp_path / name).touch()
    for name in ('b/lone.mcap', 'b/table.CSV', 'b/notes/readme.md', 'b/run[1].csv'):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_words_stay_in_their_order_each_once(archive: Path) -> None:
    assert listed(['b/lone.mcap', 'nowhere', 'a/run_1', 'b/lone.mcap']) == ['b/lone.mcap', 'nowhere', 'a/run_1']


def test_pattern_takes_bags_and_files_not_bag_parts(archive: Path) -> None:
    assert listed(['**']) == ['a/run_1', 'a/run_2', 'b/lone.mcap', 'b/run[1].csv', 'b/table.CSV']
    assert listed(['a/*']) == ['a/run_1', 'a/run_2']
    # Asked for by name, a file of a bag is a recording.
    assert listed(['**/*.mcap']) == ['a/run_1/run_1_0.mcap', 'a/run_2/run_2_0.mcap', 'b/lone.mcap']
    assert listed([f'{archive}/b/*.mcap']) == [f'{archive}/b/lone.mcap']


def test_a_name_that_looks_like_a_pattern_and_exists_is_a_name(archive: Path) -> None:
    assert is_plain('b/run[1].csv')
    assert listed(['b/run[1].csv']) == ['b/run[1].csv']
    assert not is_plain('b/run[12].csv')


def test_a_list_is_relative_to_its_folder(archive: Path) -> None:
    (archive / 'b' / 'list.txt').write_text('\ufeff# the good ones\n\nlone.mcap\n  ../a/*  \n', encoding='utf-8')
    assert not is_plain('b/list.txt')
    assert listed(['b/list.txt', 'a/run_1']) == ['b/lone.mcap', 'b/../a/run_1', 'b/../a/run_2', 'a/run_1']
    # There is none: the command says so.
    assert listed(['none.txt']) == ['none.txt']


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (b'# nothing\n', 'lists no recording'),
        (b'\xff\xfe\n', 'is not UTF-8'),
        (b'*.mcap\n', 'matches no recording'),
        (b'\n' * (LARGEST_LIST + 1), 'larger than 16 MiB'),
    ],
)
def test_a_bad_list_is_rejected(archive: Path, content: bytes, message: str) -> None:
    (archive / 'list.txt').write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        listed(['list.txt'])
    with pytest.raises(RecordingError, match=r'^c\*: matches no recording'):
        listed(['c*'])
