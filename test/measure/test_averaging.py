# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Blocks by sequence number: a loss shortens one block and shifts none."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.measure.averaging import BlockCutter, block_middle_ns
from psd_deflection.records import RawChunk, SampleBlock


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
    assert block.index == 0
    assert block.seq.tolist() == list(range(20))
    assert cutter.flush() == []


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
    # Nothing but repeats: of one sample, and of several.
    assert cutter.add(*chunk_of([3])) == []
    assert cutter.add(*chunk_of([0, 1, 2])) == []
    assert cutter.add(*chunk_of([])) == []
    (block,) = cutter.flush()
    assert block.seq.tolist() == [0, 1, 2, 3]
    assert cutter.repeated == 6


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
    seq = np.array(slots, np.int64) + 20 * index
    block = SampleBlock(index, seq, seq * 1_000_000, np.zeros((len(seq), 6), np.float32), np.zeros(len(seq), np.uint8))
    assert block_middle_ns(block, 20, 1e6) == (20 * index) * 1_000_000 + 9_500_000


def test_a_repeat_in_the_first_chunk_is_passed_over_too() -> None:
    for seq, kept in (([4, 4], [4]), ([4, 3], [4]), ([0, 0], [0]), ([5, 3, 4, 6, 6, 7], [5, 6, 7])):
        cutter = BlockCutter(20)
        cutter.add(*chunk_of(seq))
        assert cutter.repeated == len(seq) - len(kept)
        (block,) = cutter.flush()
        assert block.seq.tolist() == kept
        assert block.volts[:, 0].tolist() == kept
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
    seq = np.array([8, 9, 11])
    t_ns = np.array([8_000_000, 9_000_003, 11_000_009])
    block = SampleBlock(2, seq, t_ns, np.zeros((3, 6), np.float32), np.zeros(3, np.uint8))
    assert block_middle_ns(block, 4, 1e6) == 9_500_000 + 4
