# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The time between two sets of readings of one motion, whatever their wiring, signs and gains are.

The readings of two PSDs share at least one combination that every motion of the plate moves in proportion. At each
shift, canonical correlation (Hotelling 1936, "Relations between two sets of variates") gives the share of the movement
that the two sets do not share; the likeliest shift has the smallest product of these shares (Wilks' lambda).
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.records import FloatArray

MEAN_S = 0.02
"""A movement is the difference of two neighbouring means of this length: no offset, no drift, no hum of 50 Hz."""
STEP_S = 0.004
"""Time between two movements that are compared, s."""
MOST_VALUES = 250_000
"""Movements that are compared, the first ones of a long recording."""
FEWEST_VALUES = 50
EVIDENCE = 60.0
"""Twice the log-likelihood ratio that excludes a shift; the likeliest of 10,000 shifts of noise gains 30."""
RATIO = 1.5
"""An excluded shift leaves this much more unshared, too: a model error that follows the motion is no noise."""
UNSHARED = 0.2
"""Largest share of its movement that the best combination may leave: else the two see different motions."""
MEMORY_S = 0.25
"""Longest correlation of the unshared movement with itself that counts, s."""
INTERPOLATION = 0.02
"""Standard deviation of the interpolation between two samples, samples."""
LEAST = 1e-12
"""Least share of a movement that rounding leaves."""
AT_REST = 'the two sets do not move together'
REPEATS = 'several shifts fit: the motion repeats itself, or the clocks differ by more than 200 µs a second'


class TimeShift(NamedTuple):
    """``seconds``: by how much the second set is later than the first; ``sd``: its standard deviation, s.

    ``unshared``: share of the movement of their most correlated combinations that the two do not share. ``evidence``:
    twice the log-likelihood ratio against the stated shift; 0 if that is not excluded. ``unknown``: why the motion does
    not determine the shift, '' if it does.
    """

    seconds: float
    sd: float
    unshared: float = 1.0
    evidence: float = 0.0
    unknown: str = ''


def time_shift(
    first: FloatArray, second: FloatArray, period: float, reach: float, stated: float = 0.0, *, outside: bool = True
) -> TimeShift:
    """Return by how much ``second`` (n, q) is later than ``first`` (n, p): rows ``period`` s apart, NaN if lost.

    ``reach``: the largest shift of either sign, s; of a short recording a third of its length. ``stated``: what the
    shift is expected to be, s. ``outside``: whether it may be larger than ``reach``.
    """
    finer = int(np.ceil(0.99 * period / STEP_S))
    rows = int(MOST_VALUES * STEP_S / period)
    first, second, period = _between(first[:rows], finer), _between(second[:rows], finer), period / finer
    step, width = max(1, round(STEP_S / period)), max(1, round(MEAN_S / period))
    a, b = (_movements(x, width) for x in (first, second))
    most = min(round(reach / period / step), len(a) // step // 3)
    if most < 1 or len(a) // step < FEWEST_VALUES:
        return TimeShift(0.0, 0.0, unknown=AT_REST)
    # The same movements of the first set at every shift: only then are the shares comparable.
    window = slice(most * step, len(a) - most * step, step)
    inside = a[::step].copy()
    inside[: window.start // step] = inside[-(-window.stop // step) :] = np.nan
    counts, *sums = _sums_of_shifts(inside, b[::step], most)
    unshared = _shares(*sums)
    # Few movements fit anything.
    unshared[counts < 0.5 * counts.max()] = 1.0
    best = int(np.argmin(np.log(unshared).sum(axis=1)))

    def pair(shift: int) -> tuple[FloatArray, FloatArray]:
        return a[window], b[window.start + shift : window.stop + shift : step]

    if best in (0, 2 * most):
        return TimeShift(0.0, 0.0, unknown=AT_REST)
    shifts = np.arange(max(best - 2, 0) * step, min(best + 2, 2 * most) * step + 1) - most * step
    fine = np.concatenate([_shares(*_sums(*pair(k))) for k in shifts.tolist()])
    at = min(max(int(np.argmin(np.log(fine).sum(axis=1))), step), len(shifts) - 1 - step)
    values = _effective_values(*pair(int(shifts[at])), max(1, round(MEMORY_S / (period * step))))

    def evidence(shares: FloatArray) -> FloatArray:
        ratio = shares / fine[at]
        return np.where((ratio > RATIO).any(axis=1), np.log(ratio) @ values, 0.0)

    # The coarse grid misses a minimum by up to half a step.
    missed = np.maximum(fine[at - step // 2], fine[at + step // 2]) - fine[at]
    possible = evidence(np.maximum(unshared - missed, fine[at])) < EVIDENCE
    if possible.all() or fine[at, 0] > UNSHARED:
        return TimeShift(0.0, 0.0, unknown=AT_REST)
    apart = np.count_nonzero(np.diff(possible.astype(np.int8)) == 1) > 1
    if possible[0] or possible[-1] or apart:
        return TimeShift(0.0, 0.0, unknown=REPEATS)
    if outside and _better_elsewhere(a, b, int(shifts[at]), step, int(possible.sum())):
        return TimeShift(0.0, 0.0, unknown=REPEATS)
    # Squares of what is unshared, in units of their noise, are a parabola about the shift.
    before, here, after = fine[at - 1 : at + 2] / fine[at] @ values
    curvature = max(before - 2.0 * here + after, 1e-9)
    shift = float(shifts[at]) + 0.5 * (before - after) / curvature
    sd = float(np.hypot(np.sqrt(2.0 / curvature), INTERPOLATION * finer))
    expected = min(max(round(stated / period), -most * step), most * step)
    against = float(evidence(_shares(*_sums(*pair(expected))))[0])
    return TimeShift(float(shift * period), sd * period, float(fine[at, 0]), against if against >= EVIDENCE else 0.0)


def _between(x: FloatArray, finer: int) -> FloatArray:
    """``x`` (n, k) with straight lines between its rows, ``finer`` rows for one: slow readings move far in a sample."""
    if finer < 2:
        return x
    at = np.arange((len(x) - 1) * finer + 1) / finer
    before = np.minimum(at.astype(np.int64), len(x) - 2)
    share = (at - before)[:, None]
    return np.asarray((1.0 - share) * x[before] + share * x[before + 1])


def _present(x: FloatArray) -> npt.NDArray[np.bool_]:
    """Which rows of ``x`` (n, k) are not lost, (n,)."""
    return np.asarray(np.isfinite(x).all(axis=1))


def _movements(x: FloatArray, width: int) -> FloatArray:
    """The mean of ``width`` rows minus that of the ``width`` rows before, (n - 2 width + 1, k); NaN if half is lost."""
    there = _present(x)
    known = np.where(there[:, None], x, 0.0)
    known = np.where(there[:, None], x - known.sum(axis=0) / max(int(there.sum()), 1), 0.0)
    sums = np.cumsum(np.vstack((np.zeros(x.shape[1]), known)), axis=0)
    counts = np.cumsum(np.concatenate(([0], there)))
    count = (counts[width:] - counts[:-width])[:, None]
    means = np.where(2 * count >= width, (sums[width:] - sums[:-width]) / np.maximum(count, 1), np.nan)
    return np.asarray(means[width:] - means[:-width])


def _sums(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums of products of ``a`` (n, p) with itself, ``b`` (n, q) with itself, and the two, over the rows of both."""
    both = _present(a) & _present(b)
    a, b = a[both], b[both]
    return (a.T @ a)[None], (b.T @ b)[None], (a.T @ b)[None]


def _sums_of_shifts(a: FloatArray, b: FloatArray, most: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The same of ``a[i]`` and ``b[i + k]`` for each shift k from ``-most`` to ``most``, by Fourier transforms.

    First the number of rows of each.
    """
    size = 1 << (len(a) + most).bit_length()

    def products(x: FloatArray) -> FloatArray:
        """1, the columns and their products (n, 1 + k + k * k), 0 in a row that is lost."""
        there = _present(x)
        known = np.where(there[:, None], x, 0.0)
        squares = known[:, :, None] * known[:, None, :]
        return np.column_stack((there, known, squares.reshape(len(x), -1)))

    p, q = a.shape[1], b.shape[1]
    ours, theirs = (np.fft.rfft(products(x), size, axis=0) for x in (a, b))

    def over_shifts(first: npt.NDArray[np.complex128], second: npt.NDArray[np.complex128]) -> FloatArray:
        sums = np.fft.irfft(np.conj(first) * second, size, axis=0)
        return np.concatenate((sums[-most:], sums[: most + 1]))

    squares_a = over_shifts(ours[:, 1 + p :], theirs[:, :1]).reshape(-1, p, p)
    squares_b = over_shifts(ours[:, :1], theirs[:, 1 + q :]).reshape(-1, q, q)
    crossed = [over_shifts(ours[:, 1 + i : 2 + i], theirs[:, 1 : 1 + q]) for i in range(p)]
    counts = over_shifts(ours[:, :1], theirs[:, :1])[:, 0]
    return counts, squares_a, squares_b, np.stack(crossed, axis=1)


def _better_elsewhere(a: FloatArray, b: FloatArray, shift: int, step: int, around: int) -> bool:
    """Whether, of all that both have, another shift of up to half of it leaves less unshared, ``around`` steps away."""
    ours, theirs = a[::step], b[shift % step :: step]
    counts, *sums = _sums_of_shifts(ours, theirs, len(ours) // 2)
    # All pairs together: in the half of a motion one pair may fit by chance, where the whole tells.
    shares, here = np.log(_shares(*sums)).sum(axis=1), shift // step + len(ours) // 2
    elsewhere = counts > 0.4 * counts.max()
    elsewhere[max(here - around, 0) : here + around + 1] = False
    return bool((shares[elsewhere] < shares[here]).any())


def _shares(squares_a: FloatArray, squares_b: FloatArray, crossed: FloatArray) -> FloatArray:
    """1 minus each squared canonical correlation (k, least of p and q), the most correlated pair first."""
    return np.asarray(np.maximum(1.0 - _canonical(squares_a, squares_b, crossed)[1] ** 2, LEAST))


def _canonical(
    squares_a: FloatArray, squares_b: FloatArray, crossed: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weights of the first set (k, p, m), canonical correlations (k, m), and weights of the second set (k, q, m)."""
    roots = [np.linalg.cholesky(s + _ridge(s)) for s in (squares_a, squares_b)]
    white = np.linalg.solve(roots[0], crossed)
    white = np.swapaxes(np.linalg.solve(roots[1], np.swapaxes(white, 1, 2)), 1, 2)
    u, sizes, v = np.linalg.svd(white, full_matrices=False)
    weights = [np.linalg.solve(np.swapaxes(r, 1, 2), w) for r, w in zip(roots, (u, np.swapaxes(v, 1, 2)), strict=True)]
    return weights[0], np.minimum(sizes, 1.0), weights[1]


def _ridge(squares: FloatArray) -> FloatArray:
    """What keeps a channel that does not move, or the rounding of the transforms, from being infinitely sure."""
    size = LEAST * float(np.trace(squares, axis1=1, axis2=2).max()) + 1e-300
    return size * np.eye(squares.shape[1])


def _effective_values(a: FloatArray, b: FloatArray, memory: int) -> FloatArray:
    """Number of independent values of what each canonical pair of ``a`` and ``b`` does not share, (m,)."""
    ours, correlation, theirs = (x[0] for x in _canonical(*_sums(a, b)))
    rest = a @ ours - (b @ theirs) * correlation
    there = _present(rest)
    rest = np.where(there[:, None], rest, 0.0)
    products = [(rest[k:] * rest[: len(rest) - k]).sum(axis=0) for k in range(memory + 1)]
    memories = np.array(products) / np.maximum(products[0], 1e-300)
    # Up to where the correlation first falls to nothing: beyond is chance.
    memories[np.logical_or.accumulate(memories <= 0.0, axis=0)] = 0.0
    return np.asarray(there.sum() / np.maximum(2.0 * memories.sum(axis=0) - 1.0, 1.0))
