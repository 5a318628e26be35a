# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Columns that line up, JSON and figures on disk, for the commands that report."""

import io
import shutil
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from psd_deflection.base.errors import RecordingError
from psd_deflection.base.files import replace_file
from psd_deflection.base.log import Note
from psd_deflection.base.text import json_text, sanitize

LONGEST_LINE = 2000
"""Characters of a line with words of a file or of a device in it."""


def warn(warning: str) -> None:
    """One warning or note on the standard error. It may hold words of a file."""
    show(f'{"note" if isinstance(warning, Note) else "warning"}: {warning}', aside=True)


def show(*lines: str, aside: bool = False) -> None:
    """Print lines for a person, on the standard error if ``aside``; an empty one if there are none.

    Each may hold words of a file or a device and is made printable: a line end in it is shown as an escape.
    """
    for line in lines or ('',):
        print(sanitize(line, LONGEST_LINE), file=sys.stderr if aside else sys.stdout)


def show_text(text: str, *, aside: bool = False) -> None:
    """Print a text of several lines that was made here, as :func:`show` does."""
    show(*text.split('\n'), aside=aside)


def print_json(value: Any, indent: int | None = None) -> None:
    """Print ``value`` as JSON, with null for numbers that JSON does not have (NaN, infinite)."""
    print(json_text(value, indent))


def save_figure(figure: Any, path: Path, **options: Any) -> None:
    """Write a matplotlib figure in the format of its ending; raises RecordingError as :func:`save` does."""
    stream = io.BytesIO()
    figure.savefig(stream, format=path.suffix[1:].lower(), **options)
    save(stream.getvalue(), path)


def save(content: bytes, path: Path) -> None:
    """Write ``path`` completely or not at all; raises RecordingError if the disk cannot be written."""
    try:
        replace_file(path, content)
    except OSError as error:
        raise RecordingError(f'--out {path}: cannot be written ({error.strerror or error})') from None


def save_all(files: Mapping[str, str], folder: Path) -> None:
    """Write texts by their names, with a note if earlier ones are replaced; raises RecordingError as :func:`save`."""
    earlier = [(folder / name).stat().st_mtime for name in files if (folder / name).exists()]
    if earlier:
        made = datetime.fromtimestamp(max(earlier)).astimezone()
        warn(Note(f'--out {folder}: replaces the results of {made:%Y-%m-%d %H:%M:%S}'))
    for name, text in files.items():
        save(text.encode(errors='replace'), folder / name)


NAME = 'psd-deflection'


def program() -> str:
    """``psd-deflection`` if the shell finds it; else the path that was used, as by ``make run`` from ``.venv/bin``."""
    if shutil.which(NAME) is not None:
        return NAME
    called = Path(sys.argv[0])
    return str(called) if called.name == NAME else f'{sys.executable} -m psd_deflection'
