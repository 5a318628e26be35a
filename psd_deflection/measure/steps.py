# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Steps of the dots that last, by means over whole bending periods on either side of a moment; and when the link moved
last, by the dots of the last minute: a weight is noted after it was hung."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from psd_deflection.records import BlockStatus, BoolArray, FloatArray, Record, SpotMeans
from psd_deflection.rig.config import Rig

PERIODS = 4
"""Bending periods that each mean on either side of a moment takes."""
STANDS_OUT = 10.0
"""Factor by which a step must exceed the median of what is there without one."""
LEAST_SHARE = 0.03
"""A step is at least this share of the largest."""
REACH_S = 60.0
"""A step that is older is not looked for."""


@dataclass(frozen=True, slots=True)
class DotStep:
    """``at``: sample of its middle; ``size``: how far the dots moved, m; ``first``, ``last``: samples about it.
    ``lost``: samples about it of which none is there.
    """

    at: float
    size: float
    first: int
    last: int
    lost: int = 0


def last_load_change(rig: Rig, dots: FloatArray, period: float) -> float | None:
    """When the last lasting step of ``dots`` (n, 2P), m, was, s from the first of them; None if they have none.

    ``period``: s from one to the next; they may be means of blocks. The time is that of the step's middle, to a
    fraction of a period of the link's bending.
    """
    steps = lasting_steps(dots, max(2, round(PERIODS / rig.dynamics.bending_frequency / period)))
    return steps[-1].at * period if steps else None


def lasting_steps(dots: FloatArray, width: int) -> list[DotStep]:
    """Where the mean of ``width`` samples differs from that of as many before; of samples that are there, if more than
    a quarter of as many are lost at once: the step may lie among those.
    """
    there: BoolArray = np.all(np.isfinite(dots), axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate(([True], there, [True])).astype(np.int8)))
    keep = np.ones(len(dots), dtype=bool)
    for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if b - a > width // 4:
            keep[a:b] = False
    lasting = np.flatnonzero(keep)
    out = []
    for step in steps_among_samples(dots[lasting], width):
        first, last = lasting[[step.first, step.last]].tolist()
        # Between the last sample before it and the first after it.
        before, after = np.interp((step.at - 1.0, step.at), np.arange(len(lasting)), lasting).tolist()
        lost = last - first - (step.last - step.first)
        out.append(DotStep(0.5 * (before + 1.0 + after), step.size, first, last, lost))
    return out


def steps_among_samples(dots: FloatArray, width: int) -> list[DotStep]:
    """Return the lasting steps of dots (n, 4), m, without regard to lost samples."""
    n = len(dots)
    if n < 4 * width:
        return []
    there: BoolArray = np.all(np.isfinite(dots), axis=1)
    sums = np.vstack((np.zeros(dots.shape[1]), np.cumsum(np.where(there[:, None], dots, 0.0), axis=0)))
    counts = np.concatenate(([0], np.cumsum(there)))
    at = np.arange(width, n - width)
    before, after = counts[at] - counts[at - width], counts[at + width] - counts[at]
    apart = (sums[at + width] - sums[at]) / np.maximum(after, 1)[:, None]
    apart -= (sums[at] - sums[at - width]) / np.maximum(before, 1)[:, None]
    size = np.where((before > width // 4) & (after > width // 4), np.linalg.norm(apart, axis=1), 0.0)
    least = max(STANDS_OUT * float(np.median(size)), LEAST_SHARE * float(size.max(initial=0.0)))
    edges = np.flatnonzero(np.diff(np.concatenate(([False], size > least, [False])).astype(np.int8)))
    out = []
    for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        # Two steps close together make one stretch with two peaks.
        weights = np.maximum(size[a:b] - 0.5 * size[a:b].max(), 0.0)
        if b - a < width // 2:
            continue
        first, last = a + width, b + width
        moved = _difference(dots, slice(last, last + width), slice(a, first))
        out.append(DotStep(float(at[a:b] @ weights / weights.sum()), float(np.linalg.norm(moved)), first, last))
    return out


def _difference(dots: FloatArray, after: slice, before: slice) -> FloatArray:
    means = []
    for part in (dots[after], dots[before]):
        good = part[np.isfinite(part).all(axis=1)]
        means.append(good.mean(axis=0) if len(good) else np.zeros(dots.shape[1]))
    return np.asarray(means[0] - means[1])


class RecentDots:
    """A sink of records. It keeps the dots of two PSDs for ``REACH_S`` and computes when asked."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._period = rig.estimator.block_size / rig.converter.sample_rate_hz
        self._most = max(2, round(REACH_S / self._period))
        self._rows: deque[tuple[int, int, tuple[float, ...]]] = deque(maxlen=self._most)

    def put(self, record: Record) -> None:
        """Keep the dots of a good block."""
        if isinstance(record, SpotMeans) and record.status is BlockStatus.OK:
            self._rows.append((record.index, record.t_ns, record.dots[:4]))

    def step_ns(self) -> int | None:
        """When the last lasting step of the dots was, ns, or None. From any thread."""
        rows = tuple(self._rows)
        if not rows:
            return None
        last, last_ns, _ = rows[-1]
        # Blocks that are missing are rows without dots. After a restart numbers may begin anew.
        first = max(min(index for index, _, _ in rows), last - self._most + 1)
        dots = np.full((last - first + 1, 4), np.nan)
        for index, _, values in rows:
            if first <= index <= last:
                dots[index - first] = values
        step_s = last_load_change(self._rig, dots, self._period)
        # Times are those of the middles of blocks; a step lies between two.
        ago_s = None if step_s is None else (last - first + 0.5) * self._period - step_s
        return None if ago_s is None else last_ns - round(ago_s * 1e9)
