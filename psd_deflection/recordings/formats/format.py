# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The declaration of a format: the names of its files, how one is read, and how one is written."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

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
