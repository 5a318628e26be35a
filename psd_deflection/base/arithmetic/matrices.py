# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Sums and eliminations of small matrices, each in an order that stands here."""

import threading
from collections.abc import Sequence
from functools import cache
from math import inf, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from psd_deflection.records import FloatArray

AnyFloats = npt.NDArray[np.floating[Any]]

AT_ONCE = 1 << 15
"""Numbers of an operand up to which a table of all products is made."""
_MARGIN = 1e-13
"""Of the largest element, times the square of the number of unknowns: 500 times the rounding of one operation."""
_SMALL = 1 << 12
"""Numbers of rows up to which the partial sums have places that are kept: at most 32 kB a shape."""
_MOST_SHAPES = 256
"""Shapes of which they are kept. Blocks with gaps have as many lengths as they have samples."""


@cache
def plan(spec: str) -> tuple[tuple[tuple[tuple[int, ...] | None, tuple[Any, ...]], ...], int]:
    """How each operand is turned so that the summed indices come first; and the number of these."""
    inputs, _, out = spec.partition('->')
    terms = inputs.split(',')
    summed = ''.join(dict.fromkeys(c for c in inputs if c not in out and c != ','))
    order = summed + out
    layouts = []
    for term in terms:
        axes = tuple(term.index(c) for c in order if c in term)
        if len(axes) != len(term):
            raise ValueError(f'{spec}: an index is twice in {term}')
        at = tuple(slice(None) if c in term else None for c in order)
        layouts.append((axes if axes != tuple(range(len(axes))) else None, at))
    return tuple(layouts), len(summed)


def product_of(factors: Sequence[AnyFloats]) -> AnyFloats:
    """From the left; the first index is the slowest in memory."""
    out = factors[0]
    for factor in factors[1:]:
        out = np.multiply(out, factor, order='C')
    return out


def in_pairs(rows: AnyFloats) -> FloatArray:
    """Sum of ``rows`` (n, ...): the first half to the second until one row is left; zeros of none.

    A row without a partner goes to the first pair. Adding in pairs rounds less than adding in turn, and takes fewer
    calls.
    """
    rest = np.asarray(rows, dtype=np.float64)
    if len(rest) < 2:
        return np.asarray(rest[0]) if len(rest) else np.zeros(rest.shape[1:])
    cache = _KEPT.by_shape
    scratch = cache.get(rest.shape)
    if scratch is None:
        scratch = _Scratch(rest.shape)
        if rest.size <= _SMALL:
            if len(cache) >= _MOST_SHAPES:
                cache.clear()
            cache[rest.shape] = scratch
    return scratch.sum(rest)


class _Scratch:
    """The partial sums of :func:`in_pairs` for one shape of rows. Of few numbers, making them anew costs most."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        """``shape``: two rows or more."""
        count = shape[0]
        self._half = count // 2
        self._both = 2 * self._half
        self._first = rest = np.empty((self._half, *shape[1:]))
        self._odd = rest[0, ...] if count & 1 else None
        self._steps: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        while (count := len(rest)) > 1:
            half = count // 2
            pairs = np.empty((half, *shape[1:]))
            self._steps.append((rest[:half], rest[half : 2 * half], pairs))
            if count & 1:
                self._steps.append((pairs[0, ...], rest[-1, ...], pairs[0, ...]))
            rest = pairs
        self._last = rest[0, ...]

    def sum(self, rows: FloatArray) -> FloatArray:
        """Of rows of that shape."""
        half, both = self._half, self._both
        np.add(rows[:half], rows[half:both], self._first)
        if self._odd is not None:
            np.add(self._odd, rows[-1], self._odd)
        for a, b, pairs in self._steps:
            np.add(a, b, pairs)
        return self._last.copy()


class _Kept(threading.local):
    """``by_shape``: what this thread has; another one would write into it."""

    def __init__(self) -> None:
        self.by_shape: dict[tuple[int, ...], _Scratch] = {}


_KEPT = _Kept()


def orthogonal(a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Q (m, n) with orthonormal columns and R (n, n), 0 below the diagonal, of ``a`` (m, n) = Q R.

    A column that depends on those before it has 0 in both.
    """
    columns = np.array(a.T, dtype=np.float64)
    r = np.zeros((len(columns), len(columns)))
    for i, column in enumerate(columns):
        size = sqrt(float(in_pairs(column * column)))
        # Twice: once leaves rounding that shows.
        for _ in range(2):
            for j in range(i):
                part = float(in_pairs(columns[j] * column))
                r[j, i] += part
                column -= part * columns[j]
        residual = sqrt(float(in_pairs(column * column)))
        r[i, i] = residual if residual > 1e-13 * size else 0.0
        column[:] = column / residual if residual > 1e-13 * size else 0.0
    return columns.T, r


def pivots(a: FloatArray) -> list[FloatArray]:
    """Pivots (...) of the elimination of symmetric ``a`` (..., n, n); it ends at one that is not above 0."""
    rest, out = np.asarray(a, dtype=np.float64), []
    while rest.shape[-1]:
        pivot, row = rest[..., 0, 0], rest[..., 0, 1:]
        out.append(np.asarray(pivot))
        if not bool((pivot > 0.0).all()):
            break
        rest = rest[..., 1:, 1:] - row[..., :, None] * (row / pivot[..., None])[..., None, :]
    return out


def surely_positive(a: FloatArray) -> bool | None:
    """Whether symmetric ``a`` (n, n) is positive definite; None if that hangs on rounding.

    Elimination gives the pivots of a matrix that differs from ``a`` by some n rounding errors of its largest element
    (Rump, Verification of positive definiteness, BIT 46, 2006). So if Cholesky's factors exist with much more than
    that taken off the diagonal, or do not with as much added, every order of the sums says so.
    """
    size = len(a)
    margin = _MARGIN * size * size * float(np.abs(np.diagonal(a)).max(initial=0.0))
    if not 0.0 < margin < inf:
        return None
    for more, answer in ((-margin, True), (margin, False)):
        moved = np.array(a, dtype=np.float64)
        moved[range(size), range(size)] += more
        if has_factors(moved) is answer:
            return answer
    return None


def has_factors(a: FloatArray) -> bool:
    """Whether Cholesky factors symmetric ``a`` (n, n), up to rounding: it is positive definite."""
    try:
        np.linalg.cholesky(a)
    except np.linalg.LinAlgError:
        return False
    return True


def rotate(a: FloatArray, vectors: FloatArray, i: int, j: int) -> None:
    """Turn axes ``i`` and ``j`` so that the element that they share is 0 (Golub & Van Loan, 8.5)."""
    between = float(a[i, j])
    tau = (float(a[j, j]) - float(a[i, i])) / (2.0 * between)
    t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + sqrt(1.0 + tau * tau))
    c = 1.0 / sqrt(1.0 + t * t)
    s = t * c
    for rows in (a, a.T, vectors.T):
        first, second = rows[i].copy(), rows[j].copy()
        rows[i] = c * first - s * second
        rows[j] = s * first + c * second
    a[i, j] = a[j, i] = 0.0


def inverse(matrices: FloatArray) -> FloatArray:
    """Return the inverses of positive definite ``matrices`` (n, k, k), by elimination; no pivots are needed.

    Element by element, so that the bits are those of any machine.
    """
    size = matrices.shape[1]
    out = matrices.copy()
    for i in range(size):
        pivot = 1.0 / out[:, i, i]
        row = out[:, i, :] * pivot[:, None]
        column = out[:, :, i].copy()
        out -= column[:, :, None] * row[:, None, :]
        out[:, i, :] = row
        out[:, :, i] = -column * pivot[:, None]
        out[:, i, i] = pivot
    return out
