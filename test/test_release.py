# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a release must not have is noticed: each sabotage of a copy of the tree is one line of the check."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tools.release import (
    MAKERS,
    TREE,
    changelog_rst,
    check_licences_of,
    check_wheel,
    facts,
    main,
    rosdep_table,
)

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
NEEDED = (
    'package.xml',
    'setup.cfg',
    'LICENSE',
    'CHANGELOG.md',
    'CITATION.cff',
    'docs/dependencies.md',
    '.github',
    'packaging',
    'psd_deflection/__init__.py',
    'psd_deflection/base/page',
)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of what a release is judged by."""
    for name in NEEDED:
        copy = tmp_path / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, copy)
    return tmp_path


def problems(root: Path, *, release: bool = False) -> list[str]:
    return [problem for check in TREE for problem in check(root, release)]


def change(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def ready(root: Path) -> None:
    """What the maintainer does before a release: addresses, a date, rows of rosdep, the files that repeat them."""
    for file in [root / 'package.xml', *(root / '.github').rglob('*.yml')]:
        if file.is_file():
            file.write_text(file.read_text().replace('.invalid', '.org'))
    change(root / 'CHANGELOG.md', '(unreleased)', '(2026-12-01)')
    table = root / 'packaging/rosdep_keys.csv'
    table.write_text(table.read_text().replace('none', 'apt'))
    change(root / 'docs/dependencies.md', 'none yet: `apt install python3-zstandard`', 'python3-zstandard')
    for name, made in MAKERS.items():
        (root / name).write_text(made(root))


def test_the_tree_as_it_is_has_no_problem() -> None:
    assert problems(ROOT) == []


def test_a_tree_with_addresses_date_and_rows_may_be_released(tree: Path) -> None:
    ready(tree)
    assert problems(tree, release=True) == []


@pytest.mark.parametrize(
    ('sabotage', 'message'),
    [
        (
            lambda root: change(root / 'package.xml', '<exec_depend>python3-yaml<', '<exec_depend>python-cobs-pip<'),
            'key python-cobs-pip is resolved by pip on noble; bloom rejects it',
        ),
        (
            lambda root: (root / '.github/workflows/more.yml').write_text('      - uses: actions/checkout@v4\n'),
            'actions/checkout@v4 is not pinned by the SHA of a commit',
        ),
        (lambda root: (root / 'LICENSE').unlink(), 'LICENSE: missing'),
        (
            lambda root: (root / 'psd_deflection/base/page/vendor/uPlot.LICENSE').unlink(),
            'what is not ours has no licence beside it',
        ),
        (
            lambda root: change(root / 'package.xml', 'https://psd-deflection.org/<', 'https://psd-deflection.invalid/<'),
            'package.xml: an address ends with .invalid',
        ),
        (lambda root: change(root / 'setup.cfg', 'url = https', 'url = ftp'), 'setup.cfg: stale'),
        (lambda root: change(root / 'CITATION.cff', 'version: 0', 'version: 9'), 'CITATION.cff: stale'),
        (lambda root: change(root / 'CHANGELOG.rst', 'Measuring', 'Measured'), 'CHANGELOG.rst: stale'),
        (lambda root: change(root / 'package.xml', '<version>', '<version>9'), 'package.xml: version 9'),
        (lambda root: change(root / 'CHANGELOG.md', '(2026-12-01)', '(unreleased)'), 'unreleased; a release has'),
        (lambda root: change(root / 'CHANGELOG.md', '## 0', '## 9'), 'CHANGELOG.md: no entry for'),
        (
            lambda root: change(root / 'packaging/rosdep_keys.csv', 'python3-yaml,apt', 'python3-yaml,none'),
            'key python3-yaml has no row for noble',
        ),
        (
            lambda root: change(root / 'docs/dependencies.md', '| python3-zstandard |', '| none yet |'),
            'package.xml: lacks zstandard, for which rosdep has no key yet',
        ),
    ],
    ids=[
        'a key of pip', 'an action that can be moved', 'no licence', 'no licence of what is not ours',
        'an address that leads nowhere', 'another address',
        'a stale citation', 'a stale changelog', 'another version', 'no date',
        'no entry', 'a key without a row', 'no key',
    ],
)  # fmt: skip
def test_what_a_release_must_not_have_is_reported(
    tree: Path,
    sabotage: Callable[[Path], object],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('RELEASE', '1')
    ready(tree)
    assert main(['check'], tree) == 0
    sabotage(tree)
    assert main(['check'], tree) == 1
    found = [line for line in capsys.readouterr().out.splitlines() if line.startswith('PROBLEM: ')]
    assert any(message in line for line in found), found


def packed(wheel: Path, without: str = '\0') -> Path:
    """A wheel with the files of the tree, but those that have ``without`` in their names."""
    with zipfile.ZipFile(wheel, 'w') as archive:
        for package in ('psd_deflection', 'msg_adapters'):
            for path in (ROOT / package).rglob('*'):
                if path.is_file() and '__pycache__' not in str(path) and without not in str(path):
                    archive.write(path, str(path.relative_to(ROOT)))
        archive.writestr('x.dist-info/licenses/LICENSE', '')
        archive.writestr('x.data/data/share/psd_deflection/package.xml', '')
    return wheel


def test_a_wheel_without_the_page_is_noticed(tmp_path: Path) -> None:
    assert list(check_wheel(ROOT, packed(tmp_path / 'whole.whl'))) == []
    message = list(check_wheel(ROOT, packed(tmp_path / 'bare.whl', '/page/vendor/')))
    assert message
    assert all('lacks psd_deflection/base/page/vendor/' in line for line in message)


def test_a_check_of_a_wheel_without_the_page_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With judges that find nothing."""
    made = tmp_path
    (made / 'dist').mkdir()
    (made / 'dist/x.tar.gz').touch()
    (made / 'build/release/bin').mkdir(parents=True)
    for tool in ('twine', 'check-wheel-contents', 'zizmor', 'hadolint', 'python', 'pip-audit'):
        (made / 'build/release/bin' / tool).symlink_to('/bin/true')
    bom = made / 'build/release/bin/cyclonedx-py'
    bom.write_text('#!/bin/sh\nfor last; do :; done; echo \'{"components": [1]}\' >"$last"\n')
    bom.chmod(0o755)
    subprocess.run([sys.executable, '-m', 'venv', '--without-pip', made / 'use'], check=True)
    words = ['check', '--dist', made / 'dist', '--installed', made / 'use', '--tools', made / 'build/release']
    for without, status in (('\0', 0), ('/page/', 1)):
        packed(made / 'dist/x.whl', without)
        assert main([str(w) for w in words], ROOT) == status
    assert 'PROBLEM: x.whl: lacks psd_deflection/run/monitor/page/' in capsys.readouterr().out


def test_a_copyleft_licence_among_what_is_installed_is_noticed(tmp_path: Path) -> None:
    subprocess.run([sys.executable, '-m', 'venv', '--without-pip', tmp_path / 'use'], check=True)
    python = tmp_path / 'use/bin/python'
    info = next((tmp_path / 'use/lib').glob('python*')) / 'site-packages/strict-1.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: strict\nVersion: 1\nLicense: LGPL-3.0\n')
    assert check_licences_of(python) == ([], [])
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: strict\nVersion: 1\nLicense: GPL-3.0\n')
    assert check_licences_of(python) == (['strict 1: GPL-3.0'], [])


def test_what_was_not_tried_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['check']) == 0
    message = capsys.readouterr().out
    assert 'not tried: what is built' in message
    assert 'not tried: what only a release must have' in message
    assert 'not tried: publishing' in message


def test_the_changelog_of_bloom_has_the_text_of_the_other(tree: Path) -> None:
    ready(tree)
    made = changelog_rst(tree)
    assert f'\n{facts(tree).version} (2026-12-01)\n------------------\n' in made
    assert '\n  * ``estimator``: 1 kHz samples' in made
    entries = sum(line.startswith('- ') for line in (tree / 'CHANGELOG.md').read_text().splitlines())
    assert sum(line.startswith('  * ') for line in made.splitlines()) == entries
    assert '](' not in made


def test_the_table_of_keys_says_one_of_three_words() -> None:
    for key, row in rosdep_table(ROOT).items():
        assert set(row) == {'noble', 'resolute', 'bookworm'}, key
        assert set(row.values()) <= {'apt', 'pip', 'none'}, key
