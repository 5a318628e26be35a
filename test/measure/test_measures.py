# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Blocks in any number at a time: the same measures, and the same bits of everything that follows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.measure.measures import AT_ONCE, measured, of_one_length
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import rig_at_start
from psd_deflection.records import FLAG_OVER_RANGE, FloatArray, IntArray, RawChunk, Record, SampleBlock
from psd_deflection.rig.config import Rig, load_rig

BAGS = Path(__file__).parents[2] / 'bags'


def in_chunks(rig: Rig, samples: RawChunk, blocks: int) -> Iterator[str]:
    """The records of ``samples`` that come so many blocks at a time, and some states in between, with all digits."""
    pipeline, size = Pipeline(rig), rig.estimator.block_size * blocks
    cuts = np.flatnonzero(np.diff(samples.seq // size)) + 1
    for rows in np.split(np.arange(len(samples.seq)), cuts):
        chunk = RawChunk(samples.seq[rows], samples.t_ns[rows], samples.readings[rows], samples.flags[rows])
        for record in pipeline.process(chunk):
            yield reported(record)
            if isinstance(record, SampleBlock) and record.index % 37 == 5:
                yield repr(pipeline.memory(rig))
    yield from map(reported, pipeline.flush())


def reported(record: Record) -> str:
    names = [f.name for f in fields(record)] if is_dataclass(record) else record._fields
    return repr([type(record), *map(bits, (getattr(record, name) for name in names))])


def bits(value: object) -> object:
    return value.tobytes() if isinstance(value, np.ndarray) else value


@pytest.mark.slow
@pytest.mark.parametrize('name', ['clean', 'lost_samples', 'laser_off', 'motion', 'calibrated', 'three_psds'])
def test_golden_bits_are_same_for_any_chunk_size(name: str) -> None:
    recording = open_recording(BAGS / name)
    columns = zip(*[(b.seq, b.t_ns, b.volts, b.flags) for b in recording.blocks()], strict=True)
    seq, t_ns, volts, flags = (np.concatenate(column) for column in columns)
    samples, rig = RawChunk(seq, t_ns, volts, flags), rig_at_start(recording)
    one = list(in_chunks(rig, samples, 1))
    assert len(one) > 900
    for blocks in (7, 50, 1000):
        assert list(in_chunks(rig, samples, blocks)) == one


@pytest.mark.parametrize('seed', [0, pytest.param(1, marks=pytest.mark.slow)])
def test_random_blocks_have_same_bits_in_any_batch(seed: int) -> None:
    """Losses, dark lasers, tones, more noise, a constant detector and a flag; two, three and four PSDs."""
    rng = np.random.default_rng(seed)
    more = {f'psd_{n}.center': [0.03 * n, -0.05] for n in range(3, 3 + seed % 3)}
    rig = load_rig(overrides={**more, 'block_size': (20, 8, 33)[seed % 3], 'degraded': 'hold', 'sum_max': 6.0})
    n, psds = 7000, len(rig.psds)
    volts = 2e-3 * rng.normal(size=(n, 3 * psds)) * np.repeat(rng.choice([0.3, 1.0, 4.0], 7), 1000)[:, None]
    volts[:, 2::3] += 5.0
    tone = np.sin(2.0 * np.pi * rng.uniform(0.004, 0.4) * np.arange(n))
    volts[:, 1::3] += np.where(np.arange(n) // 700 % 3 == 1, rng.choice([0.01, 0.3]) * tone, 0.0)[:, None]
    for start in rng.integers(0, n, 3).tolist():
        volts[start : start + 150, rng.integers(psds) * 3 + 2] -= 5.0
    start = int(rng.integers(0, n))
    volts[start : start + 300, :3] = volts[start, :3]
    kept: IntArray = np.flatnonzero(rng.random(n) > 0.15 * (np.arange(n) // 500 % 2))
    flags = np.where(rng.random(len(kept)) < 2e-4, FLAG_OVER_RANGE, 0).astype(np.uint8)
    samples = RawChunk(kept, kept * 1_000_000, volts[kept].astype(np.float32), flags)
    one = list(in_chunks(rig, samples, 1))
    for blocks in (7, 1000):
        assert list(in_chunks(rig, samples, blocks)) == one


def test_measures_are_those_of_numpy() -> None:
    rng = np.random.default_rng(2)
    volts = rng.normal(size=(3, 12, 6)).astype(np.float32)
    volts[1, :, 3:] = volts[1, 0, 3:]
    samples: FloatArray = rng.normal(size=(3, 12, 4))
    for block, (v, z) in zip(measured(list(volts), list(samples)), zip(volts, samples, strict=True), strict=True):
        np.testing.assert_allclose(block.means, z.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(block.covariance, np.cov(z.T), rtol=1e-12)
        np.testing.assert_allclose(block.mean_sums, v[:, 2::3].mean(axis=0, dtype=np.float64), rtol=1e-12)
        np.testing.assert_allclose(block.rough, np.sqrt((np.diff(v, 3, axis=0) ** 2).mean(axis=0) / 20.0), rtol=1e-5)
        assert (block.least, block.most) == (v.min(axis=0).tolist(), v.max(axis=0).tolist())
        assert block.same == [False, bool((v[:, 3:] == v[0, 3:]).all())]
    (alone,) = measured([volts[0][:1]], [samples[0][:1]])
    assert (alone.means, alone.covariance.any()) == (tuple(samples[0, 0].tolist()), np.False_)


def test_blocks_of_one_length_and_one_segment_go_together() -> None:
    recording = open_recording(BAGS / 'lost_samples')
    together = list(of_one_length(list(recording.blocks())))
    assert [len(b) for b in together][:4] == [2, 1, 7, 1]
    assert max(map(len, together)) <= AT_ONCE
    assert all(len({(len(b.seq), b.index // AT_ONCE) for b in run}) == 1 for run in together)
