# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Opens a recording of any format: every command that reads one does it by this."""

import itertools
from pathlib import Path

from psd_deflection.base.csv_table import head_of
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.foreign_tables import what_of_file
from psd_deflection.base.text import did_you_mean
from psd_deflection.recordings.formats.format import ReadOptions, format_of_content, formats
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.spans import FULL, Span

MOST_NAMES = 1000
"""Names of a folder that are looked at for one that was meant."""


def open_recording(
    path: str | Path,
    *,
    block_size: int | None = None,
    sample_rate_hz: float | None = None,
    namespace: str | None = None,
    span: Span = FULL,
) -> Recording:
    """Open ``path``: a bag folder, a lone ``.mcap`` or a ``.csv``.

    ``block_size``: samples per block; by default from the recording's own parameters (20 if it has
    none). ``sample_rate_hz``: for a CSV whose times do not determine it.
    ``namespace``: of the recorded node, for a bag of several rigs. ``span``: the part that is meant.
    Raises RecordingError if no format reads it, and as :meth:`Recording.crop` does; ConfigError for a plug-in that
    cannot be loaded.
    """
    options = ReadOptions(block_size=block_size, sample_rate_hz=sample_rate_hz, namespace=namespace)
    full = _open(Path(path), options)
    return full if span == FULL else full.crop(*span)


def _open(path: Path, options: ReadOptions) -> Recording:
    if not path.exists():
        raise RecordingError(f'{path}: no such recording{_meant(path)}')
    if not path.is_dir() and not path.is_file():
        # A pipe would wait for its writer, and it cannot be read twice.
        raise RecordingError(f'{path}: is no file; write it to one first')
    try:
        form = format_of_content(path)
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read ({error.strerror or error})') from None
    if form is None or form.read is None:
        *kinds, last = reversed([f.help for f in formats() if f.read is not None])
        raise RecordingError(
            f'{path}: is no recording: {", ".join(kinds)} or {last} is read{what_of_file(path, head_of(path))}'
        )
    return form.read(path, options)


def _meant(path: Path) -> str:
    """``; did you mean X?`` if the folder of ``path`` holds something of a similar name."""
    try:
        return did_you_mean(path.name, sorted(p.name for p in itertools.islice(path.parent.iterdir(), MOST_NAMES)))
    except OSError:
        return ''
