# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings from the words of a command line: paths, patterns, and text files that list them."""

from __future__ import annotations

import glob
from collections.abc import Iterator, Sequence
from pathlib import Path

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.formats.registry import endings_of_recordings

LIST = '.txt'
"""Ending of a file with one recording or pattern a line."""

LARGEST_LIST = 16 * 2**20
"""Bytes of such a file."""


def is_plain(word: str) -> bool:
    """Whether ``word`` is one recording by its path, neither a pattern nor a list."""
    return not (_is_list(Path(word)) or _is_pattern(word))


def listed(words: Sequence[str]) -> list[str]:
    """Every recording of ``words`` once, in their order; what a pattern matches is sorted.

    A pattern (``*``, ``?``, ``[a-z]``, ``**`` for folders at any depth) takes bag folders, ``.mcap`` and ``.csv``, and
    of a bag folder that it takes not the files as well. A list is a ``.txt``: one path or pattern a line, relative to
    the list's folder; empty lines and lines that begin with ``#`` are left out. A path that does not exist stays: the
    command says so when its turn comes.

    Raises RecordingError if a list cannot be read or a pattern matches nothing.
    """
    found: list[str] = []
    for word in words:
        found += _of_list(Path(word)) if _is_list(Path(word)) else _of_word(word)
    return list(dict.fromkeys(found))


def _is_list(path: Path) -> bool:
    return path.suffix.lower() == LIST and path.is_file()


def _is_pattern(word: str) -> bool:
    return glob.has_magic(word) and not Path(word).exists()


def _of_word(word: str) -> list[str]:
    if not _is_pattern(word):
        return [word]
    matches = sorted(Path(name) for name in glob.iglob(word, recursive=True))  # noqa: PTH207 - Path has no `..` in it
    folders = {path for path in matches if path.is_dir() and _is_bag(path)}
    endings = endings_of_recordings()
    files = (p for p in matches if p.suffix.lower() in endings and p.is_file() and p.parent not in folders)
    found = [str(path) for path in sorted([*folders, *files])]
    if not found:
        raise RecordingError(f'{word}: matches no recording (bag folders, {", ".join(endings)})')
    return found


def _is_bag(folder: Path) -> bool:
    # Without metadata it was cut off; its files have its name.
    return (folder / 'metadata.yaml').is_file() or any(folder.glob(f'{glob.escape(folder.name)}_*.mcap'))


def _of_list(path: Path) -> Iterator[str]:
    try:
        with path.open('rb') as stream:
            content = stream.read(LARGEST_LIST + 1)
        text = content.decode('utf-8-sig')
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read ({error.strerror or error})') from None
    except UnicodeDecodeError:
        raise RecordingError(f'{path}: is no list of recordings: it is not UTF-8 text') from None
    if len(content) > LARGEST_LIST:
        raise RecordingError(f'{path}: is larger than {LARGEST_LIST >> 20} MiB; give several lists')
    lines = [line.strip() for line in text.splitlines()]
    entries = [line for line in lines if line and not line.startswith('#')]
    if not entries:
        raise RecordingError(f'{path}: lists no recording (one a line, or a pattern)')
    for entry in entries:
        yield from _of_word(str(path.parent / entry))
