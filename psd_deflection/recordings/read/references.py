# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Independent measurements of the tip beside a recording: a table of a camera or a stage, or another recording.

The table is a CSV with a header: ``t`` (s) and ``dx,dy,theta`` (m, m, rad); ``sd_dx,sd_dy,sd_theta`` and ``status`` if
there are any. A row whose status is not ``ok`` has no measurement. ``psd-deflection camera`` writes such tables.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from psd_deflection.base.csv_table import CsvTable
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.text import sanitize
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.csv_reader import MAX_SECONDS
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import replayed
from psd_deflection.recordings.sample_table import LOAD_COLUMNS, REFERENCE_COLUMNS, TEMPERATURE_COLUMN
from psd_deflection.records import (
    MOST_PSDS,
    BlockStatus,
    DeflectionEstimate,
    FloatArray,
    IntArray,
    ReferencePose,
    SampleBlock,
    SpotMeans,
    dot_names,
)

POSE = ('dx', 'dy', 'theta')
DEVIATIONS = ('sd_dx', 'sd_dy', 'sd_theta')
MAX_ROWS = 10_000_000
LONGEST_STATUS = 80


@dataclass(frozen=True)
class References:
    """Measurements in order of time.

    ``t_ns`` int64 (k,). ``poses`` (k, 3): m, m, rad. ``sd`` (k, 3) if the instrument states them. ``rejected``: status
    of the measurements that have no answer, and how many there are of each.
    """

    t_ns: IntArray
    poses: FloatArray
    sd: FloatArray | None = None
    rejected: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class TrustedSamples:
    """All trusted samples of a recording.

    ``t_ns`` int64 (n,). ``dots`` (n, 4), m, calibrated and corrected. ``estimate_sd`` (3,): median standard deviation
    of the published estimates, m, m, rad.
    """

    t_ns: IntArray
    dots: FloatArray
    estimate_sd: FloatArray


def references_of(recording: Recording) -> References:
    """The references in the recording; raises RecordingError if it has none."""
    references = references_in(recording)
    if references is None:
        raise RecordingError(
            f'{recording.path}: holds no reference (CSV columns ref_dx, ref_dy, ref_theta, or the topic '
            f'/reference/deflection); give one with --reference FILE'
        )
    return references


def references_in(recording: Recording) -> References | None:
    """The references in the recording, with the standard deviations that came with each; None if it has none."""
    stated = recording.references_with_covariance()
    poses = recording.references() or [ReferencePose(r.t_ns, r.dx, r.dy, r.theta) for r in stated]
    if not poses:
        return None
    variances = {r.t_ns: (r.covariance[0], r.covariance[4], r.covariance[8]) for r in stated}
    variance_rows = np.array([variances.get(r.t_ns, (0.0, 0.0, 0.0)) for r in poses])
    # ROS states an unknown covariance as zeros.
    sd = np.sqrt(variance_rows) if np.all(variance_rows > 0.0) else None
    t_ns = np.array([r.t_ns for r in poses], dtype=np.int64)
    return _in_order(t_ns, np.array([r[1:] for r in poses]), sd, {})


def read_references(path: str | Path) -> References:
    """The references of a table, or of a recording. Raises RecordingError naming file, line and column of a fault."""
    path = Path(path)
    if path.suffix.lower() == '.csv' and 'x1' not in (table := CsvTable(path)).columns:
        return _of_table(table)
    return references_of(open_recording(path))


def _in_order(t_ns: IntArray, poses: FloatArray, sd: FloatArray | None, rejected: Mapping[str, int]) -> References:
    order = np.argsort(t_ns, kind='stable')
    return References(t_ns[order], poses[order], None if sd is None else sd[order], rejected)


def _of_table(table: CsvTable) -> References:
    wanted = ('t', *POSE)
    table.require(wanted, f'a table has {",".join(wanted)}', (*DEVIATIONS, 'status'))
    deviations = DEVIATIONS if all(name in table.columns for name in DEVIATIONS) else ()
    rows: list[list[float]] = []
    rejected: Counter[str] = Counter()
    for row in table.table_rows():
        if len(rows) >= MAX_ROWS:
            raise row.reject(f'has more than {MAX_ROWS} rows')
        word = row.text('status') if 'status' in table.columns else 'ok'
        if word != 'ok':
            rejected[sanitize(word, LONGEST_STATUS)] += 1
            continue
        rows.append([row.number(name, MAX_SECONDS) for name in (*wanted, *deviations)])
    if not rows:
        raise table.reject('holds no measurement with the status ok')
    values = np.array(rows)
    t_ns = np.rint(values[:, 0] * 1e9).astype(np.int64)
    return _in_order(t_ns, values[:, 1:4], values[:, 4:7] if deviations else None, dict(rejected))


def read_run(recording: Recording, pipeline: Pipeline, blocks: Iterable[SampleBlock] | None = None) -> TrustedSamples:
    """The samples of all blocks that ``pipeline``, made with the recording's block size, trusts.

    ``blocks``: the recording's, for a caller that counts them. Raises RecordingError if it trusts none.
    """
    times: list[IntArray] = []
    dots: list[FloatArray] = []
    deviations: list[FloatArray] = []
    trusted = False
    for records in replayed(recording, pipeline, blocks):
        for record in records:
            if isinstance(record, SpotMeans):
                trusted = record.status is BlockStatus.OK
            elif isinstance(record, SampleBlock) and trusted:
                times.append(record.t_ns)
                dots.append(pipeline.dots(record))
            elif isinstance(record, DeflectionEstimate) and record.primary:
                deviations.append(np.array(record.covariance).reshape(3, 3).diagonal())
    if not times:
        raise RecordingError(f'{recording.path}: no block has an estimate, so there is nothing to compare')
    return TrustedSamples(
        np.concatenate(times).astype(np.int64),
        np.concatenate(dots),
        np.sqrt(np.median(np.array(deviations), axis=0)) if deviations else np.full(3, np.nan),
    )


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
