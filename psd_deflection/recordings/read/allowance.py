# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How much work a recording may cause: every bound on what an MCAP file declares is here.

A few bytes of a compressed chunk can stand for millions of records. So one pass over a file gets an
allowance in proportion to the file's size, far above what any writer needs (ours takes 86 bytes a record, and
2.6 bytes unpacked for each in the file). What lies beyond it is left out with a warning.
"""

from __future__ import annotations

MAX_CHUNK_BYTES = 256 * 2**20
"""Bound of one chunk, uncompressed, and of one record outside of any; writers make chunks of 1 to 4 MiB."""

MAX_DESCRIPTION_BYTES = 16 * 2**20
"""Bound of one schema, channel or metadata record."""

MAX_FIELDS = 64
"""Fields of a point; ours has at most ten."""

MAX_WARNINGS = 100

_RECORDS = 10_000
_BYTES_A_RECORD = 4
_UNPACKED_BYTES = 64 * 2**20
_UNPACKED_EACH = 100
_OUTSIDE = 6
"""A record outside of any chunk counts as so many; a message or an index of one takes 31 bytes at least."""

_DESCRIPTION = 4
_BYTES_OF_TEXT = 100
"""A schema, channel or metadata record counts as so many more, and one more for each of so many bytes."""


class DamagedError(Exception):
    """The bytes contradict themselves, or ask for more than is allowed."""


class SpentError(Exception):
    """The file unpacks to more than a file of its size may."""


class Allowance:
    """Of one pass over a file of ``size`` bytes. ``records``: how many may still come; the reader of a chunk counts
    them down."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.records = _RECORDS + size // _BYTES_A_RECORD
        self._most = self._left = _UNPACKED_BYTES + _UNPACKED_EACH * size

    def may_unpack(self, size: int) -> None:
        """Raise DamagedError if no chunk may declare ``size`` bytes, SpentError if the file may not unpack to more."""
        if size > MAX_CHUNK_BYTES:
            raise DamagedError(f'it declares {size} bytes, more than {MAX_CHUNK_BYTES}')
        if size > self._left:
            most = f'{self._most} bytes, as many as a file of {self.size} bytes may'
            raise SpentError(f'unpacks to more than {most}: a chunk that declares {size} bytes is left out')

    def unpacked(self, size: int) -> None:
        """A chunk of ``size`` bytes was unpacked."""
        self._left -= size

    def outside(self) -> bool:
        """Allow for a record outside of any chunk; False if that is one too many."""
        self.records -= _OUTSIDE
        return self.records >= 0

    def describe(self, size: int) -> None:
        """Allow for a schema, channel or metadata record of ``size`` bytes. Raises DamagedError."""
        if size > MAX_DESCRIPTION_BYTES:
            raise DamagedError(f'it has {size} bytes, more than {MAX_DESCRIPTION_BYTES}')
        self.records -= _DESCRIPTION + size // _BYTES_OF_TEXT
        self.check()

    def check(self) -> None:
        """Raise DamagedError if too many records came."""
        if self.records < 0:
            raise DamagedError(f'more records than a file of {self.size} bytes can need')


class Warnings:
    """Lines, each once, at most ``MAX_WARNINGS``."""

    def __init__(self) -> None:
        self._lines: dict[str, None] = {}
        self._more = False

    def add(self, line: str) -> None:
        """One line, unless it is there."""
        if len(self._lines) < MAX_WARNINGS:
            self._lines[line] = None
        elif line not in self._lines:
            self._more = True

    def lines(self) -> list[str]:
        """All of them, in order."""
        return [*self._lines, *(['further warnings are not listed'] if self._more else [])]
