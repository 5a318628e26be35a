# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads a table of readings: a CSV with one row for each load that was hung on the link (docs/recording.md).

It has no column ``t``, by which it is distinguished from a recording; or it has one, and references in place of
samples.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from psd_deflection.base.csv_table import CsvTable
from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.sample_table import LOAD_COLUMNS, REFERENCE_COLUMNS, TEMPERATURE_COLUMN
from psd_deflection.records import MOST_PSDS, FloatArray, dot_names

GRAVITY = 9.80665
"""m/s^2, standard."""
MASS, ARM = 'mass', 'arm'
TIMES = 't'
IN_MILLIMETRES = '_mm'
ESTIMATES = ('dx', 'dy', 'theta')


def _of_dots(psds: int) -> tuple[tuple[str, ...], ...]:
    volts = dot_names(psds)
    return volts, tuple(f'{name}{IN_MILLIMETRES}' for name in volts)


def kinds_of(names: Collection[str]) -> Mapping[tuple[str, ...], str]:
    """The columns of each kind of readings, those of the dots of as many PSDs as ``names`` have."""
    there = [n for n in range(3, MOST_PSDS + 1) if {*_of_dots(n)[0][-2:], *_of_dots(n)[1][-2:]} & set(names)]
    volts, millimetres = _of_dots(max(there, default=2))
    return {volts: 'dots', millimetres: 'dots', ESTIMATES: 'estimates', REFERENCE_COLUMNS: 'poses'}


_READ = (name for group in (*_of_dots(MOST_PSDS), ESTIMATES, REFERENCE_COLUMNS) for name in group)
KNOWN = frozenset((TIMES, *LOAD_COLUMNS, MASS, ARM, TEMPERATURE_COLUMN, *_READ))
MAX_BYTES = 10_000_000
FORM = (
    'a table of readings has load_fx,load_fy,load_tz (N, N, N m) or mass (kg), and one of x1,y1,x2,y2 (V), '
    'x1_mm,y1_mm,x2_mm,y2_mm (of more PSDs also x3,y3 ...), dx,dy,theta (m, m, rad) and ref_dx,ref_dy,ref_theta'
)


def is_table(source: Recording | str | Path) -> bool:
    """Whether ``source`` is a CSV that says loads, and no times or references alone. What cannot be read is none."""
    if isinstance(source, Recording):
        return False
    path = Path(source)
    if path.suffix.lower() != '.csv' or not path.is_file():
        return False
    try:
        names = CsvTable(path).header
    except RecordingError:
        return False
    alone = TIMES not in names or ('x1' not in names and bool(set(REFERENCE_COLUMNS) & set(names)))
    return alone and (MASS in names or bool(set(LOAD_COLUMNS) & set(names)))


class ReadingsTable:
    """The cells of one file by column. Raises RecordingError naming file and line if it is none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            large = path.stat().st_size > MAX_BYTES
        except OSError as error:
            raise RecordingError(f'{path}: cannot be read ({error.strerror or error})') from None
        if large:
            raise RecordingError(f'{path}: is larger than {MAX_BYTES // 1_000_000} MB: no table of readings')
        self._table = CsvTable(path)
        self.names, self.head = self._table.header, self._table.header_line
        self._table.require((), FORM, KNOWN)
        self.rows = list(self._table.table_rows())
        if not self.rows:
            raise self._table.reject('holds no row of readings')

    def reject(self, line: int, why: str) -> RecordingError:
        """The error for a line."""
        return self._table.reject(why, line)

    def column(self, name: str, *, empty: bool = False) -> FloatArray:
        """The numbers of a column; ``empty``: a cell without one is NaN, else an error."""
        return np.array([math.nan if empty and not row.text(name) else row.number(name) for row in self.rows])

    def columns(self, names: Sequence[str], *, empty: bool = False) -> FloatArray:
        """The same of several columns (n, columns)."""
        return np.column_stack([self.column(name, empty=empty) for name in names])

    def loads(self) -> FloatArray:
        """(n, 3) N, N, N m. A mass hangs ``arm`` m beside the link, towards +X."""
        there = [n for n in LOAD_COLUMNS if n in self.names]
        if there and MASS in self.names:
            raise self.reject(self.head, f'has {MASS} and {", ".join(there)}: only one of them says the load')
        if MASS in self.names:
            weight = GRAVITY * self.column(MASS)
            arm = self.column(ARM) if ARM in self.names else np.zeros(len(weight))
            return np.column_stack((np.zeros(len(weight)), -weight, -weight * arm))
        self._table.require(LOAD_COLUMNS, FORM)
        return self.columns(LOAD_COLUMNS)

    def values(self) -> tuple[str, ...]:
        """The names of the columns that hold readings."""
        there = [group for group in kinds_of(self.names) if set(group) & set(self.names)]
        if not there:
            raise self.reject(self.head, f'the header has no readings; {FORM}')
        if TIMES in self.names and there != [REFERENCE_COLUMNS]:
            raise self.reject(self.head, f'has {TIMES}: beside times only {",".join(REFERENCE_COLUMNS)} are read')
        if len(there) > 1:
            raise self.reject(self.head, f'has {" and ".join(",".join(g) for g in there)}: leave one of them')
        lacking = [n for n in there[0] if n not in self.names]
        if lacking:
            raise self.reject(self.head, f'the header lacks {", ".join(lacking)} beside the other readings; {FORM}')
        return there[0]


def described(path: Path) -> list[tuple[str, str]]:
    """What is in a table, by name, for people: rows, loads, readings, what is missing. Raises as read_readings does."""
    table = ReadingsTable(path)
    loads, names = table.loads(), table.values()
    values = table.columns(names, empty=True)
    distinct = np.unique(loads, axis=0)
    out = [('rows', f'{len(loads)}, of {len(distinct)} different loads')]
    if TIMES in table.names:
        t = table.column(TIMES)
        out.append((TIMES, f'{t.min():g} to {t.max():g} s: discover takes what rests under each load'))
    for name, unit, column in zip(LOAD_COLUMNS, ('N', 'N', 'N m'), loads.T, strict=True):
        out.append((name, f'{column.min():g} to {column.max():g} {unit}'))
    out.append(('readings', f'{",".join(names)}; {np.count_nonzero(np.isnan(values))} of {values.size} are empty'))
    if len(distinct) == len(loads) and TIMES not in table.names:
        out.append(('lacks', 'a load that is there twice: it would show how well readings repeat'))
    if TEMPERATURE_COLUMN in table.names:
        warm = table.column(TEMPERATURE_COLUMN)
        out.append((TEMPERATURE_COLUMN, f'{warm.min():g} to {warm.max():g} °C'))
    else:
        out.append(('lacks', f'{TEMPERATURE_COLUMN}: thermal effects cannot be found'))
    return out
