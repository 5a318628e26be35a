# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A part of a recording: from when and up to when, in the words of a person."""

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Protocol

import numpy as np

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.text import did_you_mean, sanitize
from psd_deflection.records import Mark

Bound = float | datetime | str
"""s from the first sample, a time with a time zone, or ``mark:TEXT``: the time of the mark with this text."""
MARK_WORD = 'mark:'
"""Begins a bound that is a mark."""
Span = tuple[Bound | None, Bound | None]
"""From and up to; None: the start or the end."""
FULL: Span = (None, None)
MOST_NAMED = 20
"""Marks that are named if the one that is wanted is not there."""
LONGEST_TEXT = 2000
"""Characters of a mark that is asked for, in an error."""


class Marked(Protocol):
    """A recording, by its path and its marks."""

    path: Path

    def marks(self) -> Sequence[Mark]:
        """In order of time."""


def span_ns(recording: Marked, start_ns: int, span: Span) -> tuple[int, int]:
    """From when and up to when, ns by the clock of ``recording``; its first sample is at ``start_ns``.

    Raises RecordingError if it lacks a mark, ConfigError if a text is no bound.
    """
    first, last = span
    first_ns = start_ns if first is None else _ns(recording, first, start_ns)
    end_ns = np.iinfo(np.int64).max if last is None else _ns(recording, last, start_ns, first_ns)
    return first_ns, end_ns


def _mark_ns(recording: Marked, bound: str, after_ns: int | None) -> int:
    if not bound.startswith(MARK_WORD):
        raise ConfigError(f'{bound!r}: must be s from the first sample, a time with a time zone, or {MARK_WORD}TEXT')
    text = bound.removeprefix(MARK_WORD).strip()
    there = recording.marks()
    times = [mark.t_ns for mark in there if mark.text == text]
    if not times:
        names = sorted({mark.text for mark in there})
        have = f'its marks are {", ".join(names[:MOST_NAMED])}' if names else 'it has no marks'
        raise RecordingError(
            f'{recording.path}: has no mark {sanitize(text, LONGEST_TEXT)!r}; {have}{did_you_mean(text, names)}'
        )
    # To the mark that it begins with there is nothing: the next one is meant.
    return next((t_ns for t_ns in times if after_ns is None or t_ns > after_ns), times[-1])


def _ns(recording: Marked, bound: Bound, start_ns: int, after_ns: int | None = None) -> int:
    """A bound in ns, by the clock of the recording. ``after_ns``: of marks of one name the first after it."""
    if isinstance(bound, str):
        return _mark_ns(recording, bound, after_ns)
    if isinstance(bound, datetime):
        return (bound - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000
    return start_ns + round(bound * 1e9)
