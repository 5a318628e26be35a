# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The way to a .deb: the rows that rosdep lacks, what bloom says, the line of pip. No network, no root."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tools.deb import one_line, templates, tree
from tools.release import rosdep_table
from tools.rosdistro import differences, our_rows, prepared, resolved

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent


def program(folder: Path, name: str, text: str) -> Path:
    """An executable of this name in ``folder/bin``."""
    path = folder / 'bin' / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('#!/bin/sh\n' + text)
    path.chmod(0o755)
    return folder


def test_each_key_without_a_row_is_among_the_lines_to_submit() -> None:
    ours = yaml.safe_load(our_rows(ROOT))
    for key, row in rosdep_table(ROOT).items():
        for version, how in row.items():
            if how == 'none':
                assert ours[key]['debian' if version == 'bookworm' else 'ubuntu'] == [key]


def test_a_table_that_says_otherwise_than_rosdep_is_named() -> None:
    table = {'a': {'noble': 'apt', 'bookworm': 'none'}, 'b': {'noble': 'apt', 'bookworm': 'apt'}}
    assert differences(table, table) == []
    found = {**table, 'b': {'noble': 'apt', 'bookworm': 'pip'}}
    assert differences(table, found) == ['packaging/rosdep_keys.csv: b on bookworm is apt, rosdep says pip']


def test_rosdep_reads_the_checkout_alone_and_our_rows_first(tmp_path: Path) -> None:
    distributions = {name: {'distribution': [f'{name}/distribution.yaml']} for name in ('jazzy', 'lyrical', 'melodic')}
    (tmp_path / 'rd').mkdir()
    (tmp_path / 'rd/index-v4.yaml').write_text(yaml.safe_dump({'type': 'index', 'distributions': distributions}))
    for name in distributions:
        (tmp_path / 'rd' / name).mkdir()
        (tmp_path / 'rd' / name / 'distribution.yaml').write_text('repositories: {rclpy: {}}')
    tools = program(tmp_path / 'tools', 'rosdep', 'cat "$ROSDEP_SOURCE_PATH"/*.list >"$HOME/asked"')
    env = prepared(tmp_path / 'rd', tools, tmp_path / 'into', 'key: {}\n')
    asked = (tmp_path / 'into/asked').read_text().splitlines()
    assert asked[0] == f'yaml file://{tmp_path}/into/ours.yaml'
    assert all(line.startswith(f'yaml file://{tmp_path}/rd/rosdep/') for line in asked[1:])
    index = yaml.safe_load(Path(env['ROSDISTRO_INDEX_URL'].removeprefix('file://')).read_text())
    assert sorted(index['distributions']) == ['jazzy', 'lyrical']
    cache = yaml.safe_load((tmp_path / 'into/jazzy-cache.yaml').read_text())
    assert cache['distribution_file'] == [{'repositories': {'rclpy': {}}}]


def test_the_answers_of_rosdep_are_by_key_and_system(tmp_path: Path) -> None:
    tools = program(tmp_path, 'python', 'echo "{\\"k\\": \\"$3-$4-$ROS_DISTRO\\"}"')
    assert resolved({}, tools, ['k']) == {
        'k': {'noble': 'ubuntu-noble-jazzy', 'resolute': 'ubuntu-resolute-lyrical', 'bookworm': 'debian-bookworm-jazzy'}
    }


def test_what_bloom_warns_of_is_reported_and_a_rejection_is_an_error(tmp_path: Path) -> None:
    message = 'mkdir debian; touch debian/control; echo "No CHANGELOG.rst found"; echo fine'
    path = program(tmp_path, 'bloom-generate', message)
    env = {'PATH': f'{path / "bin"}:/usr/bin:/bin'}
    assert templates(tmp_path, env, 'ubuntu', 'noble') == ['No CHANGELOG.rst found']
    program(tmp_path, 'bloom-generate', "echo Could not resolve rosdep key \\'x\\' >&2; exit 1")
    with pytest.raises(RuntimeError, match="bloom rejects the package for noble:\nCould not resolve rosdep key 'x'"):
        templates(tmp_path, env, 'ubuntu', 'noble')


def test_what_is_built_is_what_git_has_and_the_line_is_that_of_the_page(tmp_path: Path) -> None:
    (tmp_path / 'of').mkdir()
    copy = tree(ROOT, tmp_path / 'of')
    assert (copy / 'package.xml').read_bytes() == (ROOT / 'package.xml').read_bytes()
    assert (copy / 'CHANGELOG.rst').is_file()
    assert not (copy / '.venv').exists()
    assert one_line(copy) in (ROOT / 'README.md').read_text()
