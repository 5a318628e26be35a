# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The declaration of a format, how one is read and written; all formats, ours and those of other packages (entry points
of the group ``psd_deflection.formats``), which of them a path means, and the file that it makes."""

import importlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.plugins import loaded
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import Record, ReferenceWithCovariance


class Sink(Protocol):
    """Takes records, one thread at a time. Both calls raise RecordingError if the disk cannot be written."""

    def put(self, record: Record) -> None:
        """Take one record; a sink ignores the kinds that it cannot store."""

    def close(self) -> None:
        """Write the buffered rest and close; a second call does nothing."""


class ReferenceFile(Protocol):
    """Takes the answers of a camera. Both calls raise RecordingError if the disk cannot be written."""

    def put(self, t_ns: int, reference: ReferenceWithCovariance | None, status: str) -> None:
        """Take the answer of one frame: its pose, or None and the reason why there is none."""

    def close(self) -> None:
        """Write the rest and close."""


@dataclass(frozen=True)
class ReadOptions:
    """The options of a recording that is opened, see :func:`..read.readers.open_recording`."""

    block_size: int | None = None
    sample_rate_hz: float | None = None
    namespace: str | None = None


@dataclass(frozen=True)
class WriteOptions:
    """The options of a file that is written, see :func:`..write.sinks.open_sink`."""

    rig_values: Mapping[str, object] = field(default_factory=dict)
    device_hello: Mapping[str, object] | None = None
    samples_with: Collection[type[Record]] | None = None
    title: str = ''
    psds: int = 2


def _never(path: Path, head: bytes) -> bool:
    return False


@dataclass(frozen=True)
class Format:
    """One format of recordings.

    ``suffixes``: endings of its files, in lower case with the dot; none: a folder. ``help``: what such a recording is
    called, with its article. ``holds``: whether a path without such an ending is one, by its first ``HEAD`` bytes (none
    of a folder). ``read`` raises RecordingError. ``write`` and ``write_references`` raise it too; they make a new file.
    Without ``read`` a file is only to be looked at, and holds what is computed. ``is_table``: a row is a sample, so a
    load is to be written before it, and times count from 0.
    """

    name: str
    suffixes: tuple[str, ...]
    help: str
    read: Callable[[Path, ReadOptions], Recording] | None = None
    write: Callable[[Path, WriteOptions], Sink] | None = None
    write_references: Callable[[Path], ReferenceFile] | None = None
    holds: Callable[[Path, bytes], bool] = _never
    is_table: bool = False


GROUP = 'psd_deflection.formats'
HEAD = 64
"""Bytes by which a file is recognised."""

FORMATS = tuple(name for name in ('csv', 'mcap', 'rerun', 'bag') if Path(__file__).with_name(f'{name}.py').exists())
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
        plug_in: object = loaded(f'{at} cannot be loaded', point.load)
        if not isinstance(plug_in, Format):
            raise ConfigError(f'{at}: {plug_in!r} is no psd_deflection.recordings.formats.format.Format')
        yield plug_in


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


def open_sink(
    path: str | Path,
    rig_values: Mapping[str, object],
    *,
    device_hello: Mapping[str, object] | None = None,
    samples_with: Collection[type[Record]] | None = None,
    title: str = '',
    psds: int = 2,
) -> Sink:
    """The sink for ``path``: a ``.csv``, an ``.rrd`` (for Rerun), an ``.mcap`` (a single file), else a bag folder.

    ``rig_values``: the flat parameter set. ``samples_with``: a CSV holds the samples, with columns for these
    kinds of records; None: it holds the estimates. ``title``: title of an ``.rrd``. ``psds``: of the samples of a CSV.
    Raises RecordingError if ``path`` exists or cannot be made, or if its format is only read; ConfigError if rerun
    is not installed.
    """
    form = format_of_name(path)
    if form.write is None:
        raise RecordingError(f'{path}: {form.help} is read and not written')
    options = WriteOptions(
        rig_values=rig_values, device_hello=device_hello, samples_with=samples_with, title=title, psds=psds
    )
    return form.write(Path(path), options)


def open_reference_file(path: str | Path) -> ReferenceFile:
    """The file for the poses of a camera. Raises as :func:`open_sink` does."""
    form = format_of_name(path)
    if form.write_references is None:
        raise RecordingError(f'{path}: {form.help} does not take the poses of a camera')
    return form.write_references(Path(path))
