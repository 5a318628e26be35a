# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What nobody knows exactly, and the search therefore holds against no model: loads, their times, and the zero."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.records import FloatArray, dot_channels


@dataclass(frozen=True, slots=True, eq=False)
class LoadDirection:
    """A change of the loads that nobody knows: ``change`` (n, 3) N, N, N m of ``recording``, times a number of standard
    deviation ``sd``.

    ``of``: what it belongs to; ``axis``: which of its numbers it is. ``exact``: the change (n, 3) by all of these
    numbers, if it is not in proportion; ``sizes``: the numbers that the loads have already.
    """

    recording: int
    change: FloatArray
    sd: float
    of: object
    axis: int
    exact: Callable[[Sequence[float]], FloatArray] | None = None
    sizes: tuple[float, ...] = ()
    swings: bool = False


@dataclass(frozen=True, slots=True)
class ZeroDirection:
    """The error of a zero that was taken in ``recording``: a constant of ``axis`` (from 0: x1, y1, x2 ...), known to
    ``sd``, m.
    """

    recording: int
    axis: int
    sd: float

    def table(self, like: Sequence[FloatArray], sensitivities: FloatArray) -> list[FloatArray]:
        """One standard deviation, V, in tables as ``like`` (3P, m) of each recording. ``sensitivities`` (P, 2) m/V."""
        out = [np.zeros_like(t) for t in like]
        out[self.recording][dot_channels(len(sensitivities))[self.axis]] = self.sd / sensitivities.ravel()[self.axis]
        return out


Direction = LoadDirection | ZeroDirection


def added(more: Sequence[tuple[Direction, float]]) -> list[tuple[int, FloatArray, bool]]:
    """Recordings, what so much ``more`` adds to the loads (n, 3) of each, and whether that is a motion nobody noted."""
    sizes, out = _sizes(more), []
    for d, size in more:
        if isinstance(d, LoadDirection):
            if d.exact is None:
                out.append((d.recording, size * d.change, d.swings))
            elif (now := sizes.pop(id(d.of), None)) is not None:
                # The end of a ramp moves by its start and by its time: the two are no sum.
                out.append((d.recording, d.exact(now) - d.exact(d.sizes), d.swings))
    return out


def moved(more: Sequence[tuple[Direction, float]]) -> tuple[Direction, ...]:
    """Return the directions, with the sizes that the loads have after so much ``more``."""
    sizes = _sizes(more)
    return tuple(
        dataclasses.replace(d, sizes=sizes.get(id(d.of), d.sizes)) if isinstance(d, LoadDirection) else d
        for d, _ in more
    )


def _sizes(more: Sequence[tuple[Direction, float]]) -> dict[int, tuple[float, ...]]:
    """Return all numbers after so much ``more``, by the id of what they belong to."""
    out: dict[int, tuple[float, ...]] = {}
    for d, size in more:
        if isinstance(d, LoadDirection) and d.exact is not None:
            sizes = list(out.get(id(d.of), d.sizes))
            sizes[d.axis] += size
            out[id(d.of)] = tuple(sizes)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Free:
    """``tables``: what each of the ``directions`` changes, V, at its standard deviation. ``rows`` (k, D): the whitened
    span of these, orthonormal, of variance ``energy`` (k,) against that of the noise; ``back`` (p, k): from there to
    the numbers.
    """

    directions: tuple[Direction, ...]
    tables: tuple[list[FloatArray], ...]
    rows: FloatArray
    energy: FloatArray
    back: FloatArray
