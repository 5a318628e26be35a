"""Frequency and damping ratio of the modes of each axis, with their uncertainties.

A link that is left alone rings down: after a step of the load, or a knock,

    q(t) = c + e t + sum over the modes of exp(-zeta w t) (a cos w_d t + b sin w_d t),  w_d = w sqrt(1 - zeta^2)

Stretches of a recording in which this holds to the noise are found, and frequency and damping of each mode are
fitted to all of them at once. What is linear (c, e, a, b of each stretch) is solved for on the way (variable
projection; Golub and Pereyra, SIAM J. Numer. Anal. 10, 413, 1973).

If the link never rings alone, it is driven by what nobody measured. Then the spectrum is fitted with that of a mode
that white noise drives:

    S(f) = A / ((f0^2 - f^2)^2 + (2 zeta f0 f)^2) + B

by the likelihood of its periodogram (Whittle, Arkiv for Matematik 2, 423, 1953), which gives the uncertainties too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares, minimize

from psd_deflection.records import FloatArray

LOWEST, HIGHEST = 0.5, 200.0
"""Hz. Of the modes that are looked for; at most a quarter of the sample rate."""
PEAK = 25.0
"""A peak of the spectrum counts if it stands so many times above the level about it."""
STANDS_OUT = 30.0
"""A further peak stands so many times above the spectrum about it: of steps alone the spectrum ripples too."""
MOST_MODES = 3
WINDOW = 6.0
"""Periods of the first window of a stretch."""
SHORTEST = 4.0
"""Periods of a stretch, at least."""
LOUD = 8.0
"""The ringing is so many times louder than the noise at the start of a stretch."""
MISFIT = 1.25
"""What a stretch leaves may be so many times the noise..."""
SHARE = 0.01
"""...plus this share of the ringing, because no link is linear to the last digit."""

TRIMS = 3
"""Times that the ends of the stretches are cut and the modes fitted again."""

Boolean = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Mode:
    """One mode on one axis.

    ``frequency``, Hz, undamped; ``damping``: ratio; ``*_sd``: standard deviations. ``amplitude``: largest of the
    stretches at their start, m or rad; of a spectrum, rms.
    """

    frequency: float
    frequency_sd: float
    damping: float
    damping_sd: float
    amplitude: float


@dataclass(frozen=True)
class AxisModes:
    """The modes of one axis, the loudest first.

    ``how``: fitted to the link ringing alone, or to the spectrum of its motion in operation; ``none`` if it does not
    move. ``stretches``: first and last sample of each. ``fitted`` (n,): the fit, NaN between the
    stretches. ``noise``: standard deviation of a sample, m or rad.
    """

    modes: tuple[Mode, ...]
    how: Literal['ring-down', 'operation', 'none']
    stretches: tuple[tuple[int, int], ...]
    fitted: FloatArray = field(repr=False)
    noise: float


def modes_of(samples: FloatArray, rate: float) -> AxisModes:
    """The modes in ``samples`` (n,), m or rad, NaN if lost, taken ``rate`` times a second."""
    nothing = np.full(len(samples), np.nan)
    there = np.isfinite(samples)
    if there.sum() < 100:
        return AxisModes((), 'none', (), nothing, math.nan)
    noise = _noise(samples)
    found = _peak(_filled(samples), rate, noise)
    if found is None:
        return AxisModes((), 'none', (), nothing, noise)
    modes = [(found, 0.01)]
    while len(modes) < MOST_MODES:
        another = _peak(_filled(samples), rate, noise, [f for f, _ in modes])
        if another is None:
            break
        modes.append((another, 0.01))
    stretches = _stretches(samples, rate, modes, noise)
    if stretches:
        return _rung(samples, rate, modes, stretches, noise)
    mode = _in_operation(_filled(samples), rate, found)
    return AxisModes(() if mode is None else (mode,), 'operation' if mode else 'none', (), nothing, noise)


def _filled(samples: FloatArray) -> FloatArray:
    """Lost samples on straight lines between their neighbours."""
    there = np.flatnonzero(np.isfinite(samples))
    return np.interp(np.arange(len(samples)), there, samples[there])


def _noise(samples: FloatArray) -> float:
    """Standard deviation of the noise of one sample: fourth differences, which no slow motion reaches."""
    difference = np.diff(samples, 4)
    difference = difference[np.isfinite(difference)]
    # The sum of squares of 1 4 6 4 1 is 70. The quietest quarter: in the rest the link may be struck.
    pieces = np.array_split(difference, max(1, len(difference) // 500))
    scatter = sorted(float(np.mean(p * p)) for p in pieces if len(p))
    return math.sqrt(float(np.mean(scatter[: max(1, len(scatter) // 4)])) / 70.0)


def _spectrum(samples: FloatArray, rate: float) -> tuple[FloatArray, FloatArray]:
    from scipy.signal import welch

    length = min(len(samples) - 1, int(8 * rate))
    # The difference of neighbours: steps and creep are slow and would hide a mode.
    f, p = welch(np.diff(samples) * rate, rate, nperseg=length, detrend='constant')
    return np.asarray(f, dtype=np.float64), np.asarray(p, dtype=np.float64)


def _peak(samples: FloatArray, rate: float, noise: float, beside: Sequence[float] = ()) -> float | None:
    """Frequency of the loudest peak, Hz, not at those of ``beside``; None if none stands out."""
    f, p = _spectrum(samples, rate)
    inside = (f >= LOWEST) & (f <= min(HIGHEST, rate / 4.0))
    # Of white noise of this size, differences taken.
    floor = 2.0 * noise**2 * rate * 2.0 * (1.0 - np.cos(2.0 * np.pi * f / rate))
    contrast = np.where(inside, p / np.maximum(floor, 1e-300), 0.0)
    for taken in beside:
        contrast[np.abs(f - taken) < max(0.15 * taken, 2.0 * (f[1] - f[0]))] = 0.0
    at = int(np.argmax(np.where(inside & (contrast > 0.0), p, 0.0)))
    if contrast[at] < PEAK or not 0 < at < len(f) - 1 or p[at] < max(p[at - 1], p[at + 1]):
        return None
    about = inside & (np.abs(f - f[at]) < 0.5 * f[at]) & (np.abs(f - f[at]) > 0.2 * f[at])
    if about.any() and p[at] < (STANDS_OUT if beside else 4.0) * np.median(p[about]):
        return None
    return float(f[at])


def _basis(t: FloatArray, modes: Sequence[tuple[float, float]]) -> FloatArray:
    """Columns (n, 2 + 2 m): 1, t from the middle, and of each mode (Hz, ratio) the damped cosine and sine."""
    columns = [np.ones_like(t), t - 0.5 * t[-1]]
    for frequency, damping in modes:
        w = 2.0 * np.pi * frequency
        decay = np.exp(-damping * w * t)
        turned = w * math.sqrt(max(1.0 - damping * damping, 0.0)) * t
        columns += [decay * np.cos(turned), decay * np.sin(turned)]
    return np.column_stack(columns)


class _Stretch:
    """Samples first to last (not included) of a stretch; lost ones are left out."""

    def __init__(self, samples: FloatArray, first: int, last: int, rate: float) -> None:
        self.first, self.last = first, last
        there = np.isfinite(samples[first:last])
        self.t: FloatArray = np.flatnonzero(there) / np.float64(rate)
        self.y = samples[first:last][there]

    def solved(self, modes: Sequence[tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
        """What is left (n,), and the linear terms."""
        basis = _basis(self.t, modes)
        # Normal equations of columns of one size: five times as fast as a decomposition, and well conditioned here.
        sizes = np.sqrt((basis * basis).sum(axis=0)) + 1e-300
        scaled = basis / sizes
        terms = np.linalg.solve(scaled.T @ scaled + 1e-12 * np.eye(len(sizes)), scaled.T @ self.y) / sizes
        left: FloatArray = self.y - basis @ terms
        return left, np.asarray(terms, dtype=np.float64)


def _fit(
    stretches: Sequence[_Stretch], start: Sequence[tuple[float, float]]
) -> tuple[list[tuple[float, float]], FloatArray, FloatArray]:
    """Modes, what they leave, and the covariance of (frequency, damping, ...) for a unit of variance left."""

    def left(x: FloatArray) -> FloatArray:
        modes = [(float(f), float(z)) for f, z in x.reshape(-1, 2)]
        return np.concatenate([s.solved(modes)[0] for s in stretches])

    x0 = np.array(start, dtype=np.float64).ravel()
    scale = np.column_stack([x0[0::2], np.full(len(start), 0.01)]).ravel()
    size = max(float(np.sqrt(np.mean(left(x0) ** 2))), 1e-300)
    low = np.column_stack([0.7 * x0[0::2], np.full(len(start), 1e-6)]).ravel()
    high = np.column_stack([1.4 * x0[0::2], np.full(len(start), 0.7)]).ravel()

    def scaled(x: FloatArray) -> FloatArray:
        return left(x) / size

    x0 = np.clip(x0, low * 1.001, high * 0.999)
    found = least_squares(scaled, x0, x_scale=scale, bounds=(low, high), xtol=1e-13)
    jacobian = np.asarray(found.jac, dtype=np.float64) * size
    covariance = np.asarray(np.linalg.pinv(jacobian.T @ jacobian), dtype=np.float64)
    return [(float(f), float(z)) for f, z in found.x.reshape(-1, 2)], left(found.x), covariance


def _stretches(samples: FloatArray, rate: float, modes: list[tuple[float, float]], noise: float) -> list[_Stretch]:
    """Where the link rings alone. ``modes`` is refined on the way.

    A window moves over the recording. Where it fits, it grows until it does not fit any more, so that a stretch
    ends before the next blow.
    """
    period = rate / modes[0][0]
    window, hop = round(WINDOW * period), max(1, round(0.5 * period))
    least = round(SHORTEST * period)

    def fits(stretch: _Stretch, tried: Sequence[tuple[float, float]]) -> tuple[bool, float]:
        if len(stretch.y) < 0.5 * (stretch.last - stretch.first) or len(stretch.y) < 12:
            return False, 0.0
        left, terms = stretch.solved(tried)
        loud = max(math.hypot(*terms[2 + 2 * i : 4 + 2 * i]) for i in range(len(tried)))
        allowed = MISFIT * noise + SHARE * loud * math.exp(-tried[0][1] * 2.0 * math.pi * WINDOW / 2.0)
        return float(np.sqrt(np.mean(left * left))) < allowed and loud > LOUD * noise, loud

    # The loudest windows first: they tell the modes best. In each the modes are fitted anew.
    starts = range(0, len(samples) - window, hop)
    swing = np.array(
        [
            np.nanmax(samples[i : i + window], initial=-np.inf) - np.nanmin(samples[i : i + window], initial=np.inf)
            for i in starts
        ]
    )
    for i in np.argsort(-swing)[:40]:
        stretch = _Stretch(samples, starts[i], starts[i] + window, rate)
        if len(stretch.y) < 0.8 * window:
            continue
        tried, left, _ = _fit([stretch], modes)
        loud = float(np.ptp(stretch.y))
        if float(np.sqrt(np.mean(left * left))) < MISFIT * noise + SHARE * 0.3 * loud and loud > LOUD * noise:
            modes[:] = tried
            break
    else:
        return []
    found: list[_Stretch] = []
    at = 0
    while at + window < len(samples):
        stretch = _Stretch(samples, at, at + window, rate)
        good, _ = fits(stretch, modes)
        if not good:
            at += hop
            continue
        while stretch.last + window // 2 <= len(samples):
            longer = _Stretch(samples, at, stretch.last + window // 2, rate)
            end = _Stretch(samples, longer.last - window // 2, longer.last, rate)
            good, _ = fits(longer, modes)
            left = longer.solved(modes)[0][-len(end.y) :] if len(end.y) else np.zeros(0)
            # The tail by itself too: a small blow late in a long stretch would be lost in the mean.
            if not good or (
                len(left) and float(np.sqrt(np.mean(left * left))) > 1.5 * MISFIT * noise + SHARE * float(np.ptp(end.y))
            ):
                break
            stretch = longer
        if stretch.last - stretch.first >= least:
            found.append(stretch)
        at = stretch.last
    return found


def _rung(
    samples: FloatArray, rate: float, start: list[tuple[float, float]], stretches: list[_Stretch], noise: float
) -> AxisModes:
    modes, left, covariance = _fit(stretches, start)
    for _ in range(TRIMS):
        kept = [k for k in (_trimmed(s, samples, rate, modes) for s in stretches) if k is not None]
        if not kept:
            break
        stretches = kept
        modes, left, covariance = _fit(stretches, modes)
    while len(modes) > 1:
        # A mode without which the fit is as good is none; the loudest stays.
        fewer = [[m for k, m in enumerate(modes) if k != i] for i in range(1, len(modes))]
        without = [_fit(stretches, some) for some in fewer]
        worth = [len(left) * math.log(float(r @ r) / float(left @ left)) for _, r, _ in without]
        least = int(np.argmin(worth))
        if worth[least] > 30.0 + 4.0 * len(stretches):
            break
        modes, left, covariance = without[least]
    free = max(len(left) - sum(2 + 2 * len(modes) for _ in stretches) - 2 * len(modes), 1)
    variance = float(left @ left) / free
    fitted = np.full(len(samples), np.nan)
    sizes = np.zeros(len(modes))
    for stretch in stretches:
        t = np.arange(stretch.last - stretch.first) / np.float64(rate)
        _, terms = stretch.solved(modes)
        fitted[stretch.first : stretch.last] = _basis(t, modes) @ terms
        sizes = np.maximum(sizes, [math.hypot(*terms[2 + 2 * i : 4 + 2 * i]) for i in range(len(modes))])
    out = []
    for i, (frequency, damping) in enumerate(modes):
        # What is left need not be white: what counts is its density at the mode.
        coloured = variance * _colour(left, rate, frequency)
        out.append(
            Mode(
                frequency,
                math.sqrt(coloured * covariance[2 * i, 2 * i]),
                damping,
                math.sqrt(coloured * covariance[2 * i + 1, 2 * i + 1]),
                float(sizes[i]),
            )
        )
    out.sort(key=lambda m: -m.amplitude)
    return AxisModes(tuple(out), 'ring-down', tuple((s.first, s.last) for s in stretches), fitted, noise)


def _trimmed(
    stretch: _Stretch, samples: FloatArray, rate: float, modes: Sequence[tuple[float, float]]
) -> _Stretch | None:
    """The stretch without the ends that fit worse than its middle: they reach into the blow before or after it.

    None if little is left.
    """
    period = rate / modes[0][0]
    piece = max(4, round(0.25 * period))
    left, _ = stretch.solved(modes)
    at = np.rint(stretch.t * rate).astype(np.int64) // piece
    count = np.bincount(at)
    scatter = np.sqrt(np.bincount(at, left * left) / np.maximum(count, 1))
    usual = float(np.median(scatter[count > 0]))
    # Of a piece of n samples the scatter itself scatters by 1/sqrt(2 n).
    bad = (scatter > usual * (1.0 + 4.0 / math.sqrt(2.0 * piece))) & (count > 0)
    middle = len(scatter) // 2
    before, after = np.flatnonzero(bad[:middle]), np.flatnonzero(bad[middle:])
    first = stretch.first + (int(before[-1]) + 1) * piece if len(before) else stretch.first
    last = stretch.first + (middle + int(after[0])) * piece if len(after) else stretch.last
    if last - first < SHORTEST * period:
        return None
    return _Stretch(samples, first, last, rate)


def _colour(left: FloatArray, rate: float, frequency: float) -> float:
    """Power density of ``left`` about ``frequency`` over its mean; at least 1."""
    from scipy.signal import periodogram

    f, p = periodogram(left, rate)
    near = np.abs(f - frequency) < max(0.15 * frequency, 5.0 * rate / len(left))
    return max(1.0, float(p[near].mean() / p[1:].mean()))


def _in_operation(samples: FloatArray, rate: float, frequency: float) -> Mode | None:
    """The mode from the spectrum of a link that is driven all the time."""
    from scipy.signal import detrend, periodogram

    f, p = periodogram(detrend(samples), rate, detrend=False, window='hann')
    # Neighbours of a Hann window know of each other: every second one.
    band = (f > 0.6 * frequency) & (f < 1.5 * frequency)
    f, p = np.asarray(f[band][::2], dtype=np.float64), np.asarray(p[band][::2], dtype=np.float64)
    if len(f) < 30:
        return None
    top = float(np.max(p))

    def density(x: FloatArray) -> FloatArray:
        a, f0, zeta, b = np.exp(x)
        out: FloatArray = a / ((f0**2 - f**2) ** 2 + (2.0 * zeta * f0 * f) ** 2) + b
        return out

    def loss(x: FloatArray) -> float:
        s = density(x)
        return float(np.sum(np.log(s) + p / s))

    best = None
    for zeta in (0.005, 0.02, 0.08):
        start = np.log([top * 4.0 * zeta**2 * frequency**4 * 0.3, frequency, zeta, float(np.median(p)) * 0.1 + 1e-30])
        tried = minimize(loss, start, method='Nelder-Mead', options={'maxiter': 4000, 'xatol': 1e-6, 'fatol': 1e-6})
        if best is None or tried.fun < best.fun:
            best = tried
    if best is None:
        return None
    _, f0, zeta, _ = (float(v) for v in np.exp(best.x))
    if not 0.7 * frequency < f0 < 1.4 * frequency or not zeta < 0.5:
        return None
    information = _information(density, best.x)
    covariance = np.linalg.pinv(information)
    a = float(np.exp(best.x[0]))
    # The area under the mode's density.
    rms = math.sqrt(a * math.pi / (4.0 * zeta * f0**3))
    return Mode(f0, f0 * math.sqrt(covariance[1, 1]), zeta, zeta * math.sqrt(covariance[2, 2]), rms)


def _information(density: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    """Fisher's information of Whittle's likelihood: the products of the derivatives of log S, summed."""
    step = 1e-5
    columns = []
    for i in range(len(x)):
        ahead, behind = x.copy(), x.copy()
        ahead[i] += step
        behind[i] -= step
        columns.append((np.log(density(ahead)) - np.log(density(behind))) / (2.0 * step))
    jacobian = np.column_stack(columns)
    out: FloatArray = jacobian.T @ jacobian
    return out
