# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a release must not have is noticed: each sabotage of a copy of the tree is one line of the check."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tools.release import MAKERS, TREE, main

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
NEEDED = (
    *('package.xml', 'setup.cfg', 'LICENSE', 'CHANGELOG.md', 'CITATION.cff', 'docs/dependencies.md', '.github'),
    *('packaging', 'psd_deflection/__init__.py', 'psd_deflection/base/page'),
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
        (lambda root: change(root / 'CITATION.cff', 'version: 0', 'version: 9'), 'CITATION.cff: stale'),
        (lambda root: change(root / 'CHANGELOG.md', '(2026-12-01)', '(unreleased)'), 'unreleased; a release has'),
    ],
    ids=['a key of pip', 'an action that can be moved', 'no licence', 'a stale citation', 'no date'],
)
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
