# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Blocks of N by sequence number (``seq // block_size``: a lost sample shortens one block and shifts none), and what
the samples of each say."""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.base.arithmetic import in_pairs
from psd_deflection.records import FloatArray, IntArray, RawChunk, SampleBlock


class BlockCutter:
    """Turns chunks of any size into whole blocks; an unfinished block waits for the next chunk.

    ``repeated`` counts the samples that were ignored because their number did not increase.
    """

    def __init__(self, block_size: int) -> None:
        self.block_size = block_size
        self.repeated = 0
        self._last_seq = -1
        self._pending: list[SampleBlock] = []  # Bound: one block.

    def add(self, chunk: RawChunk, volts: np.ndarray[tuple[int, int], np.dtype[np.float32]]) -> list[SampleBlock]:
        """The blocks that ``chunk`` completes. ``volts`` float32 (n, 3P): its readings in volts."""
        seq, t_ns, flags = chunk.seq, chunk.t_ns, chunk.flags
        n = len(seq)
        if n == 0:
            return []
        if seq[0] <= self._last_seq or (n > 1 and bool((seq[1:] <= seq[:-1]).any())):
            highest = np.maximum.accumulate(np.concatenate(([self._last_seq], seq[:-1])))
            keep = seq > highest
            self.repeated += int(n - keep.sum())
            seq, t_ns, flags, volts = seq[keep], t_ns[keep], flags[keep], volts[keep]
            if len(seq) == 0:
                return []
        self._last_seq = int(seq[-1])
        size = self.block_size
        first, last = int(seq[0]) // size, self._last_seq // size
        done: list[SampleBlock] = []
        if first == last:
            pieces = [SampleBlock(first, seq, t_ns, volts, flags)]
        else:
            index = seq // size
            cuts = np.flatnonzero(np.diff(index)) + 1
            bounds = [0, *cuts.tolist(), len(seq)]
            pieces = [
                SampleBlock(int(index[a]), seq[a:b], t_ns[a:b], volts[a:b], flags[a:b])
                for a, b in itertools.pairwise(bounds)
            ]
        for piece in pieces:
            if self._pending and self._pending[0].index != piece.index:
                done.append(self._join())
            self._pending.append(piece)
            if int(piece.seq[-1]) % size == size - 1:
                done.append(self._join())
        return done

    def flush(self) -> list[SampleBlock]:
        """The unfinished block, if any: call it when the stream ended or restarted."""
        return [self._join()] if self._pending else []

    def _join(self) -> SampleBlock:
        parts, self._pending = self._pending, []
        if len(parts) == 1:
            return parts[0]
        return SampleBlock(
            parts[0].index,
            np.concatenate([p.seq for p in parts]),
            np.concatenate([p.t_ns for p in parts]),
            np.concatenate([p.volts for p in parts]),
            np.concatenate([p.flags for p in parts]),
        )


def middles_ns(seq: IntArray, t_ns: IntArray, block_size: int, period_ns: float) -> list[int]:
    """Time of the middle of each whole block, ns, from the samples that are present: ``seq``, ``t_ns`` (B, n).

    Each sample gives an estimate of the time of slot (N-1)/2. The result is their mean, so a lost
    sample moves the stamp by no more than the clock's jitter. The mean of the remaining samples belongs to
    another time: :mod:`psd_deflection.measure.uncertainty.block_fit` gives the value at the stamp.
    """
    count = t_ns.shape[1]
    first = t_ns[:, 0]
    offsets = (t_ns - first[:, None]).sum(axis=1) / count
    # Of a whole block the mean slot is the middle.
    if count < block_size:
        offsets += (0.5 * (block_size - 1) - (seq % block_size).sum(axis=1) / count) * period_ns
    middles: list[int] = (first + np.rint(offsets).astype(np.int64)).tolist()
    return middles


Volts = npt.NDArray[np.float32]

SEGMENT_BLOCKS = 50
"""Blocks of a segment of the noise, a second at 50 blocks a second: at most so many are computed together."""

_THIRD_DIFFERENCE = 20.0
"""Variance of the third difference of white noise of variance 1: 1 + 9 + 9 + 1."""


class BlockMeasures(NamedTuple):
    """Of one block of n samples of P PSDs.

    ``volts`` (n, 3P): x, y and sum of each PSD in turn. ``samples`` (n, 2P): dots, m; ``means`` (2P,) and
    ``covariance`` (2P, 2P) m^2 of them, zeros of one sample. ``sums`` (n, P) V; ``mean_sums`` (P,). ``least``, ``most``
    (3P,) V. ``same`` (P,): whether x, y and sum are identical in all samples. ``rough`` (3P,) V: rms of what changes
    from sample to sample, from third differences, which remove nearly all of the link's motion; 0 of less than four.

    Blocks of one length are measured together, element by element along the block: the bits of a block do not depend on
    its neighbours.
    """

    volts: Volts
    samples: FloatArray
    means: tuple[float, ...]
    covariance: FloatArray
    sums: FloatArray
    mean_sums: tuple[float, ...]
    least: list[float]
    most: list[float]
    same: list[bool]
    rough: list[float]


def of_one_length(blocks: Sequence[SampleBlock]) -> Iterator[list[SampleBlock]]:
    """The blocks in turn, those of one length and segment that follow each other together."""
    for _, same in itertools.groupby(blocks, key=lambda block: (len(block.seq), block.index // SEGMENT_BLOCKS)):
        yield list(same)


def measured(volts: Sequence[Volts], samples: Sequence[FloatArray]) -> list[BlockMeasures]:
    """The measures of blocks of one length: of each ``volts`` (n, 3P) and ``samples`` (n, 2P)."""
    # The samples first: every sum is over them, in pairs.
    v, z = np.stack(volts, axis=1), np.stack(samples, axis=1)
    n, blocks, channels = v.shape
    means = in_pairs(z) / n
    sums = v[:, :, 2::3].astype(np.float64)
    count = z.shape[2]
    covariance = np.zeros((blocks, count, count))
    if n > 1:
        centred = z - means
        covariance = in_pairs(centred[:, :, :, None] * centred[:, :, None, :]) / (n - 1)
    rough = v
    for _ in range(3):
        rough = rough[1:] - rough[:-1]
    level = np.sqrt(in_pairs(rough * rough) / (max(n - 3, 1) * _THIRD_DIFFERENCE))
    columns = (
        map(tuple, means.tolist()),
        covariance,
        sums.transpose(1, 0, 2),
        map(tuple, (in_pairs(sums) / n).tolist()),
        np.minimum.reduce(v).tolist(),
        np.maximum.reduce(v).tolist(),
        (v == v[0]).all(axis=0).reshape(blocks, channels // 3, 3).all(axis=2).tolist(),
        level.tolist(),
    )
    return [BlockMeasures(*row) for row in zip(volts, samples, *columns, strict=True)]
