# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads CSV recordings, one sample per row, header first, also from other loggers, in passes and never whole."""

import math
import re
from collections.abc import Collection, Iterator, Sequence
from decimal import Decimal
from functools import cached_property
from operator import lt
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from msg_adapters import LOAD, REFERENCE, SAMPLES, TEMPERATURE
from psd_deflection.base.csv_table import MAX_LINE, CsvTable
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.foreign_tables import why_beyond, why_falling, why_no_number, why_rate
from psd_deflection.base.text import NUMBER
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.read.mcap_reader import RawMessage
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.sample_table import LOAD_COLUMNS, REFERENCE_COLUMNS, TEMPERATURE_COLUMN
from psd_deflection.records import (
    MOST_PSDS,
    AppliedLoad,
    FloatArray,
    RawChunk,
    ReferencePose,
    TemperatureReading,
    channel_names,
)

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
    """The rows of one file with a column ``t``.

    Times are read as decimals into integer nanoseconds, never through a float: a float cannot hold
    nanoseconds since the epoch. The file is read in passes and never held whole in memory.
    """

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


REQUIRED = ('t', *channel_names(2))
KNOWN = ('t', *channel_names(MOST_PSDS), *LOAD_COLUMNS, TEMPERATURE_COLUMN, *REFERENCE_COLUMNS)

MAX_VOLTS = 1e6

_RATE_ROWS = 10_000


class CsvRecording(Recording):
    """An opened CSV. ``sample_rate_hz``: if known; otherwise computed from the rows' times.

    ``part``: it may lack some PSDs, which another logger recorded. ``channels``: those that it has, of PSD after PSD.
    Raises RecordingError naming file, line and column of a fault.
    """

    temperatures_held = True

    def __init__(
        self, path: Path, block_size: int | None = None, sample_rate_hz: float | None = None, *, part: bool = False
    ) -> None:
        super().__init__(path, block_size)
        self._warnings: list[str] = []
        self._source = SampleRows(self.path)
        self._reject = self._source.reject
        self.channels = tuple(c for c in channel_names(MOST_PSDS) if c in self._source.columns)
        self._columns = self._read_header(part)
        self.psds = len(self.channels) // 3
        self._step_ns = 1e9 / sample_rate_hz if sample_rate_hz else self._find_step()
        self.sample_rate_hz = 1e9 / self._step_ns

    @property
    def complete(self) -> bool:
        """True: a CSV has no mark of its end."""
        return True

    @property
    def warnings(self) -> Sequence[str]:
        """Columns that are not read."""
        return self._warnings

    def _read_header(self, part: bool) -> dict[str, int]:
        names, number, columns = self._source.header, self._source.header_line, self._source.columns
        form, required = f'a recording begins with {",".join(REQUIRED)}', REQUIRED
        if part:
            first = int(self.channels[0][-1]) if self.channels else 1
            required = ('t', *channel_names(first)[-3:])
            form = "one logger's part of a recording begins with t and x, y and sum of a PSD"
        elif 't' in columns and self.channels:
            form += '; `psd-deflection convert FIRST.csv SECOND.csv --out OUT` joins the parts of two loggers'
        elif 'mass' in columns or LOAD_COLUMNS[0] in columns:
            form += '; discover and info take a table of readings without times'
        self._source.require(required, form, [name for name in KNOWN if name not in required])
        self._reject_parts(columns, number)
        if not part:
            self._reject_gap(number)
        unknown = [n for n in names if n not in KNOWN]
        if unknown:
            self._warnings.append(f'{self.path}:{number}: columns that are not read: {", ".join(unknown)}')
        return columns

    def _reject_parts(self, columns: Collection[str], number: int) -> None:
        """Reject a header with a part of a group."""
        psds = (channel_names(n)[-3:] for n in range(1, MOST_PSDS + 1))
        for group in (LOAD_COLUMNS, REFERENCE_COLUMNS, *psds):
            there = [n for n in group if n in columns]
            if there and len(there) < len(group):
                lacking = ', '.join(n for n in group if n not in columns)
                raise self._reject(f'has {", ".join(there)} without {lacking}', number)

    def _reject_gap(self, number: int) -> None:
        """Reject a header that lacks a PSD before the last."""
        lacking = [name for name in channel_names(int(self.channels[-1][-1])) if name not in self.channels]
        if lacking:
            raise self._reject(f'has {", ".join(self.channels[6:])} without {", ".join(lacking)}', number)

    def _number(self, cells: list[str], name: str, line: int, largest: float = math.inf) -> float:
        cell = cells[self._columns[name]].strip()
        if NUMBER.fullmatch(cell) is None:
            raise self._reject(f'column {name} holds {cell!r}, which is not a number{why_no_number(name, cell)}', line)
        value = float(cell)
        if not math.isfinite(value):
            raise self._reject(f'column {name} holds {cell!r}, which is not finite', line)
        if abs(value) > largest:
            raise self._reject(f'column {name} holds {cell!r}, which is beyond ±{largest:g}', line)
        return value

    def _find_step(self) -> float:
        """Time between samples, ns: the mean of the steps that differ from the median by less than half.

        So neither gaps nor rounded times affect it.
        """
        times: list[int] = []
        for rows in self._source.rows():
            times += rows.t_ns
            if len(times) >= _RATE_ROWS:
                break
        del times[_RATE_ROWS:]
        if len(times) < 2:
            raise self._reject(f'holds {len(times)} samples; a recording has at least 2')
        steps = np.diff(np.array(times, dtype=np.int64)).astype(np.float64)
        median = float(np.median(steps))
        typical = steps[(steps > 0.5 * median) & (steps < 1.5 * median)]
        # If the steps differ very much, the median may be close to none of them.
        step = float(typical.mean()) if len(typical) else float(steps.min())
        if why := why_rate(self.path, self._columns['t'], 1e9 / step, times[0] / 1e9):
            raise self._reject(why)
        return step

    def _chunks(self) -> Iterator[RawChunk]:
        """The samples; the first has seq 0.

        A row's number is that of the row before plus the whole number of steps between them. The
        remainder is carried to the next row and decays slowly, so that neither jitter of less than
        half a step nor a clock that runs slightly fast looks like a loss.
        """
        seq = 0
        left_over = 0.0
        last_t: int | None = None
        for rows in self._source.rows():
            seqs: list[int] = []
            for t_ns in rows.t_ns:
                if last_t is not None:
                    passed = (t_ns - last_t) / self._step_ns + left_over
                    steps = max(1, round(passed))
                    left_over = 0.9 * (passed - steps)
                    seq += steps
                last_t = t_ns
                seqs.append(seq)
            yield from self._chunk(rows, seqs)

    def _chunk(self, rows: CsvRows, seqs: list[int]) -> Iterator[RawChunk]:
        """One chunk of ``rows``. Before it raises RecordingError, one of those before the bad row."""
        width, channels = len(self._source.header), len(self.channels)
        volts = _floats([rows.cells[self._columns[c] :: width] for c in self.channels])
        bad: RecordingError | None = None
        if not (np.abs(volts) <= MAX_VOLTS).all():
            good: list[list[float]] = []
            try:
                for i, line in enumerate(rows.lines):
                    row = rows.cells[i * width : (i + 1) * width]
                    good.append([self._number(row, c, line, MAX_VOLTS) for c in self.channels])
            except RecordingError as error:
                bad = error
            volts = np.array(good, dtype=np.float64).reshape(-1, channels)
        if count := len(volts):
            yield RawChunk(
                np.array(seqs[:count], dtype=np.int64),
                np.array(rows.t_ns[:count], dtype=np.int64),
                volts.astype(np.float32, order='C'),
                np.zeros(count, dtype=np.uint8),
            )
        if bad is not None:
            raise bad

    def topics(self) -> dict[str, int]:
        """Number of messages by topic, as in a bag of the same samples."""
        counts = {SAMPLES: sum(1 for _ in self.blocks())}
        for topic, rows in ((LOAD, self.loads()), (REFERENCE, self.references()), (TEMPERATURE, self.temperatures())):
            if rows:
                counts[topic] = len(rows)
        return counts

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """None: a CSV has rows."""
        return iter(())

    def _optional(self, names: Sequence[str]) -> Iterator[tuple[int, tuple[float, ...]]]:
        """(t_ns, values) of each row that has values in these columns."""
        if names[0] not in self._columns:
            return
        width = len(self._source.header)
        before: list[str] = []
        values: tuple[float, ...] = ()
        for rows in self._source.rows():
            columns = [rows.cells[self._columns[n] :: width] for n in names]
            for i, (t_ns, *cells) in enumerate(zip(rows.t_ns, *columns, strict=True)):
                # Most rows repeat the load and the temperature of the row before.
                if cells != before:
                    values = self._values(rows.cells[i * width : (i + 1) * width], names, rows.lines[i])
                    before = cells
                if values:
                    yield t_ns, values

    def _values(self, cells: list[str], names: Sequence[str], line: int) -> tuple[float, ...]:
        """The numbers of a row in these columns; none if all are empty."""
        filled = [n for n in names if cells[self._columns[n]].strip()]
        if filled and len(filled) < len(names):
            raise self._reject(f'has {", ".join(filled)} without the others of {", ".join(names)}', line)
        return tuple(self._number(cells, n, line) for n in filled)

    @cached_property
    def _loads(self) -> tuple[list[AppliedLoad], int, int]:
        """The loads that differ from the one before; number of rows with a load; time of the last, ns."""
        loads: list[AppliedLoad] = []
        message: tuple[float, ...] | None = None
        count = last = 0
        for t_ns, values in self._optional(LOAD_COLUMNS):
            if values != message:
                loads.append(AppliedLoad(t_ns, *values))
                message = values
            count, last = count + 1, t_ns
        return loads, count, last

    def loads(self) -> list[AppliedLoad]:
        """The first load and each load that differs from the one before it."""
        return list(self._loads[0])

    def rows_with_load(self) -> tuple[int, int]:
        """Number of rows that say their load, and the time of the last one, ns; (0, 0) if none does."""
        return self._loads[1:]

    def references(self) -> list[ReferencePose]:
        """One reference for each row that has one."""
        return [ReferencePose(t_ns, dx, dy, theta) for t_ns, (dx, dy, theta) in self._optional(REFERENCE_COLUMNS)]

    def temperatures(self) -> list[TemperatureReading]:
        """The first temperature and each that differs from the one before it."""
        out: list[TemperatureReading] = []
        for t_ns, (celsius,) in self._optional((TEMPERATURE_COLUMN,)):
            if not out or out[-1].celsius != celsius:
                out.append(TemperatureReading(t_ns, celsius))
        return out

    def estimates(self) -> dict[str, EstimateSeries]:
        """None: a CSV of samples has no estimates."""
        return {}


def _floats(columns: list[list[str]]) -> FloatArray:
    """The numbers of ``columns`` (n, columns); one NaN if a cell is none of those that :data:`NUMBER` takes."""
    # Python takes `1_000` and digits of every script; in a recording they are typing errors.
    for cells in columns:
        together = ''.join(cells)
        if '_' in together or not together.isascii():
            return np.array([[np.nan]])
    try:
        return np.stack([np.fromiter(map(float, cells), np.float64, len(cells)) for cells in columns], axis=1)
    except ValueError:
        return np.array([[np.nan]])
