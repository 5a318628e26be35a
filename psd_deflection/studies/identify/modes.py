# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Frequency and damping ratio of the modes of each axis, with their uncertainties.

A link that is left alone rings down: after a step of the load, or a knock,

    q(t) = c + e t + sum over the modes of exp(-zeta w t) (a cos w_d t + b sin w_d t),  w_d = w sqrt(1 - zeta^2)

Stretches of a recording in which this holds to the noise are found, and frequency and damping of
each mode are fitted to all of them at once. What is linear (c, e, a, b of each stretch) is solved
for on the way (variable projection; Golub and Pereyra, SIAM J. Numer. Anal. 10, 413, 1973). The
search begins where most of the motion is ringing. How many modes there are is told by what a fit
leaves: two that beat look like one for a few periods only.

If the link never rings alone, its mode is that of its spectrum
(:mod:`psd_deflection.studies.identify.spectra`).
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from psd_deflection.records import FloatArray
from psd_deflection.studies.identify.spectra import (
    LEAST_DAMPING,
    MOST_DAMPING,
    AxisModes,
    Mode,
    coloured_noise,
    exceeds_noise,
    filled_up,
    loudest_peak,
    mode_in_operation,
    white_noise,
)

MOST_MODES = 3
WINDOW = 6.0
"""Periods of the first window of a stretch."""
SHORTEST = 4.0
"""Periods of a stretch, at least."""
LOUD = 8.0
"""Factor by which the ringing must exceed the noise at the start of a stretch."""
MISFIT = 1.25
"""Factor of the noise that a stretch may leave..."""
SHARE = 0.01
"""...plus this share of the ringing, because no link is linear to the last digit. A smaller mode is
none either."""
SEEDS, GROWN = 30, 3
"""Windows that are tried as the beginning of a stretch, and of those that fit so many are let grow.
"""
APART = (0.01, 0.025, 0.06)
"""Two modes that look like one may lie so far to either side of it, as a share of its frequency."""
RESCANS = 3
"""Times that the stretches are sought again if there is a mode more than the search knew."""
TRIMS = 3
"""Times that the ends of the stretches are cut and the modes fitted again."""

MOVES = 20.0
"""Factor of the noise beyond which all samples together are no noise."""
DAMPED = 'it moves, but no mode stands out of that, as where the damping ratio is above 0.15'

Modes = list[tuple[float, float]]
"""Frequency, Hz, and damping ratio of each."""


def modes_of(samples: FloatArray, rate: float) -> AxisModes:
    """Return the modes in ``samples`` (n,), m or rad, NaN if lost, taken ``rate`` times a second."""
    nothing = np.full(len(samples), np.nan)
    if np.isfinite(samples).sum() < 100:
        return AxisModes((), 'none', (), nothing, math.nan)
    filled, white = filled_up(samples), white_noise(samples)
    peaks: list[float] = []
    while len(peaks) < MOST_MODES:
        another = loudest_peak(filled, rate, white, peaks)
        if another is None:
            break
        peaks.append(another)
    if not peaks:
        why = DAMPED if np.ptp(filled) > MOVES * white else ''
        return AxisModes((), 'none', (), nothing, white, why)
    noise = coloured_noise(filled, rate, peaks)
    modes = [(f, 0.01) for f in peaks if exceeds_noise(filled, rate, f, noise)]
    if not modes:
        return AxisModes((), 'none', (), nothing, white)
    level = noise.deviation(modes[0][0] / 3.0, rate)
    stretches, modes = find_stretches(samples, filled, rate, modes, level)
    if stretches:
        return fit_ring_downs(samples, rate, modes, stretches)
    mode = mode_in_operation(filled, rate, modes[0][0])
    if mode is None:
        why = f'it moves most at {modes[0][0]:.3g} Hz, but not as a mode that rings'
        return AxisModes((), 'none', (), nothing, white, why)
    return AxisModes((mode,), 'operation', (), nothing, white)


def mode_columns(t: FloatArray, modes: Sequence[tuple[float, float]]) -> FloatArray:
    """Columns (n, 2 + 2 m): 1, t from the middle, and of each mode (Hz, ratio) the damped cosine and sine."""
    columns = [np.ones_like(t), t - 0.5 * t[-1]]
    for frequency, damping in modes:
        w = 2.0 * np.pi * frequency
        decay = np.exp(-damping * w * t)
        phase = w * math.sqrt(max(1.0 - damping * damping, 0.0)) * t
        columns += [decay * np.cos(phase), decay * np.sin(phase)]
    return np.column_stack(columns)


class Stretch:
    """Samples first to last (not included) of a stretch; lost ones are left out."""

    def __init__(self, samples: FloatArray, first: int, last: int, rate: float) -> None:
        self.first, self.last, self.rate = first, last, rate
        there = np.isfinite(samples[first:last])
        self.t: FloatArray = np.flatnonzero(there) / np.float64(rate)
        self.y = samples[first:last][there]

    def solved(self, modes: Sequence[tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
        """What is left (n,), and the linear terms."""
        basis = mode_columns(self.t, modes)
        # Normal equations of columns of one size: five times as fast as a decomposition, and well
        # conditioned here.
        sizes = np.sqrt((basis * basis).sum(axis=0)) + 1e-300
        scaled = basis / sizes
        terms = np.linalg.solve(scaled.T @ scaled + 1e-12 * np.eye(len(sizes)), scaled.T @ self.y) / sizes
        residual: FloatArray = self.y - basis @ terms
        return residual, np.asarray(terms, dtype=np.float64)

    def loud(self, modes: Modes) -> float:
        """Return the amplitude of the loudest mode at the start."""
        terms = self.solved(modes)[1]
        return max(math.hypot(*terms[2 + 2 * i : 4 + 2 * i]) for i in range(len(modes)))


class RingFit(NamedTuple):
    """``modes``, what they leave, and the covariance of (frequency, damping, ...) for a unit of variance left."""

    modes: Modes
    residual: FloatArray
    covariance: FloatArray

    @property
    def deviation(self) -> float:
        """The rms of the residual."""
        return rms_of(self.residual)

    @property
    def bounded(self) -> bool:
        """Whether a damping ratio is at its bound."""
        return self.bound_words != ''

    @property
    def bound_words(self) -> str:
        """What a mode does whose damping ratio is at its bound; '' if none is."""
        for f, z in self.modes:
            if z <= 10.0 * LEAST_DAMPING:
                return f'its motion of {f:.3g} Hz does not decay, as that of a mode does'
            if z >= 0.99 * MOST_DAMPING:
                return f'its motion of {f:.3g} Hz decays without ringing (damping ratio of {MOST_DAMPING:g} or more)'
        return ''


def rms_of(values: FloatArray) -> float:
    """Return the root of the mean square; 0 of nothing."""
    return math.sqrt(float(np.mean(values * values))) if len(values) else 0.0


def fit_modes(stretches: Sequence[Stretch], start: Modes, steps: int = 100) -> RingFit:
    """Return the least-squares fit of the modes to all stretches, from ``start`` on."""

    def residual(x: FloatArray) -> FloatArray:
        modes = [(float(f), float(z)) for f, z in x.reshape(-1, 2)]
        return np.concatenate([s.solved(modes)[0] for s in stretches])

    x0 = np.array(start, dtype=np.float64).ravel()
    scale = np.column_stack([x0[0::2], np.full(len(start), 0.01)]).ravel()
    size = max(rms_of(residual(x0)), 1e-300)
    low = np.column_stack([0.7 * x0[0::2], np.full(len(start), LEAST_DAMPING)]).ravel()
    high = np.column_stack([1.4 * x0[0::2], np.full(len(start), MOST_DAMPING)]).ravel()

    def scaled(x: FloatArray) -> FloatArray:
        return residual(x) / size

    x0 = np.clip(x0, low * 1.001, high * 0.999)
    solution = least_squares(scaled, x0, x_scale=scale, bounds=(low, high), xtol=1e-13, max_nfev=steps)
    jacobian = np.asarray(solution.jac, dtype=np.float64) * size
    covariance = np.asarray(np.linalg.pinv(jacobian.T @ jacobian), dtype=np.float64)
    return RingFit([(float(f), float(z)) for f, z in solution.x.reshape(-1, 2)], residual(solution.x), covariance)


def split_mode(stretches: Sequence[Stretch], modes: Modes) -> RingFit:
    """Return the best fit with one more mode close to one of ``modes``."""
    starts = [
        [*modes[:i], (f * (1.0 - apart), z), (f * (1.0 + apart), z), *modes[i + 1 :]]
        for i, (f, z) in enumerate(modes)
        for apart in APART
    ]
    best = min((fit_modes(stretches, start, 25) for start in starts), key=lambda fit: fit.deviation)
    return fit_modes(stretches, best.modes)


def hints_at_pair(stretches: Sequence[Stretch], fit: RingFit, enough: float) -> bool:
    """Return whether modes to both sides of one of ``fit`` would take ``enough`` off the squares that are left."""
    for f, z in fit.modes:
        for apart in APART:
            pair = [(f * (1.0 - apart), max(z, 0.01)), (f * (1.0 + apart), max(z, 0.01))]
            residual = np.concatenate([s.solved([*fit.modes, *pair])[0] for s in stretches])
            if float(fit.residual @ fit.residual - residual @ residual) > enough:
                return True
    return False


def ringing_levels(filled: FloatArray, rate: float, modes: Modes, starts: Sequence[int], window: int) -> FloatArray:
    """(k,): how much louder the ringing is in the window from each of ``starts`` than all else, but steady motion.

    Linear in frequency and damping about ``modes``, which need not be known well.
    """
    t = np.arange(window) / np.float64(rate)
    columns = [mode_columns(t, [(f, z)])[:, 2:] for f, _ in modes for z in (0.003, 0.02, 0.06)]
    ringing = np.hstack([*columns, *(t[:, None] * c for c in columns)])
    steady = np.linalg.qr(mode_columns(t, []))[0]
    ringing -= steady @ (steady.T @ ringing)
    u, sizes, _ = np.linalg.svd(ringing / np.linalg.norm(ringing, axis=0), full_matrices=False)
    u = u[:, sizes > 1e-6 * sizes[0]]
    out = np.empty((len(starts), 2))
    for i, first in enumerate(starts):
        y = filled[first : first + window] - filled[first]
        y = y - steady @ (steady.T @ y)
        out[i] = math.sqrt(2.0) * rms_of(y), rms_of(y - u @ (u.T @ y))
    return out


def seed_windows(
    samples: FloatArray, filled: FloatArray, rate: float, modes: Modes, level: float, window: int, hop: int
) -> list[Stretch]:
    """Windows in which most of the motion is ringing, the clearest first; none overlaps another by half."""
    starts = range(0, len(samples) - window, hop)
    loud, rest = ringing_levels(filled, rate, modes, starts, window).T
    out: list[Stretch] = []
    for i in np.argsort(-loud / (rest + level)):
        if len(out) == SEEDS:
            break
        stretch = Stretch(samples, starts[i], starts[i] + window, rate)
        apart = all(abs(s.first - stretch.first) >= window // 2 for s in out)
        if apart and loud[i] > LOUD * level and len(stretch.y) >= 0.8 * window:
            out.append(stretch)
    return out


def ends_well(stretch: Stretch, residual: FloatArray, window: int, level: float, early: bool = False) -> bool:
    """Whether the last half of a window fits by itself too, or the first: a small blow would be lost in the mean."""
    half = 0.5 * window / stretch.rate
    end = stretch.t < stretch.t[0] + half if early else stretch.t > stretch.t[-1] - half
    return rms_of(residual[end]) < 1.5 * MISFIT * level + SHARE * float(np.ptp(stretch.y[end]))


def grow_stretch(
    samples: FloatArray, seed: Stretch, start: RingFit, window: int, level: float
) -> tuple[Stretch, RingFit]:
    """``seed`` made longer, forward and then back to louder times, as long as the modes fit.

    If two that looked like one come apart, with both.
    """
    stretch, fit = seed, start
    for early in (False, True):
        while True:
            step = max(window // 2, (stretch.last - stretch.first) // 3)
            ends = (stretch.first - step, stretch.last) if early else (stretch.first, stretch.last + step)
            if ends[0] < 0 or ends[1] > len(samples):
                break
            longer = Stretch(samples, *ends, stretch.rate)
            tried = fit_modes([longer], fit.modes)
            if not is_good(longer, tried, level) or not ends_well(longer, tried.residual, window, level, early):
                worth = 0.25 * float(tried.residual @ tried.residual)
                if len(fit.modes) == MOST_MODES or not hints_at_pair([longer], tried, worth):
                    break
                tried = split_mode([longer], fit.modes)
                if not is_good(longer, tried, level) or not ends_well(longer, tried.residual, window, level, early):
                    break
            stretch, fit = longer, tried
    return stretch, fit


def is_good(stretch: Stretch, fit: RingFit, level: float) -> bool:
    """Return whether a stretch rings loud enough and the fit leaves little of it."""
    loud = stretch.loud(fit.modes)
    swing = float(np.ptp(stretch.y))
    return not fit.bounded and fit.deviation < MISFIT * level + 0.3 * SHARE * swing and loud > LOUD * level


def find_stretches(
    samples: FloatArray, filled: FloatArray, rate: float, modes: Modes, level: float
) -> tuple[list[Stretch], Modes]:
    """Where the link rings alone, and the modes by the longest of these.

    A window moves over the recording. Where it fits, it grows until it does not fit any more, so
    that a stretch ends before the next blow.
    """
    period = rate / modes[0][0]
    window, hop = round(WINDOW * period), max(1, round(0.5 * period))
    seeds = seed_windows(samples, filled, rate, modes, level, window, hop)
    tried = ((s, fit_modes([s], modes)) for s in seeds)
    good = list(itertools.islice(((s, fit) for s, fit in tried if is_good(s, fit, level)), GROWN))
    if not good:
        tried = ((s, split_mode([s], modes)) for s in seeds[: SEEDS // 3])
        good = list(itertools.islice(((s, fit) for s, fit in tried if is_good(s, fit, level)), GROWN))
    if not good:
        return [], modes
    grown = [grow_stretch(samples, s, fit, window, level) for s, fit in good]
    _, best = max(grown, key=lambda g: g[0].last - g[0].first)
    level = max(level, best.deviation)
    return scan_windows(samples, rate, best.modes, level, window, hop), best.modes


def scan_windows(samples: FloatArray, rate: float, modes: Modes, level: float, window: int, hop: int) -> list[Stretch]:
    """Return the stretches in which the modes fit, windows joined from the first to the last that fits."""

    def fits(stretch: Stretch) -> bool:
        if len(stretch.y) < 0.5 * (stretch.last - stretch.first) or len(stretch.y) < 12:
            return False
        residual, _ = stretch.solved(modes)
        loud = stretch.loud(modes)
        allowed = MISFIT * level + SHARE * loud * math.exp(-modes[0][1] * 2.0 * math.pi * WINDOW / 2.0)
        return rms_of(residual) < allowed and loud > LOUD * level and ends_well(stretch, residual, window, level)

    stretches: list[Stretch] = []
    at = 0
    while at + window < len(samples):
        stretch = Stretch(samples, at, at + window, rate)
        if not fits(stretch):
            at += hop
            continue
        while stretch.last + window // 2 <= len(samples):
            longer = Stretch(samples, at, stretch.last + window // 2, rate)
            if not fits(longer):
                break
            stretch = longer
        stretches.append(stretch)
        at = stretch.last
    return stretches


def fit_ring_downs(samples: FloatArray, rate: float, start: Modes, stretches: list[Stretch]) -> AxisModes:
    """Return the modes of the stretches, sought again with a mode that was missing."""
    stretches, fit = fit_trimmed(samples, rate, stretches, start)
    if len(fit.modes) > len(start):
        # With the mode that was missing the stretches are longer.
        period = rate / fit.modes[0][0]
        window, hop = round(WINDOW * period), max(1, round(0.5 * period))
        for _ in range(RESCANS):
            again = scan_windows(samples, rate, fit.modes, fit.deviation, window, hop)
            if sum(s.last - s.first for s in again) <= sum(s.last - s.first for s in stretches):
                break
            stretches, fit = fit_trimmed(samples, rate, again, fit.modes)

    fitted = np.full(len(samples), np.nan)
    if fit.bounded:
        return AxisModes((), 'none', (), fitted, fit.deviation, fit.bound_words)
    sizes = mode_sizes(stretches, fit.modes)
    for stretch in stretches:
        t = np.arange(stretch.last - stretch.first) / np.float64(rate)
        fitted[stretch.first : stretch.last] = mode_columns(t, fit.modes) @ stretch.solved(fit.modes)[1]
    out = []
    for i, (frequency, damping) in enumerate(fit.modes):
        # What is left need not be white: what counts is its density at the mode.
        variance = variance_at(fit, stretches, rate, frequency)
        by_frequency, by_damping = (math.sqrt(variance * fit.covariance[k, k]) for k in (2 * i, 2 * i + 1))
        out.append(Mode(frequency, by_frequency, damping, by_damping, float(sizes[i])))
    out.sort(key=lambda m: -m.amplitude)
    places = tuple((s.first, s.last) for s in stretches)
    return AxisModes(tuple(out), 'ring-down', places, fitted, fit.deviation)


def fit_trimmed(
    samples: FloatArray, rate: float, stretches: list[Stretch], start: Modes
) -> tuple[list[Stretch], RingFit]:
    """Return the stretches without their bad ends, and the fit to them with as many modes as it needs."""
    fit = fit_modes(stretches, start)
    for _ in range(TRIMS):
        trimmed = [k for k in (trim(s, samples, rate, fit.modes) for s in stretches) if k is not None]
        if not trimmed or [(s.first, s.last) for s in trimmed] == [(s.first, s.last) for s in stretches]:
            break
        stretches = trimmed
        fit = fit_modes(stretches, fit.modes)
    return stretches, with_right_order(stretches, fit, rate)


def mode_sizes(stretches: Sequence[Stretch], modes: Modes) -> FloatArray:
    """Largest amplitude of each mode at the start of a stretch."""
    terms = np.array([s.solved(modes)[1][2:] for s in stretches]).reshape(len(stretches), -1, 2)
    return np.asarray(np.hypot(terms[..., 0], terms[..., 1]).max(axis=0))


def with_right_order(stretches: Sequence[Stretch], fit: RingFit, rate: float) -> RingFit:
    """With another mode as long as what is left asks for it; without those that make no difference."""

    odds = 30.0 + 4.0 * len(stretches)

    def needs(more: RingFit, fewer: RingFit, frequency: float) -> bool:
        saved = float(fewer.residual @ fewer.residual - more.residual @ more.residual)
        return saved > odds * variance_at(more, stretches, rate, frequency)

    while len(fit.modes) > 1:
        # The loudest stays.
        loudest = int(np.argmax(mode_sizes(stretches, fit.modes)))
        other_modes = [i for i in range(len(fit.modes)) if i != loudest]
        without = [fit_modes(stretches, [m for k, m in enumerate(fit.modes) if k != i]) for i in other_modes]
        least = int(np.argmin([w.deviation for w in without]))
        if needs(fit, without[least], fit.modes[other_modes[least]][0]):
            break
        fit = without[least]
    while len(fit.modes) < MOST_MODES and hints_at_pair(
        stretches, fit, 0.3 * odds * variance_at(fit, stretches, rate, fit.modes[0][0])
    ):
        more = split_mode(stretches, fit.modes)
        sizes = mode_sizes(stretches, more.modes)
        if more.bounded or sizes.min() < SHARE * sizes.max() or not needs(more, fit, fit.modes[0][0]):
            break
        fit = more
    return fit


def trim(stretch: Stretch, samples: FloatArray, rate: float, modes: Sequence[tuple[float, float]]) -> Stretch | None:
    """Return the stretch without the ends that fit worse than its middle: they reach into the blow before or after it.

    None if little is left.
    """
    period = rate / modes[0][0]
    piece = max(4, round(0.25 * period))
    residual, _ = stretch.solved(modes)
    # Noise that remembers has fewer samples than it seems.
    memory = min(max(float(residual[1:] @ residual[:-1]) / float(residual @ residual), 0.0), 0.95)
    worth = max(piece * (1.0 - memory) / (1.0 + memory), 1.0)
    at = np.rint(stretch.t * rate).astype(np.int64) // piece
    count = np.bincount(at)
    scatter = np.sqrt(np.bincount(at, residual * residual) / np.maximum(count, 1))
    usual = float(np.median(scatter[count > 0]))
    # Of a piece worth n samples the scatter itself scatters by 1/sqrt(2 n).
    bad = (scatter > usual * (1.0 + 4.0 / math.sqrt(2.0 * worth))) & (count > 0)
    middle = len(scatter) // 2
    before, after = np.flatnonzero(bad[:middle]), np.flatnonzero(bad[middle:])
    first = stretch.first + (int(before[-1]) + 1) * piece if len(before) else stretch.first
    last = stretch.first + (middle + int(after[0])) * piece if len(after) else stretch.last
    if last - first < SHORTEST * period:
        return None
    return Stretch(samples, first, last, rate)


def variance_of(fit: RingFit, stretches: Sequence[Stretch]) -> float:
    """Of what is left, for the freedom that it has."""
    taken = sum(2 + 2 * len(fit.modes) for _ in stretches) + 2 * len(fit.modes)
    return float(fit.residual @ fit.residual) / max(len(fit.residual) - taken, 1)


def variance_at(fit: RingFit, stretches: Sequence[Stretch], rate: float, frequency: float) -> float:
    """Variance of white noise with the density that what is left has about ``frequency``.

    At least the variance of what is left. The modes have taken away their part of it, there and in
    all.
    """
    from scipy.signal import periodogram

    f, p = periodogram(fit.residual, rate)
    band = np.abs(f - frequency) < max(0.3 * frequency, 5.0 * rate / len(fit.residual))
    close = sum(abs(k - frequency) < 0.3 * frequency for k, _ in fit.modes)
    free = 2 * int(band.sum()) - 2 * close * (len(stretches) + 1)
    share = 2 * int(band.sum()) / max(free, 2)
    return max(variance_of(fit, stretches), float(p[band].mean()) * 0.5 * rate * share)
