# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Replay: a recording through the same pipeline as in the live node, block by block, for commands, monitor and
benchmarks."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from msg_adapters import DEFLECTION
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import Note
from psd_deflection.measure.averaging import SEGMENT_BLOCKS
from psd_deflection.measure.estimation import ZERO_VARIANCES
from psd_deflection.measure.pipeline import Pipeline, zero_variances
from psd_deflection.measure.watch import Alarm, Watch
from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.model.simulation.tip_load import TipLoads
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording, RecordingWindow
from psd_deflection.recordings.spans import FULL, Span
from psd_deflection.recordings.summary import THESIS_RIG
from psd_deflection.records import (
    ENVIRONMENT,
    KNOWN_LOAD,
    DeflectionEstimate,
    ParameterChange,
    Record,
    SampleBlock,
    TipLoad,
)
from psd_deflection.rig.config import Rig, load_rig, replace_values, rig_from_values
from psd_deflection.rig.declarations import BY_NAME, ZEROS

READ_BY = ('.type', '.sensitivity', '.axes')
"""Ends of the names of parameters that make dots of volts: a zero holds for one set of them."""


def rig_at_start(recording: Recording) -> Rig:
    """The rig at the start of the recording; the thesis rig if the recording holds none. Raises ConfigError."""
    return rig_from_values(recording.parameters, f'{recording.path} (recorded parameters)')


def rig_at_end(recording: Recording) -> Rig:
    """The rig with every recorded change. A zero taken during the run describes the rig from the start.

    Raises ConfigError.
    """
    rig = rig_at_start(recording)
    for change in recording.changes:
        values = {name: value for name, value in change.values if name in BY_NAME}
        if values:
            rig = replace_values(rig, values, f'{recording.path} (changed at block {change.block})')
    return rig


def zero_variances_at_end(recording: Recording, rig: Rig) -> tuple[float, ...]:
    """Variances (2P,), m^2, of the zero that was taken last; () if none was. ``rig``: its rig at the end.

    A zero with which the recording begins, or of a rig file beside it, was taken, too, and is no more exact.
    """
    variances = zero_variances(rig) if rig.zeros.any() else ()
    for change in recording.changes:
        reported = dict(change.values)
        if any(name in ZEROS for name in reported):
            variances = zero_variances(rig)
        row = reported.get(ZERO_VARIANCES)
        if isinstance(row, tuple) and len(row) == 2 * len(rig.psds):
            variances = row
    return variances


def warnings_about_rig(recording: Recording, params_file: str | None = None) -> list[str]:
    """The note that the rig of the thesis is taken, if neither ``params_file`` nor the recording gives another."""
    if recording.parameters or params_file is not None:
        return []
    holds = 'a CSV holds' if recording.path.suffix == '.csv' else 'it holds'
    return [Note(f'{recording.path}: {holds} no parameters: {THESIS_RIG}')]


def open_for_replay(
    path: str | Path, params_file: str | None = None, namespace: str | None = None, span: Span = FULL
) -> tuple[Recording, Rig]:
    """The recording, cut into the rig's blocks, and the rig: from ``params_file``, else from the recording.

    ``namespace``, ``span``: as :func:`open_recording` has them. A file without a zero gets the recorded one.

    Raises RecordingError and ConfigError.
    """
    recording = open_recording(path, namespace=namespace, span=span)
    rig = rig_at_start(recording) if params_file is None else load_rig(params_file)
    check_psds(recording, rig)
    if params_file is not None:
        rig = with_recorded_zero(recording, rig, params_file)
    if recording.block_size != rig.estimator.block_size:
        recording = recording.with_block_size(rig.estimator.block_size)
    return recording, rig


def part_of(recording: Recording, span: Span) -> RecordingWindow | None:
    """The part of ``recording`` that is meant, None if that is the whole. Raises as :meth:`Recording.crop` does."""
    return None if span == FULL else RecordingWindow(recording, *span)


def with_recorded_zero(recording: Recording, rig: Rig, name: str) -> Rig:
    """``rig`` with the zero with which ``recording`` starts, as the daemon keeps one, if ``rig`` has none of its own.

    Of other detectors the recorded one is not used. ``recording`` gets a warning of either. ``name``: of the rig.
    Raises ConfigError.
    """
    start = rig_at_start(recording)
    if rig.zeros.any() or not start.zeros.any():
        return rig
    recorded = start.values
    other = [n for n in recorded if n.endswith(READ_BY) and recorded[n] != rig.values.get(n)]
    if other:
        recording.warn(f'{recording.path}: its zero is not used: {name} has other {", ".join(other)}')
        return rig
    recording.warn(Note(f'{recording.path}: its zero is used, since {name} has none'))
    return replace_values(rig, start.zeros_by_name, str(recording.path))


def check_psds(recording: Recording, rig: Rig) -> None:
    """Raise ConfigError if ``recording`` has samples of another number of PSDs than ``rig``."""
    if recording.psds != len(rig.psds):
        raise ConfigError(
            f'{recording.path}: has samples of {recording.psds} PSDs, the rig file has {len(rig.psds)} (psd_N.center)'
        )


def replayed(
    recording: Recording,
    pipeline: Pipeline,
    blocks: Iterable[SampleBlock] | None = None,
    part: RecordingWindow | None = None,
) -> Iterator[list[Record]]:
    """The records of each step; each recorded change of parameters applies at its block.

    ``blocks``: the recording's blocks, for a caller that counts them. ``part`` of the recording: only its records, by
    the middle of their block. What comes before it is computed all the same, because the estimates of a block depend
    on the blocks before.
    """
    steps = _steps(recording, pipeline, blocks, np.iinfo(np.int64).max if part is None else part.end_ns)
    if part is None:
        yield from steps
        return
    for records in steps:
        yield [record for record in records if _is_in(part, record)]


def _steps(
    recording: Recording, pipeline: Pipeline, blocks: Iterable[SampleBlock] | None, end_ns: int
) -> Iterator[list[Record]]:
    """The records of each step, up to the first block that begins at ``end_ns`` or later."""
    beside = _BesideSamples(recording, pipeline)
    waiting: list[SampleBlock] = []
    for block in recording.blocks() if blocks is None else blocks:
        if beside.has_event(block):
            yield from _processed(pipeline, waiting)
            yield from beside.until(block)
        waiting.append(block)
        ended = block.t_ns[0] >= end_ns
        if ended or block.index % SEGMENT_BLOCKS == SEGMENT_BLOCKS - 1 or len(waiting) == SEGMENT_BLOCKS:
            yield from _processed(pipeline, waiting)
        if ended:
            # The blocks of the part are complete, as they were in the run.
            return
    yield from _processed(pipeline, waiting)
    yield list(pipeline.flush())


def _processed(pipeline: Pipeline, waiting: list[SampleBlock]) -> Iterator[list[Record]]:
    """The records of the blocks that wait, block by block; none waits any more."""
    blocks = waiting.copy()
    waiting.clear()
    records: list[Record] = []
    for record in pipeline.process_blocks(blocks):
        records.append(record)
        if isinstance(record, SampleBlock):
            yield records
            records = []
    if records:
        yield records


def _is_in(part: RecordingWindow, record: Record) -> bool:
    if isinstance(record, ParameterChange):
        # What was changed before holds in it.
        return record.t_ns < part.end_ns
    if isinstance(record, SampleBlock):
        return part.has((int(record.t_ns[0]) + int(record.t_ns[-1])) // 2)
    return part.has(record.t_ns)


class _BesideSamples:
    """What a recording holds beside its samples, for the pipeline, each at its time."""

    def __init__(self, recording: Recording, pipeline: Pipeline) -> None:
        self._recording, self._pipeline = recording, pipeline
        self._changes = list(recording.changes)
        # Our recorder notes when a temperature or a load took effect; for other recordings the stamps decide.
        changed = {name for change in self._changes for name, _ in change.values}
        warms = pipeline.needs_temperature and changed.isdisjoint(ENVIRONMENT)
        self._temperatures = recording.temperatures() if warms else []
        filtered = pipeline.motion_filter is not None
        self._loads = recording.loads() if filtered and KNOWN_LOAD not in changed else []
        self._loads.reverse()
        self._accelerations = recording.accelerations() if filtered else iter(())
        self._acceleration = next(self._accelerations, None)
        self._begun = False

    def has_event(self, block: SampleBlock) -> bool:
        """Whether something takes effect before the end of ``block``."""
        first, last = block.t_ns[0], block.t_ns[-1]
        return bool(
            not self._begun
            or (self._temperatures and self._temperatures[0].t_ns <= first)
            or (self._changes and self._changes[0].block <= block.index)
            or (self._acceleration is not None and self._acceleration[0] <= last)
            or (self._loads and self._loads[-1].t_ns <= last)
        )

    def until(self, block: SampleBlock) -> Iterator[list[Record]]:
        """The records of what takes effect before the end of ``block``."""
        if not self._begun:
            self._changes = _with_memory(self._recording, block.index, self._changes)
            self._begun = True
        while self._temperatures and self._temperatures[0].t_ns <= block.t_ns[0]:
            warmer = self._pipeline.temperature(self._temperatures.pop(0).celsius)
            if warmer is not None:
                yield [warmer]
        while self._changes and self._changes[0].block <= block.index:
            yield from self._apply(self._changes.pop(0))
        while self._acceleration is not None and self._acceleration[0] <= block.t_ns[-1]:
            # The unfinished block belongs to the time before it.
            yield list(self._pipeline.flush())
            with contextlib.suppress(ValueError):
                self._pipeline.accelerate(self._acceleration[1], self._acceleration[0])
            self._acceleration = next(self._accelerations, None)
        while self._loads and self._loads[-1].t_ns <= block.t_ns[-1]:
            self._pipeline.load(self._loads.pop())

    def _apply(self, change: ParameterChange) -> Iterator[list[Record]]:
        # The unfinished block belongs to the time before the change.
        yield list(self._pipeline.flush())
        self._pipeline.apply(change)
        for mismatch in self._pipeline.mismatches:
            self._recording.warn(f'block {change.block}: {mismatch}')
        yield [change]


def _with_memory(recording: Recording, first: int, changes: list[ParameterChange]) -> list[ParameterChange]:
    """``changes`` and, of a recording that starts in mid-run at block ``first``, what the pipeline remembered."""
    memory = recording.memory_from(first)
    if memory is not None:
        before = [change for change in changes if change.block < memory.block]
        return [*before, memory, *changes[len(before) :]]
    reported = () if recording.recorded_by_us else (*recording.memories[:1], *recording.changes[:1])
    if any(0 < change.block < first for change in reported):
        recording.warn(
            f'{recording.path}: starts in mid-run, and ends before the pipeline said what it remembers (it does every '
            '10 s): the estimates may differ from the recorded ones'
        )
    return changes


def replayed_estimates(recording: Recording, rig: Rig) -> EstimateSeries:
    """The estimates of the rig's solver, with the tip loads, from the samples of ``recording``.

    Raises RecordingError, ConfigError and SolverError.
    """
    if recording.block_size != rig.estimator.block_size:
        recording = recording.with_block_size(rig.estimator.block_size)
    buffered = BufferedEstimates()
    for records in replayed(recording, Pipeline(rig)):
        for record in records:
            buffered.add(record)
    return replace(buffered.series(), marks=tuple(recording.marks()))


class BufferedEstimates:
    """The primary estimates and tip loads among the records of a replay."""

    def __init__(self) -> None:
        self._estimates: list[DeflectionEstimate] = []
        self._wrenches: dict[int, TipLoad] = {}
        self._start_ns: int | None = None

    def add(self, record: Record) -> None:
        """Take one record."""
        if isinstance(record, DeflectionEstimate) and record.primary:
            self._estimates.append(record)
        elif isinstance(record, TipLoad):
            self._wrenches[record.t_ns] = record
        elif isinstance(record, SampleBlock) and self._start_ns is None:
            self._start_ns = int(record.t_ns[0])

    def series(self) -> EstimateSeries:
        """All of them so far."""
        estimates = self._estimates
        nothing = TipLoad(0, np.nan, np.nan, np.nan)
        return EstimateSeries(
            DEFLECTION,
            np.array([e.t_ns for e in estimates], dtype=np.int64),
            np.array([e.pose for e in estimates], dtype=np.float64).reshape(-1, 3),
            np.array([(e.phi, e.omega) for e in estimates], dtype=np.float64).reshape(-1, 2),
            np.array([e.covariance for e in estimates], dtype=np.float64).reshape(-1, 3, 3),
            np.array([self._wrenches.get(e.t_ns, nothing)[1:] for e in estimates], dtype=np.float64).reshape(-1, 3),
            np.array([e.chi_square for e in estimates], dtype=np.float64),
            self._start_ns,
        )


class WatchedReplay:
    """Takes the records of a replay of ``recording`` with ``rig``. ``alarms``: all, the first first.

    ``raised``: gets each, as soon as it is sure. ``part``: what is given, if it is not the whole; its loads.
    """

    def __init__(
        self,
        rig: Rig,
        recording: Recording,
        raised: Callable[[Alarm], None] = lambda alarm: None,
        part: RecordingWindow | None = None,
    ) -> None:
        self.watch = Watch(rig, TipLoads(rig, effects_of_rig(rig)).compliance)
        self.alarms: list[Alarm] = []
        self._rig, self._raised = rig, raised
        self._loads = (recording if part is None else part).loads()[::-1]

    def put(self, record: Record) -> None:
        """One record."""
        if isinstance(record, ParameterChange):
            values = {n: list(v) if isinstance(v, tuple) else v for n, v in record.values if n in BY_NAME}
            self._rig = replace_values(self._rig, values) if values else self._rig
            self.watch.changed(record, self._rig)
            return
        self.watch.put(record)
        if isinstance(record, SampleBlock):
            if self.watch.alarms > len(self.alarms) and self.watch.alarm is not None:
                self.alarms.append(self.watch.alarm)
                self._raised(self.watch.alarm)
            # As live: a load is noted between two blocks.
            while self._loads and self._loads[-1].t_ns <= record.t_ns[-1]:
                self.watch.put(self._loads.pop())
