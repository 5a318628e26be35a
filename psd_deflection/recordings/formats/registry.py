# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""All formats of recordings, ours and those of other packages; which of them a path means.

A plug-in declares an entry point of the group ``psd_deflection.formats`` that has its name; the object is a
:class:`~psd_deflection.recordings.formats.format.Format`.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.plugins import loaded
from psd_deflection.recordings.formats.format import Format

GROUP = 'psd_deflection.formats'
HEAD = 64
"""Bytes by which a file is recognised."""

FORMATS = ('csv', 'mcap', 'rerun', 'bag')
"""Modules of this folder with a ``FORMAT``, in the order in which they are asked."""

FOLDER = 'bag'
"""The format of a path with any other ending."""


def find_format(name: str) -> Format:
    """The format of that name, one of :data:`FORMATS`."""
    ours: Format = importlib.import_module(f'psd_deflection.recordings.formats.{name}').FORMAT
    return ours


def formats() -> Iterator[Format]:
    """Each format, ours first; plug-ins are looked for when these are through.

    Raises ConfigError for a plug-in that cannot be loaded or is none.
    """
    yield from map(find_format, FORMATS)
    for point in sorted(entry_points(group=GROUP), key=lambda e: e.name):
        at = f'format {point.name!r}: {point.value}'
        found: object = loaded(f'{at} cannot be loaded', point.load)
        if not isinstance(found, Format):
            raise ConfigError(f'{at}: {found!r} is no psd_deflection.recordings.formats.format.Format')
        yield found


def format_of_name(path: str | Path) -> Format:
    """The format whose ending ``path`` has, else that of a folder."""
    suffix = Path(path).suffix.lower()
    named = (f for f in formats() if suffix in f.suffixes)
    return next(named, None) or find_format(FOLDER) if suffix else find_format(FOLDER)


def format_of_content(path: Path) -> Format | None:
    """The format that reads ``path``, a file or folder that is there; None if no format does.

    Raises OSError if a file cannot be read.
    """
    head = b''
    if not path.is_dir():
        with path.open('rb') as stream:
            head = stream.read(HEAD)
    suffix = '' if path.is_dir() else path.suffix.lower()
    readable = (f for f in formats() if f.read is not None)
    return next((f for f in readable if suffix in f.suffixes or f.holds(path, head)), None)


def endings_of_recordings() -> tuple[str, ...]:
    """Endings of the files that can be read."""
    return tuple(suffix for f in formats() if f.read is not None for suffix in f.suffixes)
