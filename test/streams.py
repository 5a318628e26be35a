# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Streams of samples and what pipelines make of them: the set-up that tests of many rooms share."""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from psd_deflection.records import Counts, ParameterChange, RawChunk, Record, SpotMeans

COUNT = 10.0 / 32768
"""V a count of the rig file's converter."""


def chunk(readings: Counts | npt.NDArray[np.floating], first: int = 0) -> RawChunk:
    """Samples at 1 kHz from number ``first`` on: volts, or counts if they are integers."""
    seq = np.arange(first, first + len(readings))
    flags = np.zeros(len(seq), np.uint8)
    if readings.dtype.kind == 'i':
        return RawChunk(seq, seq * 1_000_000, readings.astype(np.int32), flags, COUNT)
    return RawChunk(seq, seq * 1_000_000, readings.astype(np.float32), flags)


def spots(records: Iterable[Record]) -> list[SpotMeans]:
    """One of each block."""
    return [r for r in records if isinstance(r, SpotMeans)]


def without(memory: ParameterChange, name: str) -> ParameterChange:
    """What a pipeline remembers, but for one value."""
    assert name in dict(memory.values)
    return ParameterChange(memory.t_ns, memory.block, tuple(v for v in memory.values if v[0] != name))
