# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes CSV: samples as a recording that can be read again, and estimates for a spreadsheet.

Numbers are written with enough digits to read the same number back (float32 volts, float64
poses), times with nine decimals.
"""

import contextlib
import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TextIO

from psd_deflection.base.errors import RecordingError
from psd_deflection.base.files import creating
from psd_deflection.recordings.sample_table import LOAD_COLUMNS, REFERENCE_COLUMNS, TEMPERATURE_COLUMN
from psd_deflection.records import (
    AppliedLoad,
    DeflectionEstimate,
    Record,
    ReferencePose,
    ReferenceWithCovariance,
    SampleBlock,
    TemperatureReading,
    TipLoad,
    channel_names,
)

WRENCH_COLUMNS = ('fx', 'fy', 'tz')
"""Of a row of estimates: the load at the tip that the deflection says."""


def seconds(t_ns: int) -> str:
    """``t_ns`` as seconds with nine decimals, exactly."""
    s, part = divmod(t_ns, 1_000_000_000)
    return f'{s}.{part:09d}'


class _CsvFile:
    """A CSV being written. Raises RecordingError if it exists or the disk cannot be written."""

    def __init__(self, path: str | Path, header: Sequence[str]) -> None:
        self.path = Path(path)
        self._stream: TextIO | None = None
        with creating(self.path):
            self._stream = self.path.open('x', encoding='ascii', newline='\n')
        self._write([','.join(header)])

    def _write(self, lines: Sequence[str]) -> None:
        if self._stream is None:
            raise RecordingError(f'{self.path}: the file is closed')
        try:
            self._stream.writelines(line + '\n' for line in lines)
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        stream, self._stream = self._stream, None
        with contextlib.suppress(OSError):
            if stream is not None:
                stream.close()
        raise RecordingError(f'{self.path}: cannot be written ({error.strerror or error})') from None

    def _finish(self) -> None:
        """Write the rows that are still held back."""

    def close(self) -> None:
        """Write the rest and close; a second call does nothing."""
        if self._stream is None:
            return
        self._finish()
        try:
            self._stream.close()
        except OSError as error:
            self._give_up(error)
        self._stream = None


_BESIDE: Mapping[type[Record], Sequence[str]] = {
    AppliedLoad: LOAD_COLUMNS,
    TemperatureReading: (TEMPERATURE_COLUMN,),
    ReferencePose: REFERENCE_COLUMNS,
}


class CsvSampleSink(_CsvFile):
    """Samples as a CSV recording.

    ``kinds``: the kinds of records that have columns beside the samples: AppliedLoad, ReferencePose,
    TemperatureReading. Such a record goes into the first row at or after its time and must come before
    that row's block. Loads and temperatures are held; a reference is written once. ``psds``: of a sample.
    """

    def __init__(self, path: str | Path, kinds: Collection[type[Record]] = (), psds: int = 2) -> None:
        self._waiting: dict[type[Record], deque[AppliedLoad | ReferencePose | TemperatureReading]] = {}
        self._held: dict[type[Record], str] = {}
        header = ['t', *channel_names(psds)]
        for kind, columns in _BESIDE.items():
            if kind in kinds:
                header += columns
                self._waiting[kind] = deque()
                self._held[kind] = ',' * (len(columns) - 1)
        self._empty_reference = self._held.get(ReferencePose, '')
        super().__init__(path, header)

    def put(self, record: Record) -> None:
        """Take one record; records without columns in the file are ignored."""
        if isinstance(record, SampleBlock):
            self._write([self._row(record, i) for i in range(len(record.seq))])
        elif isinstance(record, AppliedLoad | ReferencePose | TemperatureReading) and type(record) in self._waiting:
            self._waiting[type(record)].append(record)

    def _row(self, block: SampleBlock, i: int) -> str:
        t_ns = int(block.t_ns[i])
        cells = [seconds(t_ns), *map(str, block.volts[i])]
        for kind, waiting in self._waiting.items():
            while waiting and waiting[0].t_ns <= t_ns:
                self._held[kind] = ','.join(map(repr, waiting.popleft()[1:]))
            cells.append(self._held[kind])
        if self._empty_reference:
            self._held[ReferencePose] = self._empty_reference
        return ','.join(cells)


class CsvEstimateSink(_CsvFile):
    """Estimates: ``t,dx,dy,theta,sd_dx,sd_dy,sd_theta`` (s, m, m, rad), three columns a solver, ``chi_square``, and the
    load at the tip ``fx,fy,tz`` (N, N, N m), as on ``/link_tip/wrench``.

    One row for each block that some solver answered; a block without an answer has no row, and a
    solver without an answer has empty cells.
    """

    def __init__(self, path: str | Path, solvers: Collection[str]) -> None:
        self._solvers = tuple(solvers)
        self._block: list[DeflectionEstimate] = []
        self._load: TipLoad | None = None
        names = [f'{solver}_{q}' for solver in self._solvers for q in ('dx', 'dy', 'theta')]
        head = ('t', 'dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta')
        super().__init__(path, [*head, *names, 'chi_square', *WRENCH_COLUMNS])

    def put(self, record: Record) -> None:
        """Take one record; all except estimates and their loads are ignored."""
        if isinstance(record, TipLoad) and self._block and self._block[0].t_ns == record.t_ns:
            self._load = record
        if not isinstance(record, DeflectionEstimate):
            return
        if self._block and self._block[0].block != record.block:
            self._finish()
        self._block.append(record)

    def _finish(self) -> None:
        if not self._block:
            return
        primary = next((e for e in self._block if e.primary), None)
        cells = [seconds(self._block[0].t_ns)]
        if primary is None:
            cells += [''] * 6
        else:
            deviations = [math.sqrt(v) if v >= 0.0 else math.nan for v in primary.variances]
            cells += map(repr, (*primary.pose, *deviations))
        by_solver = {e.solver: e for e in self._block}
        for solver in self._solvers:
            e = by_solver.get(solver)
            cells += ['', '', ''] if e is None else [repr(e.dx), repr(e.dy), repr(e.theta)]
        known = primary is not None and not math.isnan(primary.chi_square)
        cells.append(repr(primary.chi_square) if primary is not None and known else '')
        load = self._load
        cells += ['', '', ''] if load is None else [repr(load.fx), repr(load.fy), repr(load.tz)]
        self._block, self._load = [], None
        self._write([','.join(cells)])


class CsvReferenceFile(_CsvFile):
    """A camera's poses: ``t,dx,dy,theta,sd_dx,sd_dy,sd_theta,status`` (s, m, m, rad), a row a frame."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(path, ['t', 'dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta', 'status'])

    def put(self, t_ns: int, reference: ReferenceWithCovariance | None, status: str) -> None:
        """Write one frame: its pose, or None and the reason why there is none."""
        cells = [''] * 6
        if reference is not None:
            deviations = [math.sqrt(reference.covariance[i]) for i in (0, 4, 8)]
            cells = [repr(v) for v in (reference.dx, reference.dy, reference.theta, *deviations)]
        self._write([','.join([seconds(t_ns), *cells, status])])
