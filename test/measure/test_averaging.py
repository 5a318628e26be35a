# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Blocks by sequence number: a loss shortens one block and shifts none; in any number at a time, the same bits."""

import itertools
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.measure.averaging import SEGMENT_BLOCKS, BlockCutter, measured, middles_ns, of_one_length
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import rig_at_start
from psd_deflection.records import FLAG_OVER_RANGE, FloatArray, IntArray, RawChunk, Record, SampleBlock
from psd_deflection.rig.config import Rig, load_rig


def chunk_of(seq: list[int]) -> tuple[RawChunk, npt.NDArray[np.float32]]:
    number = np.array(seq, np.int64)
    volts = np.repeat(number[:, None], 6, axis=1).astype(np.float32)
    return RawChunk(number, number * 1_000_000, volts, np.zeros(len(seq), np.uint8)), volts


def cut(chunks: list[list[int]], size: int = 20) -> list[SampleBlock]:
    cutter = BlockCutter(size)
    blocks = [b for seq in chunks for b in cutter.add(*chunk_of(seq))]
    return blocks + cutter.flush()


def test_a_block_is_complete_with_its_last_sample() -> None:
    cutter = BlockCutter(20)
    assert cutter.add(*chunk_of(list(range(19)))) == []
    (block,) = cutter.add(*chunk_of([19]))
    assert (block.index, block.seq.tolist(), cutter.flush()) == (0, list(range(20)), [])


def test_a_block_in_one_piece_is_complete_at_once() -> None:
    cutter = BlockCutter(20)
    assert [b.seq.tolist() for b in cutter.add(*chunk_of(list(range(25))))] == [list(range(20))]
    assert [b.seq.tolist() for b in cutter.add(*chunk_of([25, 39]))] == [[20, 21, 22, 23, 24, 25, 39]]
    assert cutter.add(*chunk_of([40, 58])) == []


def test_lost_last_sample_is_awaited_one_block_only() -> None:
    cutter = BlockCutter(20)
    assert cutter.add(*chunk_of(list(range(19)))) == []
    (block,) = cutter.add(*chunk_of([20]))
    assert len(block.seq) == 19


def test_repeats_are_passed_over_and_counted() -> None:
    cutter = BlockCutter(20)
    cutter.add(*chunk_of([0, 1, 1, 2]))
    cutter.add(*chunk_of([2, 3]))
    assert (cutter.add(*chunk_of([3])), cutter.add(*chunk_of([0, 1, 2]))) == ([], [])
    assert cutter.add(*chunk_of([])) == []
    (block,) = cutter.flush()
    assert (block.seq.tolist(), cutter.repeated) == ([0, 1, 2, 3], 6)


@given(
    st.lists(st.integers(0, 300), unique=True, min_size=1).map(sorted),
    st.lists(st.integers(0, 300), max_size=10).map(sorted),
    st.integers(1, 30),
)
def test_however_the_stream_is_cut_the_blocks_are_the_same(seq: list[int], cuts: list[int], size: int) -> None:
    bounds = [0, *[min(c, len(seq)) for c in cuts], len(seq)]
    pieces = [seq[a:b] for a, b in itertools.pairwise(bounds)]
    got = cut(pieces, size)
    assert [s for b in got for s in b.seq.tolist()] == seq
    for block in got:
        assert set((block.seq // size).tolist()) == {block.index}
        assert (block.t_ns == block.seq * 1_000_000).all()
        assert (block.volts == block.seq[:, None]).all()
    assert len({b.index for b in got}) == len(got)


@given(st.lists(st.integers(0, 19), unique=True, min_size=1).map(sorted), st.integers(0, 10**6))
def test_block_middle_is_independent_of_lost_samples(slots: list[int], index: int) -> None:
    seq = np.array(slots, np.int64) + np.array([[20 * index], [20 * index + 60]])
    first = 20_000_000 * index + 9_500_000
    assert middles_ns(seq, seq * 1_000_000, 20, 1e6) == [first, first + 60_000_000]


def test_a_repeat_in_the_first_chunk_is_passed_over_too() -> None:
    for seq, selected in (([4, 4], [4]), ([4, 3], [4]), ([0, 0], [0]), ([5, 3, 4, 6, 6, 7], [5, 6, 7])):
        cutter = BlockCutter(20)
        cutter.add(*chunk_of(seq))
        assert cutter.repeated == len(seq) - len(selected)
        (block,) = cutter.flush()
        assert (block.seq.tolist(), block.volts[:, 0].tolist()) == (selected, selected)
        assert (block.t_ns == block.seq * 1_000_000).all()


def test_what_a_sample_brings_along_stays_with_it() -> None:
    """Flags of their own, through repeats, cuts and joins."""
    cutter, done = BlockCutter(4), []
    for seq in ([0, 1], [1, 2, 3, 4, 5, 9], [9, 10, 12]):
        chunk, volts = chunk_of(seq)
        done += cutter.add(RawChunk(chunk.seq, chunk.t_ns, chunk.readings, (10 * chunk.seq).astype(np.uint8)), volts)
    done += cutter.flush()
    assert [(b.index, b.seq.tolist()) for b in done] == [(0, [0, 1, 2, 3]), (1, [4, 5]), (2, [9, 10]), (3, [12])]
    for block in done:
        assert block.flags.tolist() == (10 * block.seq).tolist()
    assert cutter.repeated == 2


def test_a_block_of_one_sample_is_complete_with_it() -> None:
    cutter = BlockCutter(1)
    assert [b.index for b in cutter.add(*chunk_of([3]))] == [3]
    assert [b.index for b in cutter.add(*chunk_of([4, 6, 7]))] == [4, 6, 7]
    assert cutter.flush() == []


def test_the_middle_is_the_mean_of_what_the_clock_reported() -> None:
    """Jitter of ns on some samples, of a block of four of which one is lost: 1.5 periods after its first place."""
    seq = np.array([[8, 9, 11]])
    t_ns = np.array([[8_000_000, 9_000_003, 11_000_009]])
    assert middles_ns(seq, t_ns, 4, 1e6) == [9_500_000 + 4]


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
                yield repr(pipeline.snapshot(rig))
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
    single = list(in_chunks(rig, samples, 1))
    assert len(single) > 900
    for blocks in (7, 50, 1000):
        assert list(in_chunks(rig, samples, blocks)) == single


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
    received: IntArray = np.flatnonzero(rng.random(n) > 0.15 * (np.arange(n) // 500 % 2))
    flags = np.where(rng.random(len(received)) < 2e-4, FLAG_OVER_RANGE, 0).astype(np.uint8)
    samples = RawChunk(received, received * 1_000_000, volts[received].astype(np.float32), flags)
    single = list(in_chunks(rig, samples, 1))
    for blocks in (7, 1000):
        assert list(in_chunks(rig, samples, blocks)) == single


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
    assert max(map(len, together)) <= SEGMENT_BLOCKS
    assert all(len({(len(b.seq), b.index // SEGMENT_BLOCKS) for b in run}) == 1 for run in together)
