# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Steps of the dots that last, by means over whole bending periods on either side of a moment, and when each load began
to act: fitted with the ringing that follows. Only natural frequencies are taken from the rig file."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize, minimize_scalar

from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig

PERIODS = 4
"""Bending periods that each mean on either side of a moment takes."""
STANDS_OUT = 10.0
"""Factor by which a step must exceed the median of what is there without one."""
LEAST_SHARE = 0.03
"""A step is at least this share of the largest."""
MOST_AROUND_S = 4.0
"""A step among samples that are lost is looked for so far from their middle."""
DEEP = 10.0
"""A valley that begins so many times higher than the deepest is not followed."""

BoolArray = npt.NDArray[np.bool_]


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
        out.append(DotStep(float(at[a:b] @ weights / weights.sum()), float(np.linalg.norm(moved, axis=0)), first, last))
    return out


def _difference(dots: FloatArray, after: slice, before: slice) -> FloatArray:
    means = []
    for part in (dots[after], dots[before]):
        good = part[np.isfinite(part).all(axis=1)]
        means.append(good.mean(axis=0) if len(good) else np.zeros(dots.shape[1]))
    return np.asarray(means[0] - means[1])


def applied(t: FloatArray, start: float, took: float, period: float) -> FloatArray:
    """Share (n,) of a load that acts from ``t`` to the next sample, if applied from ``start`` on in ``took`` s.

    A step between two samples is the mean of the one, more of it, and as much less in the sample before as gives it
    the right time: the mean alone makes a link of 14 Hz ring by up to a thousandth of its movement that is not there.
    Behind the step nothing turns back: a clamp that sticks would keep that.
    """
    # Rounded, so that a step at a sample is one in floating point, too.
    share = np.clip(np.round((t + period - start) / max(took, period), 6), 0.0, 1.0)
    if took <= period:
        more = 0.5 * share * (1.0 - share)
        share += more
        share[:-1] -= more[1:]
    return np.asarray(share)


def link_modes(rig: Rig) -> tuple[tuple[float, float], ...]:
    """Natural frequency, Hz, and damping ratio of bending and of torsion."""
    d = rig.dynamics
    return (d.bending_frequency, d.bending_damping_ratio), (d.torsion_frequency, d.torsion_damping_ratio)


def time_of_step(
    rig: Rig, dots: FloatArray, step: DotStep, between: tuple[float, float], period: float
) -> tuple[float, float]:
    """When the load of ``step`` began to act, and over which time it was applied, s.

    ``between``: samples of the steps before and after it. Fitted with it: a constant, drift, the ringing of before.
    """
    reach = round(2.0 / period)
    a = max(step.first - reach // 2, math.ceil(between[0]) + round(0.1 / period), 0)
    b = min(step.last + reach, math.floor(between[1]) - round(0.1 / period), len(dots))
    a, b = min(a, step.first), max(b, step.last)
    t: FloatArray = np.arange(a, b, dtype=np.float64) * period
    part = dots[a:b]
    there = np.isfinite(part).all(axis=1)
    since = t - t[0]
    columns = [np.ones_like(t), since]
    for frequency, ratio in link_modes(rig):
        w = 2.0 * math.pi * frequency
        fade = np.exp(-ratio * w * since)
        columns += [fade * np.cos(w * since), fade * np.sin(w * since)]
    plain = np.column_stack(columns)[there]
    basis, _ = np.linalg.qr(plain)
    values = part[there] - basis @ (basis.T @ part[there])
    filters = [mode_coefficients(f, ratio, period) for f, ratio in link_modes(rig)]

    def residual(x: FloatArray) -> float:
        pushed = applied(t, float(x[0]), abs(float(x[1])), period)
        moved = np.column_stack([Filter(c)(pushed) for c in filters])[there]
        moved = moved - basis @ (basis.T @ moved)
        slopes = np.linalg.lstsq(moved, values, rcond=1e-9)[0]
        return float(((values - moved @ slopes) ** 2).sum())

    middle = step.at * period
    around = min(0.15 + step.lost * period, MOST_AROUND_S)
    sudden = best_time(residual, [(middle + d, 0.0) for d in np.arange(-around, around + 1e-4, 0.006)], period)
    slow = best_time(residual, [(middle - 0.5 * d, d) for d in (0.15, 0.3, 0.6, 1.0, 1.5, 2.5)], 0.05)
    start, took = slow[1] if slow[0] < 0.5 * sudden[0] else (sudden[1][0], 0.0)
    return start, abs(took)


def best_time(
    chi_square: Callable[[FloatArray], float], starts: list[tuple[float, float]], reach: float
) -> tuple[float, tuple[float, float]]:
    """Return the least ``chi_square`` and where, from the best of ``starts``; those without duration keep none.

    Each period of the ringing has a narrow valley: of starts without duration those about every deep one are followed.
    """
    sizes = np.array([chi_square(np.array(x)) for x in starts])
    best = np.array(starts[int(np.argmin(sizes))])
    if best[1] > 0.0:
        corners = best + reach * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        simplex = minimize(chi_square, best, method='Nelder-Mead', options={'maxfev': 120, 'initial_simplex': corners})
        return float(simplex.fun), (float(simplex.x[0]), float(simplex.x[1]))
    around = np.concatenate(([np.inf], sizes, [np.inf]))
    valleys = np.flatnonzero((sizes <= around[:-2]) & (sizes <= around[2:]) & (sizes <= DEEP * sizes.min()))
    ends = []
    for k in valleys.tolist():
        at = starts[k][0]
        scalar = minimize_scalar(
            lambda x: chi_square(np.array([x, 0.0])),
            bounds=(at - 6.0 * reach, at + 6.0 * reach),
            method='bounded',
            options={'xatol': 1e-3 * reach},
        )
        ends.append((float(scalar.fun), (float(scalar.x), 0.0)))
    return min(ends)
