# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""When the load of each step of the dots began to act: fitted with the ringing that follows. Only natural frequencies
are taken from the rig file."""

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from psd_deflection.measure.steps import DotStep
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.loads.thresholds import MANYFOLD, REACH_S


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


def link_motion(rig: Rig, loads: FloatArray) -> FloatArray:
    """Return the poses (n, 3), m, m, rad, of the rig's link under ``loads`` (n, 3), N, N, N m, held, from rest."""
    static = loads @ LinkStatics.from_rig(rig).compliance
    bending, torsion = (mode_coefficients(*mode, 1.0 / rig.converter.sample_rate_hz) for mode in link_modes(rig))
    return np.column_stack([Filter(c)(static[:, k]) for k, c in enumerate((bending, bending, torsion))])


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
    around = min(0.15 + step.lost * period, REACH_S)
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
    valleys = np.flatnonzero((sizes <= around[:-2]) & (sizes <= around[2:]) & (sizes <= MANYFOLD * sizes.min()))
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
