# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converts a recording: copies its samples and what was recorded beside them, or writes what is computed of them."""

from __future__ import annotations

import contextlib
import heapq
import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from psd_deflection.measure.pipeline import Pipeline, PipelineCounters
from psd_deflection.recordings.formats.format import format_of_name, open_sink
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import replayed
from psd_deflection.records import (
    AppliedLoad,
    Mark,
    ParameterChange,
    Record,
    ReferencePose,
    SampleBlock,
    TemperatureReading,
)
from psd_deflection.rig.config import Rig

Convertible = SampleBlock | ParameterChange | AppliedLoad | Mark | ReferencePose | TemperatureReading


def _time(record: Convertible) -> int:
    return int(record.t_ns[0]) if isinstance(record, SampleBlock) else record.t_ns


class Beside(NamedTuple):
    """What a recording holds beside its samples."""

    loads: list[AppliedLoad]
    references: list[ReferencePose]
    temperatures: list[TemperatureReading]
    marks: list[Mark]

    @classmethod
    def of(cls, recording: Recording) -> Beside:
        """Read them."""
        return cls(recording.loads(), recording.references(), recording.temperatures(), recording.marks())


def convert(
    recording: Recording, out: Path, parameters: Mapping[str, object], beside: Beside, blocks: Iterable[SampleBlock]
) -> int:
    """Write ``recording`` and its ``blocks`` to ``out``; returns the number of samples. Raises RecordingError.

    A table has no place for marks: they are left out, with a warning of the recording.
    """
    loads, references, temperatures, marks = beside
    records: Iterable[Convertible] = heapq.merge(
        recording.changes, loads, references, temperatures, marks, blocks, key=_time
    )
    if format_of_name(out).is_table:
        if marks:
            recording.warn(f'{out}: a table has no place for marks: {len(marks)} left out')
        # A row takes what is waiting, and a block's last row what came during the block.
        records = itertools.chain(loads, references, temperatures, blocks)
    kinds: list[type[Record]] = [type(rows[0]) for rows in beside if rows]
    sink = open_sink(out, parameters, device_hello=recording.hello, samples_with=kinds, psds=recording.psds)
    samples = 0
    with contextlib.closing(sink):
        for record in records:
            sink.put(record)
            samples += len(record.seq) if isinstance(record, SampleBlock) else 0
    return samples


def convert_computed(recording: Recording, out: Path, rig: Rig, blocks: Iterable[SampleBlock]) -> PipelineCounters:
    """Write what ``rig`` computes of ``recording`` and its ``blocks`` to ``out``. Raises RecordingError."""
    pipeline = Pipeline(rig)
    with contextlib.closing(open_sink(out, rig.flat(), title=recording.path.stem)) as sink:
        for records in replayed(recording, pipeline, blocks):
            for record in records:
                sink.put(record)
    return pipeline.counters
