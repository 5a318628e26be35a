# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Records of every kind, made up for the tests of recordings; files of them, and whether they came back."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection.recordings.write.bag_writer import BagWriter, McapFile
from psd_deflection.records import (
    AppliedLoad,
    BaseAcceleration,
    BlockStatus,
    DeflectionEstimate,
    DiagnosticEntry,
    DiagnosticReport,
    Mark,
    Record,
    ReferencePose,
    ReferenceWithCovariance,
    SampleBlock,
    SpotMeans,
    TemperatureReading,
    TipLoad,
    TipMotion,
)
from psd_deflection.rig.config import load_rig

T0 = 1_760_000_000_123_456_789
STEP = 1_000_000
HELLO = {'serial': 'A1', 'sample_rate_hz': 1000}


def block(index: int, *, lost: tuple[int, ...] = (), flags: int = 0, t0: int = T0, first_index: int = 0) -> SampleBlock:
    """Block ``index`` of 20 samples at 1 kHz whose time starts at ``t0`` with block ``first_index``."""
    seq = np.array([s for s in range(20 * index, 20 * index + 20) if s - 20 * index not in lost], dtype=np.int64)
    t_ns = t0 + (seq - 20 * first_index) * STEP
    volts = np.random.default_rng(index).normal(0.0, 3.0, (len(seq), 6)).astype(np.float32)
    flag = np.zeros(len(seq), dtype=np.uint8)
    flag[0] = flags
    return SampleBlock(index, seq, t_ns, volts, flag)


def spots(index: int, status: BlockStatus = BlockStatus.OK) -> SpotMeans:
    t_ns = T0 + 20 * STEP * index + 9_500_000
    dots = (1e-3, -2e-3, 1e-4 * index, 0.0)
    return SpotMeans(t_ns, index, dots, (5.0, 5.0), np.eye(4) * 1e-12, 20, 0, status, '')


def estimate(index: int, solver: str = 'exact', primary: bool = True) -> DeflectionEstimate:
    t_ns = T0 + 20 * STEP * index + 9_500_000
    covariance = (1e-12, 1e-13, 2e-13, 1e-13, 3e-12, 1e-14, 2e-13, 1e-14, 1e-11)
    return DeflectionEstimate(t_ns, index, solver, 1e-3 * index, -5e-4, 0.01, 1e-4, -2e-3, covariance, 1e-7, primary)


def motion(index: int) -> TipMotion:
    covariance = (1e-12, 1e-13, 2e-13, 1e-13, 3e-12, 1e-14, 2e-13, 1e-14, 1e-11)
    t_ns = T0 + 20 * STEP * index + 19_000_000
    return TipMotion(t_ns, index, 1e-3, -5e-4, 0.01, 0.0, 0.0, covariance, 0.1 * index, -0.2, 0.3, (1e-8,) * 9, 0.02)


def run(blocks: int) -> Iterator[Record]:
    """What a live run hands to its recorder, one record of every kind at least."""
    yield TemperatureReading(T0, 21.5)
    for i in range(blocks):
        lost = (3, 4) if i % 7 == 2 else ()
        yield block(i, lost=lost, flags=2 if lost else 0)
        yield spots(i)
        yield estimate(i)
        yield estimate(i, 'wls', primary=False)
        yield TipLoad(T0 + 20 * STEP * i + 9_500_000, 0.5 * i, -0.25, 0.01)
        yield motion(i)
        if i % 10 == 0:
            yield AppliedLoad(T0 + 20 * STEP * i, 0.5 * i, 0.0, 0.1)
            yield Mark(T0 + 20 * STEP * i, f'block {i}')
            yield BaseAcceleration(T0 + 20 * STEP * i, (0.5, 0.0, -9.0), (0.0, 0.1 * i, 2.0))
            yield ReferencePose(T0 + 20 * STEP * i, 1e-3, 2e-3, 3e-3)
            yield ReferenceWithCovariance(T0 + 20 * STEP * i, 1e-3, 2e-3, 3e-3, 0.0, 0.0, (1e-12,) * 9)
        if i % 50 == 49:
            entry = DiagnosticEntry('psd_deflection: samples', 1, '2 lost', (('rate', '998.0'),))
            yield DiagnosticReport(T0 + 20 * STEP * i, (entry,))


def same_block(a: SampleBlock, b: SampleBlock) -> bool:
    return (
        a.index == b.index
        and all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ('seq', 't_ns', 'volts', 'flags'))
        and all(getattr(a, n).dtype == getattr(b, n).dtype for n in ('seq', 't_ns', 'volts', 'flags'))
    )


def assert_same(got: Sequence[SampleBlock], expected: Sequence[SampleBlock]) -> None:
    assert [b.index for b in got] == [b.index for b in expected]
    assert all(same_block(a, b) for a, b in zip(got, expected, strict=True))


def write_mcap(path: Path, records: Sequence[Record], **kwargs: Any) -> Path:
    with McapFile(path, rig_values=kwargs.pop('rig_values', {}), **kwargs) as out:
        for r in records:
            out.put(r)
    return path


def write_bag(folder: Path, changed: Mapping[str, object]) -> Path:
    """A bag of 60 blocks of every kind of record, of a rig with these parameters ``changed``."""
    with BagWriter(folder, rig_values=load_rig(None, changed).values, device_hello=HELLO) as out:
        for r in run(60):
            out.put(r)
    return folder
