# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the samples of blocks say without anything that is remembered: means, extremes, roughness, covariance.

Blocks of one length are measured together, element by element along the block: the bits of a block do not depend on
its neighbours.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.base.arithmetic import in_pairs
from psd_deflection.records import FloatArray, SampleBlock

Volts = npt.NDArray[np.float32]

AT_ONCE = 50
"""Blocks that are computed together, at the most: those of one segment of the noise, which changes after it."""

_THIRD_DIFFERENCE = 20.0
"""Variance of the third difference of white noise of variance 1: 1 + 9 + 9 + 1."""


class BlockMeasures(NamedTuple):
    """Of one block of n samples of P PSDs.

    ``volts`` (n, 3P): x, y and sum of each PSD in turn. ``samples`` (n, 2P): dots, m; ``means`` (2P,) and
    ``covariance`` (2P, 2P) m^2 of them, zeros of one sample. ``sums`` (n, P) V; ``mean_sums`` (P,). ``least``, ``most``
    (3P,) V. ``same`` (P,): whether x, y and sum are identical in all samples. ``rough`` (3P,) V: rms of what changes
    from sample to sample, from third differences, which remove nearly all of the link's motion; 0 of less than four.
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
    for _, same in itertools.groupby(blocks, key=lambda block: (len(block.seq), block.index // AT_ONCE)):
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
    return [BlockMeasures(*own) for own in zip(volts, samples, *columns, strict=True)]
