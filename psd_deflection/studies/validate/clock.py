# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The offset between the clock of a reference and that of the samples, with its uncertainty.

First every offset on the grid of the samples is tried: the reference is regressed on the motion, axis by axis, by
correlation with the FFT, so that scale and bias of either instrument do not matter. Then the best are refined on the
fitted motion: Gauss-Newton on offset, bias and a 3 x 3 matrix of scales, with Tukey's biweight against outliers
(Beaton and Tukey, Technometrics 16, 147, 1974). The standard deviation is that of least squares, or
the one of Newey and West (Econometrica 55, 703, 1987) if that is larger: what is left over may have a memory.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import minimum_filter1d

from psd_deflection.base.errors import RecordingError
from psd_deflection.records import FloatArray

Solve = Callable[[FloatArray], FloatArray]
"""Dots (n, 4), m, to poses (n, 3): dX m, dY m, theta rad; NaN if there is no answer."""

HALF = 8
"""Samples on either side of the instant."""
ORDER = 4
"""Of the polynomial: with 17 samples at 1 kHz it follows 21 Hz to 1e-4."""
LEAST = 12
"""Samples that the fit needs, at least three of them on either side of the instant."""

ROWS = 20_000
"""Instants that are fitted at once."""


@dataclass
class Motion:
    """The samples of a run.

    ``t`` (n,), s, increasing. ``dots`` (n, 4), m, calibrated and corrected. ``period`` of the samples, s. ``solve``:
    the solver.
    """

    t: FloatArray
    dots: FloatArray
    period: float
    solve: Solve
    _grid: tuple[FloatArray, npt.NDArray[np.bool_]] | None = field(default=None, repr=False)

    def dots_at(self, t: FloatArray, exposure: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Dots (k, 4), m, their rates (k, 4), m/s, and variances of the dots (k, 4), m^2, at ``t`` (k,).

        ``exposure``: s; the values are means over this time about ``t``. NaN if too few samples are near.
        """
        parts = [self._fitted(t[i : i + ROWS], exposure) for i in range(0, max(len(t), 1), ROWS)]
        values, rates, variances = (np.concatenate(p) for p in zip(*parts, strict=True))
        return values, rates, variances

    def _fitted(self, t: FloatArray, exposure: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        half = HALF + int(np.ceil(0.5 * exposure / self.period))
        reach = (half + 0.5) * self.period
        middle = np.searchsorted(self.t, t)
        index = middle[:, None] + np.arange(-half - 1, half + 1)
        there = (index >= 0) & (index < len(self.t))
        index = np.clip(index, 0, len(self.t) - 1)
        u = (self.t[index] - t[:, None]) / reach
        there &= np.abs(u) <= 1.0
        used = there.sum(axis=1)
        enough = (used >= LEAST) & ((there & (u < 0)).sum(axis=1) >= 3) & ((there & (u >= 0)).sum(axis=1) >= 3)
        powers = np.arange(ORDER + 1)
        design = np.where(there[:, :, None], u[:, :, None] ** powers, 0.0)
        readings = np.where(there[:, :, None], self.dots[index], 0.0)
        # An instant without samples has no answer; its normal matrix would be singular.
        normal = np.where(enough[:, None, None], design.transpose(0, 2, 1) @ design, np.eye(ORDER + 1))
        inverse = np.linalg.inv(normal)
        terms = inverse @ (design.transpose(0, 2, 1) @ readings)
        span = 0.5 * exposure / reach
        # The mean of u^k over the exposure; of odd powers it is 0.
        mean = np.where(powers % 2 == 0, span**powers / (powers + 1.0), 0.0)
        # The difference of the ends over the exposure; without one, the derivative.
        rate = np.where(powers % 2 == 1, span ** np.maximum(powers - 1.0, 0.0), 0.0) / reach
        values = np.einsum('p,kpc->kc', mean, terms)
        rates = np.einsum('p,kpc->kc', rate, terms)
        residual = np.where(there[:, :, None], self.dots[index] - design @ terms, 0.0)
        scatter = (residual * residual).sum(axis=1) / np.maximum(used - ORDER - 1, 1)[:, None]
        shrink = np.einsum('p,kpq,q->k', mean, inverse, mean)
        out = (values, rates, scatter * shrink[:, None])
        for array in out:
            array[~enough] = np.nan
        return out

    def poses_at(self, t: FloatArray, exposure: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Poses (k, 3) at ``t``, m, m, rad, and their rates, per second."""
        values, rates, _ = self.dots_at(t, exposure)
        poses = np.full((len(t), 3), np.nan)
        speeds = np.full((len(t), 3), np.nan)
        good = np.isfinite(values).all(axis=1)
        if good.any():
            poses[good] = self.solve(values[good])
            # The pose over a tenth of a sample, by the fitted rates of the dots.
            step = 0.1 * self.period
            later, earlier = (self.solve(values[good] + sign * step * rates[good]) for sign in (1.0, -1.0))
            speeds[good] = (later - earlier) / (2.0 * step)
        return poses, speeds

    def grid(self) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Poses (m, 3) of single samples on an even grid from the first sample, and which of them were measured (m,).

        Poses that are missing lie on straight lines between their neighbours.
        """
        if self._grid is None:
            place = np.rint((self.t - self.t[0]) / self.period).astype(np.int64)
            poses = self.solve(self.dots)
            good = np.isfinite(poses).all(axis=1)
            n = int(place[-1]) + 1
            there = np.zeros(n, dtype=bool)
            there[place[good]] = True
            at = np.flatnonzero(there)
            single = np.zeros((n, 3))
            single[place[good]] = poses[good]
            filled = np.stack([np.interp(np.arange(n), at, single[at, i]) for i in range(3)], axis=1)
            self._grid = (filled, there)
        return self._grid


FEWEST = 20
"""References, at least."""
TRIED = 5
"""Offsets that are refined."""
APART = 5
"""Samples between two offsets that are tried, at least."""
ALTERNATIVE_LOSS = 20.0
"""An offset is an alternative if its chi-square is larger by less."""
MOVES = 100.0
"""The motion explains the reference if it lowers chi-square by more. With noise alone the best of thousands of offsets,
each with nine scales, lowers it by 30 to 40."""
PASSES = 12
SETTLED = 1e-7
"""s. A smaller step ends the refinement."""
VAGUE = 0.01
"""s. The motion does not tell an offset that is less certain."""
LONGEST_MEMORY = 0.97
"""Correlation of one error with the next, at most: of a slower drift no deviation can be determined."""
BIWEIGHT = 4.685
"""Tukey's constant: 95 % as precise as least squares without outliers."""


@dataclass(frozen=True)
class Offset:
    """What to add to the reference's stamps, s.

    ``value``, ``sd``: s. ``drift``, ``drift_sd``: by how much the offset grows with time, s/s. ``explained``: whether
    the motion explains the reference at this offset. ``alternatives``: other offsets that fit as well, s. ``used``:
    references in the fit.
    """

    value: float
    sd: float
    drift: float
    drift_sd: float
    explained: bool
    alternatives: tuple[float, ...]
    used: int

    @property
    def determined(self) -> bool:
        """Whether the motion tells the offset."""
        return self.explained and self.sd < VAGUE and not self.alternatives

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval, s."""
        return self.value - 1.96 * self.sd, self.value + 1.96 * self.sd

    @property
    def sentence(self) -> str:
        """Which clock is ahead, and what to add to what."""
        if not self.determined:
            if self.explained and self.alternatives:
                alternatives = ', '.join(f'{1e3 * r:+.1f}' for r in self.alternatives)
                return (
                    'The offset between the clocks is not determined: the motion repeats itself, so that '
                    f'{1e3 * self.value:+.1f} and {alternatives} ms fit alike. '
                    'Record an event that comes once, such as a push or a step of the load.'
                )
            return (
                'The offset between the clocks is not determined: the link moves too little or too slowly. '
                'Record a few seconds in which it rings.'
            )
        size = 1e3 * abs(self.value)
        error = 1e3 * 1.96 * self.sd
        if size < error:
            return f'The clocks agree: the offset is {1e3 * self.value:+.3f} ms ± {error:.3f} ms (95 %).'
        # A stamp that needs something added is early: its clock is behind.
        side = 'behind' if self.value > 0.0 else 'ahead of'
        verb = 'add' if self.value > 0.0 else 'subtract'
        towards = 'to' if self.value > 0.0 else 'from'
        text = (
            f"The reference's clock is {size:.3f} ms ± {error:.3f} ms (95 %) {side} that of the samples: "
            f"{verb} {size:.3f} ms {towards} the reference's stamps."
        )
        if abs(self.drift) > 3.0 * self.drift_sd:
            text += f' It drifts by {1e6 * self.drift:+.1f} ± {1.96e6 * self.drift_sd:.1f} µs/s (95 %).'
        return text


@dataclass
class OffsetFit:
    """``residual``: what the fit leaves (k, 3), m, m, rad; ``sizes`` (3,): its scatter."""

    value: float
    sd: float
    drift: float
    drift_sd: float
    residual: FloatArray
    sizes: FloatArray

    def chi_square(self, sizes: FloatArray) -> float:
        """Mean over the references of what the fit leaves, in ``sizes``; an outlier counts like any other."""
        return biweight_sum(self.residual / sizes)


def biweight_sum(u: FloatArray) -> float:
    """Tukey's biweight in place of u^2, summed over the axes, mean over the references."""
    inside = np.clip(1.0 - (u / BIWEIGHT) ** 2, 0.0, None)
    return float((BIWEIGHT**2 / 3.0 * (1.0 - inside**3)).sum(axis=1).mean())


def clock_offset(
    motion: Motion, t: FloatArray, poses: FloatArray, *, largest: float = 1.0, exposure: float = 0.0
) -> Offset:
    """Return the offset of a reference with stamps ``t`` (k,), s, and ``poses`` (k, 3), m, m, rad.

    ``largest``: offset that is looked for, s. If the stamps lie outside the motion by more, the clocks count from
    different days, and every offset is looked for at which half of the references lie within the motion.
    ``exposure``: time over which the reference takes its mean, s.
    Raises RecordingError if fewer than 20 references lie within the motion.
    """
    base = 0.0
    if t[0] - largest > motion.t[-1] or t[-1] + largest < motion.t[0]:
        base = float(motion.t[0] - t[0])
        largest = float(max(t[-1] - t[0], motion.t[-1] - motion.t[0]))
    fitted = offset_near(motion, t + base, poses, largest, exposure)
    return replace(fitted, value=fitted.value + base, alternatives=tuple(r + base for r in fitted.alternatives))


def offset_near(motion: Motion, t: FloatArray, poses: FloatArray, largest: float, exposure: float) -> Offset:
    """Return the offset up to ``largest`` s either way that fits best, and its alternatives."""
    fits: list[OffsetFit] = []
    best: OffsetFit | None = None
    for start in coarse_offsets(motion, t, poses, largest):
        fitted = refined_offset(motion, t, poses, start, exposure, best)
        if fitted is not None and abs(fitted.value) <= largest + APART * motion.period:
            fits.append(fitted)
            if best is None or fitted.chi_square(best.sizes) < best.chi_square(best.sizes):
                best = fitted
    if best is None:
        raise RecordingError(
            f'the reference and the samples do not overlap enough: fewer than {FEWEST} of the references lie within '
            f'the recording at any offset up to {largest:g} s'
        )
    used = len(best.residual)
    least = best.chi_square(best.sizes)
    separation = APART * motion.period
    alternatives = tuple(
        f.value
        for f in fits
        if abs(f.value - best.value) > separation and used * (f.chi_square(best.sizes) - least) < ALTERNATIVE_LOSS
    )
    explained = used * (biweight_sum((poses - np.median(poses, axis=0)) / best.sizes) - least)
    return Offset(best.value, best.sd, best.drift, best.drift_sd, explained > MOVES, alternatives, used)


def coarse_offsets(motion: Motion, t: FloatArray, poses: FloatArray, largest: float) -> list[float]:
    """Offsets, s, at which the motion explains the reference best, the best first."""
    single, there = motion.grid()
    n, period = len(single), motion.period
    place = np.rint((t - motion.t[0]) / period).astype(np.int64)
    lags = np.arange(-math.ceil(largest / period), math.ceil(largest / period) + 1)
    first = int(place.min())
    length = int(place.max()) - first + 1
    size = 1 << int(n + length + 1).bit_length()
    comb = np.zeros((length, 3))
    count = np.zeros(length)
    np.add.at(count, place - first, 1.0)
    centred = poses - np.median(poses, axis=0)
    np.add.at(comb, place - first, centred)
    square = np.zeros((length, 3))
    np.add.at(square, place - first, centred * centred)
    moved = (single - single.mean(axis=0)) * there[:, None]

    def correlated(a: FloatArray, b: FloatArray) -> FloatArray:
        """For each lag the sum over the references of ``a`` times ``b`` at their places moved by the lag."""
        spectrum = np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size)
        full = np.fft.irfft(spectrum, size)
        out: FloatArray = full[(first + lags) % size]
        # Beyond the length of either there is no overlap; the transform would wrap around.
        out[(first + lags <= -length) | (first + lags >= n)] = 0.0
        return out

    valid = there.astype(np.float64)
    # A count: the transform leaves 20 a last bit below 20.
    overlap = np.rint(correlated(count, valid))
    cost = np.zeros(len(lags))
    with np.errstate(divide='ignore', invalid='ignore'):
        for axis in range(3):
            m, r = moved[:, axis], comb[:, axis]
            sm, sr = correlated(count, m) / overlap, correlated(r, valid) / overlap
            vm = correlated(count, m * m) / overlap - sm * sm
            vr = correlated(square[:, axis], valid) / overlap - sr * sr
            both = correlated(r, m) / overlap - sm * sr
            explained = np.where((vm > 0.0) & (vr > 0.0), both * both / (vm * vr), 0.0)
            cost += np.log1p(-np.clip(np.nan_to_num(explained), 0.0, 1.0 - 1e-12))
    cost *= overlap
    # Half of the references that can overlap must; an offset at the edge with few of them explains anything.
    cost[overlap < max(FEWEST, 0.5 * overlap.max())] = np.inf
    lowest = minimum_filter1d(cost, 2 * APART + 1)
    minima = np.flatnonzero(np.isfinite(cost) & (cost == lowest))
    best = minima[np.argsort(cost[minima], kind='stable')][:TRIED]
    return [float(lag) * period for lag in lags[best]]


def refined_offset(
    motion: Motion, t: FloatArray, poses: FloatArray, start: float, exposure: float, best: OffsetFit | None
) -> OffsetFit | None:
    """Return the offset near ``start``, s; None if fewer than 20 references have samples about them.

    ``best``: another fit. One that stays far above its chi-square is not finished.
    """
    value = start
    weights = np.ones((len(t), 3))
    fit: OffsetFit | None = None
    for passed in range(PASSES):
        poses_of_motion, rates = motion.poses_at(t + value, exposure)
        good = np.isfinite(poses_of_motion).all(axis=1)
        if good.sum() < FEWEST:
            return None
        used = UsedReferences(t[good], poses[good], poses_of_motion[good], rates[good])
        step, fit, weights[good] = used.solved(weights[good])
        value += step
        fit.value = value
        if passed > 0 and best is not None:
            worse = len(fit.residual) * (fit.chi_square(best.sizes) - best.chi_square(best.sizes))
            if worse > 10.0 * ALTERNATIVE_LOSS:
                break
        if passed > 1 and abs(step) < SETTLED:
            break
    return fit


@dataclass(frozen=True)
class UsedReferences:
    """The references in the fit: times (k,), references, motion and its rates (k, 3)."""

    t: FloatArray
    poses: FloatArray
    motion: FloatArray
    rates: FloatArray

    def solved(self, weights: FloatArray) -> tuple[float, OffsetFit, FloatArray]:
        """Return the step of the offset, s, the fit there, and the weights of the next pass (k, 3)."""
        k = len(self.t)
        # Of an axis that does not move, the readings are noise and explain nothing.
        moving = [i for i in range(3) if np.ptp(self.motion[:, i]) > 0.0]
        causes = np.column_stack([np.ones(k), *(self.motion[:, i] - self.motion[:, i].mean() for i in moving)])
        scale = np.sqrt((causes * causes).mean(axis=0))
        causes = causes / scale
        residual = np.empty((k, 3))
        sensitivity = np.empty((k, 3))
        ramp = np.empty((k, 3))
        sizes = np.empty(3)
        for axis in range(3):
            root = np.sqrt(weights[:, axis])[:, None]
            terms = np.linalg.lstsq(causes * root, self.poses[:, axis, None] * root, rcond=1e-10)[0][:, 0]
            residual[:, axis] = self.poses[:, axis] - causes @ terms
            sizes[axis] = max(
                1.4826 * float(np.median(np.abs(residual[:, axis] - np.median(residual[:, axis])))), 1e-12
            )
            # What the offset does to this axis, without what bias and scales could do as well.
            does = sum((terms[1 + c] / scale[1 + c] * self.rates[:, i] for c, i in enumerate(moving)), np.zeros(k))
            # Beside it what an offset that grows with time does.
            both = np.column_stack([does, does * self.t])
            both -= causes @ np.linalg.lstsq(causes * root, both * root, rcond=1e-10)[0]
            sensitivity[:, axis], ramp[:, axis] = both.T
        next_weights = np.clip(1.0 - (residual / (BIWEIGHT * sizes)) ** 2, 0.0, None) ** 2
        w = next_weights / sizes**2
        information = float((w * sensitivity * sensitivity).sum())
        if information <= 0.0:
            return 0.0, OffsetFit(0.0, math.inf, 0.0, math.inf, residual, sizes), next_weights
        step = float((w * sensitivity * residual).sum()) / information
        scores = (w * sensitivity * residual).sum(axis=1)
        variance = max(variance_of_sum(scores) / information**2, 1.0 / information)
        # The offset's growth with time, by what is left.
        ramp = ramp - sensitivity * (float((w * sensitivity * ramp).sum()) / information)
        grows = float((w * ramp * ramp).sum())
        drift = float((w * ramp * residual).sum()) / grows if grows > 0.0 else 0.0
        drift_variance = variance_of_sum((w * ramp * residual).sum(axis=1)) / grows**2 if grows > 0.0 else math.inf
        drift_sd = math.sqrt(max(drift_variance, 1.0 / grows)) if grows > 0.0 else math.inf
        return step, OffsetFit(0.0, math.sqrt(variance), drift, drift_sd, residual, sizes), next_weights


def variance_of_sum(scores: FloatArray) -> float:
    """Variance of the sum of ``scores`` (k,), which follow each other in time (Newey and West 1987, eq. 5).

    What each has of the one before it is taken off first and put back after (Andrews and Monahan 1992): a few lags
    alone give half of the deviation of scores that remember nine tenths.
    """
    power = float(scores @ scores)
    correlation = min(max(float(scores[1:] @ scores[:-1]) / power, 0.0), LONGEST_MEMORY) if power > 0.0 else 0.0
    new = scores[1:] - correlation * scores[:-1] if correlation > 0.0 else scores
    lags = math.floor(4.0 * (len(scores) / 100.0) ** (2.0 / 9.0))
    total = float(new @ new)
    for lag in range(1, lags + 1):
        total += 2.0 * (1.0 - lag / (lags + 1.0)) * float(new[lag:] @ new[:-lag])
    return max(total, 0.0) * len(scores) / max(len(new), 1) / (1.0 - correlation) ** 2
