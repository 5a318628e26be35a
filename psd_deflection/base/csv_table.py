# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A CSV table with a header: its lines, its declared columns, and what is said of a table that is another program's."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TextIO

from psd_deflection.base.errors import RecordingError
from psd_deflection.base.foreign_tables import text_fault, what_of_header, why_no_number
from psd_deflection.base.text import NUMBER, sanitize

MAX_LINE = 10_000
"""Maximum characters of a line; a longer line is not a row of a table."""

LONGEST_CELL = 80
"""Characters of a cell that a message quotes."""

HEAD = 1 << 16
"""Bytes by which the program that wrote a table is recognised."""


def head_of(path: Path) -> bytes:
    """The first bytes of a file; none if it cannot be read, or is a folder."""
    try:
        with path.open('rb') as stream:
            return stream.read(HEAD)
    except OSError:
        return b''


class Row(NamedTuple):
    """One row of ``table``: the number of its line, and its cells."""

    table: CsvTable
    line: int
    cells: Sequence[str]

    def text(self, name: str) -> str:
        """The cell of a column, without the spaces around it."""
        return self.cells[self.table.columns[name]].strip()

    def number(self, name: str, largest: float = math.inf) -> float:
        """The finite number in a column, at most ``largest`` in size. Raises RecordingError with line and column."""
        cell = self.text(name)
        if NUMBER.fullmatch(cell) is None:
            raise self.reject(f'{self._holds(name)}, which is not a number{why_no_number(name, cell)}')
        value = float(cell)
        if not math.isfinite(value):
            raise self.reject(f'{self._holds(name)}, which is not finite')
        if abs(value) > largest:
            raise self.reject(f'{self._holds(name)}, which is beyond ±{largest:g}')
        return value

    def reject(self, why: str) -> RecordingError:
        """The error for this row."""
        return self.table.reject(why, self.line)

    def _holds(self, name: str) -> str:
        return f'column {name} holds {sanitize(self.text(name), LONGEST_CELL)!r}'


class CsvTable:
    """The lines of one file. The calls raise RecordingError naming file, line and column of a fault."""

    def __init__(self, path: Path) -> None:
        self.path = path
        first = next(self._cells(None, 0), None)
        if first is None:
            raise self.reject('is empty')
        self.header_line, names = first
        self.header = [name.strip() for name in names]
        self.columns = {name: i for i, name in enumerate(self.header)}

    def reject(self, why: str, line: int | None = None) -> RecordingError:
        """The error that says so of this file."""
        return RecordingError(f'{self.path}{"" if line is None else f":{line}"}: {why}')

    def require(self, names: Collection[str], form: str, known: Collection[str] = ()) -> None:
        """Raise RecordingError if one of ``names`` is missing, or one of them or of ``known`` is there twice.

        ``form``: what the table is and which columns it has, for the message.
        """
        lacking = [name for name in names if name not in self.columns]
        if lacking:
            raise self.reject_header(lacking, form, (*names, *known))
        for name in (*names, *known):
            if self.header.count(name) > 1:
                raise self.reject(f'column {name} is there twice', self.header_line)

    def reject_header(self, lacking: Sequence[str], form: str, known: Collection[str]) -> RecordingError:
        """The error for a header without the columns ``lacking``: what it has, what was meant, how it is converted."""
        why = what_of_header(self.path, head_of(self.path), self.header, lacking, form, known)
        return self.reject(why, self.header_line)

    def table_rows(self) -> Iterator[Row]:
        """The rows behind the header that are not blank. Raises RecordingError for one of another width than it has."""
        width = len(self.header)
        for line, cells in self._cells(0, 0):
            if len(cells) != width:
                raise self.reject_width(len(cells), line)
            yield Row(self, line, cells)

    def reject_width(self, cells: int, line: int) -> RecordingError:
        """The error for a row of another number of cells."""
        commas = '; are its decimals written with a comma? Save it with points' if cells == 2 * len(self.header) else ''
        return self.reject(f'has {cells} cells, the header has {len(self.header)}{commas}', line)

    def _cells(self, begin: int | None, line: int) -> Iterator[tuple[int, list[str]]]:
        """(line number, cells) of every line that is not blank, from byte ``begin`` on, behind line number ``line``.

        ``begin`` None: with the header; 0: behind the header, wherever it ends.
        """
        lines = self._lines(begin or 0, line)
        reader = csv.reader(lines, strict=True, skipinitialspace=True)
        skip = begin == 0
        try:
            for cells in reader:
                if len(cells) > 1 or (cells and cells[0].strip()):
                    if skip:
                        skip = False
                        continue
                    yield line + reader.line_num, cells
        except csv.Error as error:
            raise self.reject(f'is no row of a CSV ({error})', line + reader.line_num) from None

    def _lines(self, begin: int, line: int) -> Iterator[str]:
        try:
            with self._opened(begin) as stream:
                while text := stream.readline(MAX_LINE + 1):
                    line += 1
                    if len(text) > MAX_LINE:
                        raise self.reject(f'is longer than {MAX_LINE} characters', line)
                    if '\0' in text:
                        raise self._reject_text()
                    yield text
        except OSError as error:
            raise self.reject(f'cannot be read ({error.strerror or error})') from None
        except UnicodeDecodeError:
            raise self._reject_text() from None

    def _reject_text(self) -> RecordingError:
        with self.path.open('rb') as stream:
            line, why = text_fault(self.path, stream)
        return self.reject(why, line)

    def _opened(self, begin: int) -> TextIO:
        stream = self.path.open(encoding='utf-8' if begin else 'utf-8-sig', newline=None)
        if begin:
            stream.seek(begin)
        return stream
