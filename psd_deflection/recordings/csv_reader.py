"""Reads CSV recordings: one sample per row, header first, also from other loggers.

Times are read as decimals into integer nanoseconds, never through a float: a float cannot hold
nanoseconds since the epoch. The file is read in passes and never held whole in memory.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Collection, Iterator, Sequence
from decimal import Decimal
from functools import cached_property
from itertools import chain
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msg_adapters import LOAD, REFERENCE, SAMPLES, TEMPERATURE
from psd_deflection.errors import RecordingError
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.mcap_reader import RawMessage
from psd_deflection.recordings.recording import LOAD_COLUMNS, REFERENCE_COLUMNS, TEMPERATURE_COLUMN, Recording
from psd_deflection.records import (
    MOST_PSDS,
    AppliedLoad,
    FloatArray,
    RawChunk,
    ReferencePose,
    TemperatureReading,
    channel_names,
)

REQUIRED = ('t', *channel_names(2))
KNOWN = ('t', *channel_names(MOST_PSDS), *LOAD_COLUMNS, TEMPERATURE_COLUMN, *REFERENCE_COLUMNS)

MAX_LINE = 10_000
"""Maximum characters of a line; a longer line is not a row of samples."""

MAX_SECONDS = 2**31
"""A ROS stamp has 31 bits of seconds."""

MAX_VOLTS = 1e6

_NUMBER = re.compile(
    r'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,4})?|[+-]?(?:nan|inf|infinity)', re.ASCII | re.IGNORECASE
)

_SECONDS = re.compile(r'(1?[0-9]{1,9})\.([0-9]{1,9})', re.ASCII)
"""Seconds that are below the bound and whole nanoseconds, as most loggers write them."""

_RATE_ROWS = 10_000

_BATCH = 500
"""Number of rows that are converted at once: numpy's cost is per call."""


class _Row(NamedTuple):
    line: int
    t_ns: int
    cells: list[str]


_CELLS = attrgetter('cells')


class CsvRecording(Recording):
    """An opened CSV. ``sample_rate_hz``: if known; otherwise computed from the rows' times.

    Raises RecordingError naming file, line and column of a fault.
    """

    def __init__(self, path: Path, block_size: int | None = None, sample_rate_hz: float | None = None) -> None:
        super().__init__(path, block_size)
        self._warnings: list[str] = []
        self._header, self._columns = self._read_header()
        self._channels = channel_names(self.psds)
        self._take = itemgetter(*(self._columns[c] for c in self._channels))
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

    def _refuse(self, why: str, line: int | None = None) -> RecordingError:
        return RecordingError(f'{self.path}{"" if line is None else f":{line}"}: {why}')

    def _lines(self) -> Iterator[str]:
        try:
            with self.path.open(encoding='utf-8-sig', newline=None) as stream:
                number = 0
                while text := stream.readline(MAX_LINE + 1):
                    number += 1
                    if len(text) > MAX_LINE:
                        raise self._refuse(f'is longer than {MAX_LINE} characters', number)
                    yield text
        except OSError as error:
            raise self._refuse(f'cannot be read ({error.strerror or error})') from None
        except UnicodeDecodeError:
            raise self._refuse('is not text in UTF-8') from None

    def _cells(self) -> Iterator[tuple[int, list[str]]]:
        """(line number, cells) of every line that is not blank."""
        reader = csv.reader(self._lines(), strict=True, skipinitialspace=True)
        try:
            for cells in reader:
                if len(cells) > 1 or (cells and cells[0].strip()):
                    yield reader.line_num, cells
        except csv.Error as error:
            raise self._refuse(f'is no row of a CSV ({error})', reader.line_num) from None

    def _read_header(self) -> tuple[list[str], dict[str, int]]:
        for number, cells in self._cells():
            names = [n.strip() for n in cells]
            columns = {name: i for i, name in enumerate(names)}
            missing = [n for n in REQUIRED if n not in columns]
            if missing:
                hint = ', between commas' if len(names) == 1 else ''
                if 't' in missing and ('mass' in columns or LOAD_COLUMNS[0] in columns):
                    hint += '; discover and info take a table of readings without times'
                raise self._refuse(
                    f'the header lacks {", ".join(missing)}; a recording begins with {",".join(REQUIRED)}{hint}', number
                )
            for name in KNOWN:
                if names.count(name) > 1:
                    raise self._refuse(f'column {name} is there twice', number)
            for group in (LOAD_COLUMNS, REFERENCE_COLUMNS):
                there = [n for n in group if n in columns]
                if there and len(there) < len(group):
                    lacking = ', '.join(n for n in group if n not in columns)
                    raise self._refuse(f'has {", ".join(there)} without {lacking}', number)
            self.psds = self._count_psds(columns, number)
            unknown = [n for n in names if n not in KNOWN]
            if unknown:
                self._warnings.append(f'{self.path}:{number}: columns that are not read: {", ".join(unknown)}')
            return names, columns
        raise self._refuse('is empty')

    def _count_psds(self, columns: Collection[str], line: int) -> int:
        """PSDs of which there are columns, 2 or more; none may be left out, and none in part."""
        further = [name for name in channel_names(MOST_PSDS)[6:] if name in columns]
        psds = int(further[-1].lstrip('xysum')) if further else 2
        lacking = [name for name in channel_names(psds) if name not in columns]
        if lacking:
            raise self._refuse(f'has {", ".join(further)} without {", ".join(lacking)}', line)
        return psds

    def _rows(self) -> Iterator[_Row]:
        at = self._columns['t']
        width = len(self._header)
        rows = self._cells()
        next(rows, None)
        last = -1
        for number, cells in rows:
            if len(cells) != width:
                raise self._refuse(f'has {len(cells)} cells, the header has {width}', number)
            t_ns = self._nanoseconds(cells[at], number)
            if t_ns <= last:
                raise self._refuse(f'column t holds {cells[at].strip()!r}, which is not after the row before', number)
            last = t_ns
            yield _Row(number, t_ns, cells)

    def _nanoseconds(self, cell: str, line: int) -> int:
        text = cell.strip()
        plain = _SECONDS.fullmatch(text)
        if plain is not None:
            return int(plain[1] + plain[2].ljust(9, '0'))
        if _NUMBER.fullmatch(text) is None:
            raise self._refuse(f'column t holds {text!r}, which is not a number', line)
        seconds = Decimal(text)
        finite = seconds.is_finite() and 0 <= seconds < MAX_SECONDS
        t_ns = int((seconds * 1_000_000_000).to_integral_value()) if finite else -1
        if not 0 <= t_ns < MAX_SECONDS * 1_000_000_000:
            raise self._refuse(f'column t holds {text!r}; seconds from 0 to {MAX_SECONDS} are read', line)
        return t_ns

    def _number(self, row: _Row, name: str, largest: float = math.inf) -> float:
        cell = row.cells[self._columns[name]].strip()
        if _NUMBER.fullmatch(cell) is None:
            raise self._refuse(f'column {name} holds {cell!r}, which is not a number', row.line)
        value = float(cell)
        if not math.isfinite(value):
            raise self._refuse(f'column {name} holds {cell!r}, which is not finite', row.line)
        if abs(value) > largest:
            raise self._refuse(f'column {name} holds {cell!r}, which is beyond +-{largest:g}', row.line)
        return value

    def _find_step(self) -> float:
        """Time between samples, ns: the mean of the steps that differ from the median by less than half.

        So neither gaps nor rounded times affect it.
        """
        times = []
        for row in self._rows():
            times.append(row.t_ns)
            if len(times) == _RATE_ROWS:
                break
        if len(times) < 2:
            raise self._refuse(f'holds {len(times)} samples; a recording has at least 2')
        steps = np.diff(np.array(times, dtype=np.int64)).astype(np.float64)
        median = float(np.median(steps))
        near = steps[(steps > 0.5 * median) & (steps < 1.5 * median)]
        # If the steps differ very much, the median may be close to none of them.
        return float(near.mean()) if len(near) else float(steps.min())

    def _chunks(self) -> Iterator[RawChunk]:
        """The samples; the first has seq 0.

        A row's number is that of the row before plus the whole number of steps between them. The
        remainder is carried to the next row and decays slowly, so that neither jitter of less than half a
        step nor a clock that runs slightly fast looks like a loss.
        """
        rows: list[_Row] = []
        seqs: list[int] = []
        seq = 0
        left_over = 0.0
        last_t: int | None = None
        try:
            for row in self._rows():
                if last_t is not None:
                    passed = (row.t_ns - last_t) / self._step_ns + left_over
                    steps = max(1, round(passed))
                    left_over = 0.9 * (passed - steps)
                    seq += steps
                last_t = row.t_ns
                rows.append(row)
                seqs.append(seq)
                if len(rows) == _BATCH:
                    full, numbers = rows, seqs
                    rows, seqs = [], []
                    yield from self._chunk(full, numbers)
        except RecordingError:
            # Rows before the bad one are good.
            if rows:
                yield from self._chunk(rows, seqs)
            raise
        if rows:
            yield from self._chunk(rows, seqs)

    def _chunk(self, rows: list[_Row], seqs: list[int]) -> Iterator[RawChunk]:
        """One chunk of ``rows``. Before it raises RecordingError, one of those before the bad row."""
        cells = list(chain.from_iterable(map(self._take, map(_CELLS, rows))))
        volts = _floats(cells)
        bad: RecordingError | None = None
        if not (np.abs(volts) <= MAX_VOLTS).all():
            good: list[list[float]] = []
            try:
                for row in rows:
                    good.append([self._number(row, c, MAX_VOLTS) for c in self._channels])
            except RecordingError as error:
                bad = error
            volts = np.array(good, dtype=np.float64)
        count = volts.size // len(self._channels)
        if count:
            yield RawChunk(
                np.array(seqs[:count], dtype=np.int64),
                np.array([row.t_ns for row in rows[:count]], dtype=np.int64),
                volts.astype(np.float32).reshape(count, -1),
                np.zeros(count, dtype=np.uint8),
            )
        if bad is not None:
            raise bad

    def topics(self) -> dict[str, int]:
        """Number of messages by topic, as in a bag of the same samples."""
        counts = {SAMPLES: sum(1 for _ in self.blocks())}
        for topic, found in ((LOAD, self.loads()), (REFERENCE, self.references()), (TEMPERATURE, self.temperatures())):
            if found:
                counts[topic] = len(found)
        return counts

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """None: a CSV has rows."""
        return iter(())

    def _optional(self, names: Sequence[str]) -> Iterator[tuple[int, tuple[float, ...]]]:
        """(t_ns, values) of each row that has values in these columns."""
        if names[0] not in self._columns:
            return
        at = [self._columns[n] for n in names]
        before: list[str] = []
        values: tuple[float, ...] = ()
        for row in self._rows():
            cells = [row.cells[i] for i in at]
            # Most rows repeat the load and the temperature of the row before.
            if cells != before:
                values = self._values(row, names)
                before = cells
            if values:
                yield row.t_ns, values

    def _values(self, row: _Row, names: Sequence[str]) -> tuple[float, ...]:
        """The numbers in these columns; none if all are empty."""
        filled = [n for n in names if row.cells[self._columns[n]].strip()]
        if filled and len(filled) < len(names):
            raise self._refuse(f'has {", ".join(filled)} without the others of {", ".join(names)}', row.line)
        return tuple(self._number(row, n) for n in filled)

    @cached_property
    def _loads(self) -> tuple[list[AppliedLoad], int, int]:
        """The loads that differ from the one before; number of rows with a load; time of the last, ns."""
        loads: list[AppliedLoad] = []
        said: tuple[float, ...] | None = None
        count = last = 0
        for t_ns, values in self._optional(LOAD_COLUMNS):
            if values != said:
                loads.append(AppliedLoad(t_ns, *values))
                said = values
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


def _floats(cells: list[str]) -> FloatArray:
    """The numbers of ``cells``; one NaN if a cell is none of those that :data:`_NUMBER` takes."""
    together = ''.join(cells)
    # Python takes `1_000` and digits of every script; in a recording they are typing errors.
    if '_' in together or not together.isascii():
        return np.array([np.nan])
    try:
        return np.array(list(map(float, cells)))
    except ValueError:
        return np.array([np.nan])
