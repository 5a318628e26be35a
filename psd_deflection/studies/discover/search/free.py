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

    ``of``: what it belongs to; ``axis``: which of its numbers it is. ``exact``: the change (n, 3) by a number, if it is
    not in proportion; ``size``: the number that the loads have already.
    """

    recording: int
    change: FloatArray
    sd: float
    of: object
    axis: int
    exact: Callable[[float], FloatArray] | None = None
    size: float = 0.0

    def more(self, size: float) -> FloatArray:
        """(n, 3): what ``size`` more does to the loads."""
        if self.exact is None:
            return size * self.change
        return np.asarray(self.exact(self.size + size) - self.exact(self.size), dtype=np.float64)


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


def moved(more: Sequence[tuple[Direction, float]]) -> tuple[Direction, ...]:
    """The directions, with the sizes that the loads have after so much ``more``."""
    return tuple(dataclasses.replace(d, size=d.size + size) if isinstance(d, LoadDirection) else d for d, size in more)


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
