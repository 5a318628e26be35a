# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rows of a CSV file with a header and a column ``t``: many at once if they are plain, one by one if they are not.

Times are read as decimals into integer nanoseconds, never through a float: a float cannot hold
nanoseconds since the epoch. The file is read in passes and never held whole in memory.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from decimal import Decimal
from operator import lt
from typing import BinaryIO, NamedTuple

from psd_deflection.base.csv_table import MAX_LINE, CsvTable
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.foreign_tables import why_beyond, why_falling, why_no_number
from psd_deflection.base.numbers import NUMBER

MAX_SECONDS = 2**31
"""A ROS stamp has 31 bits of seconds."""

_SECONDS = re.compile(r'(1?[0-9]{1,9})\.([0-9]{1,9})', re.ASCII)
"""Seconds that are below the bound and whole nanoseconds, as most loggers write them."""

_ALL_SECONDS = re.compile(r'(?:1?[0-9]{1,9}\.[0-9]{1,9}\n)+', re.ASCII)

_PLAIN = b'0123456789.,+-eE\n'
"""Bytes of lines that need no reader of CSV: no quotes, no spaces, nothing but numbers and commas."""

_PIECE = 1 << 16
"""Bytes that are read at once."""

_TOGETHER = 500
"""Number of rows that are handed on at once: numpy's cost is per call."""


class CsvRows(NamedTuple):
    """Rows that follow each other: number of the line and time, ns, of each; ``cells``: those of all rows in turn."""

    lines: Sequence[int]
    t_ns: Sequence[int]
    cells: list[str]


class SampleRows(CsvTable):
    """The rows of one file with a column ``t``."""

    def rows(self) -> Iterator[CsvRows]:
        """All rows behind the header, which has a column ``t``; before an error, those before the bad row."""
        last, line = -1, 0
        try:
            with self.path.open('rb') as stream:
                begin = self._after_header(stream)
                if begin:
                    line, at = self.header_line, begin
                    for size, rows in self._plain(stream):
                        if rows.t_ns[0] <= last:
                            break
                        yield rows._replace(lines=range(line + 1, line + 1 + len(rows.t_ns)))
                        last = rows.t_ns[-1]
                        line, at = line + len(rows.t_ns), at + size
                    stream.seek(at)
                    if not stream.read(1):
                        return
                    begin = at
        except OSError as error:
            raise self.reject(f'cannot be read ({error.strerror or error})') from None
        yield from self._any(begin, line, last)

    def _after_header(self, stream: BinaryIO) -> int:
        """Bytes of the header if it is the first line and ends with a newline, else 0; ``stream`` is there then."""
        first = stream.readline(MAX_LINE + 1)
        if self.header_line != 1 or not first.endswith(b'\n') or b'\r' in first.removesuffix(b'\r\n'):
            return 0
        return len(first)

    def _plain(self, stream: BinaryIO) -> Iterator[tuple[int, CsvRows]]:
        """Plain rows with rising times from where ``stream`` is, with their size in bytes, up to the first that is not.

        The numbers of their lines are left out.
        """
        width, at = len(self.header), self.header.index('t')
        rest = b''
        while data := stream.read(_PIECE):
            data = rest + data
            cut = data.rfind(b'\n') + 1
            piece, rest = data[:cut], data[cut:]
            text = piece.replace(b'\r\n', b'\n') if b'\r' in piece else piece
            if len(rest) > MAX_LINE or text.translate(None, _PLAIN):
                return
            if not text:
                continue
            lines = text.decode('ascii').split('\n')
            lines.pop()
            if {line.count(',') for line in lines} != {width - 1} or max(map(len, lines)) > MAX_LINE:
                return
            cells = ','.join(lines).split(',')
            t_ns = self._many_nanoseconds(cells[at::width])
            if t_ns is None or not all(map(lt, t_ns, t_ns[1:])):
                return
            yield len(piece), CsvRows((), t_ns, cells)

    def _many_nanoseconds(self, cells: list[str]) -> list[int] | None:
        """Times in ns; None if one is not written as seconds with up to nine decimals."""
        together = '\n'.join(cells) + '\n'
        if _ALL_SECONDS.fullmatch(together) is None:
            return None
        decimals = len(cells[0].partition('.')[2])
        if {cell[-1 - decimals : -decimals] for cell in cells} == {'.'}:
            digits = together.replace('.', '').split('\n')
            digits.pop()
            scale = 10 ** (9 - decimals)
            return [scale * t for t in map(int, digits)]
        return [self._nanoseconds(cell, 0) for cell in cells]

    def _any(self, begin: int, line: int, last: int) -> Iterator[CsvRows]:
        """The rows from byte ``begin`` on, behind line number ``line`` and time ``last``, ns."""
        width, at = len(self.header), self.header.index('t')
        lines: list[int] = []
        times: list[int] = []
        together: list[str] = []
        try:
            for number, cells in self._cells(begin, line):
                if len(cells) != width:
                    raise self.reject_width(len(cells), number)
                t_ns = self._nanoseconds(cells[at], number, last)
                if t_ns <= last:
                    raise self._reject_falling(last, cells, number)
                last = t_ns
                lines.append(number)
                times.append(t_ns)
                together += cells
                if len(lines) == _TOGETHER:
                    full = CsvRows(lines, times, together)
                    lines, times, together = [], [], []
                    yield full
        except RecordingError:
            # Rows before the bad one are good.
            if lines:
                yield CsvRows(lines, times, together)
            raise
        if lines:
            yield CsvRows(lines, times, together)

    def _reject_falling(self, last: int, cells: Sequence[str], line: int) -> RecordingError:
        cell = cells[self.columns['t']].strip()
        why = why_falling(self.path, self.columns['t'], line, last / 1e9, float(cell))
        if not why and any(not cells[self.columns[n]].strip() for n in self.header if n == 'sum1'):
            why = ': cells are empty; did the program that wrote it split one sample into two rows?'
        return self.reject(f'column t holds {cell!r}, which is not after the row before{why}', line)

    def _nanoseconds(self, cell: str, line: int, last: int = -1) -> int:
        """The time of a cell, ns; ``last``: that of the row before, for the message."""
        text = cell.strip()
        plain = _SECONDS.fullmatch(text)
        if plain is not None:
            return int(plain[1] + plain[2].ljust(9, '0'))
        if NUMBER.fullmatch(text) is None:
            raise self.reject(f'column t holds {text!r}, which is not a number{why_no_number("t", text)}', line)
        seconds = Decimal(text)
        finite = seconds.is_finite() and 0 <= seconds < MAX_SECONDS
        t_ns = int((seconds * 1_000_000_000).to_integral_value()) if finite else -1
        if not 0 <= t_ns < MAX_SECONDS * 1_000_000_000:
            why = ''
            at = self.columns['t']
            if seconds.is_finite() and seconds < 0 <= last:
                why = why_falling(self.path, at, line, last / 1e9, float(seconds))
            elif seconds.is_finite():
                why = why_beyond(self.path, at, float(seconds))
            raise self.reject(f'column t holds {text!r}; seconds from 0 to {MAX_SECONDS} are read{why}', line)
        return t_ns
