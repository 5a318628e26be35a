# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the dots were at the stamp: a polynomial through one block, weighted by what is known of the motion.

The mean of N samples is not the value in their middle while the link moves: 20 samples at 1 kHz take
12 % off a motion of 14 Hz, 27 % at 21 Hz, and where samples are lost the mean belongs to another
time. So each block is described by orthonormal polynomials q_k of order 0 to 4 over its N places,
z(s) = sum_k c_k q_k(s), and the answer is their value in the middle. Order 0 is the mean; the higher
ones cost noise, and are worth it only while there is motion. How much motion there is the stream
says: tau_k^2, the mean of c_k^2 over the last blocks less what noise puts into it, is taken as the
prior variance of c_k, so that the answer is the posterior mean of Gaussian c_k (empirical Bayes; the
weight of order k is tau_k^2/(tau_k^2 + v_k) in a whole block). At rest the weights go to 0 and the
answer is the mean; in motion to 1.

The answer is linear in the samples, w^T z. So its variance is w^T Gamma w with the measured
autocovariance Gamma, plus sum_k (q_k(middle) - w^T q_k)^2 tau_k^2 for the motion that the weights
leave out. A motion that order 4 cannot follow (a load that is switched inside the block) shows in
what is left of the samples: then their rms is added as an error that does not average out.

The readings are turned into orthogonal combinations first (:mod:`psd_deflection.measure.uncertainty.combinations`), so
that motion is sought where the link moves the dots.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.measure.uncertainty.combinations import combinations_of
from psd_deflection.measure.uncertainty.vibration import Tone
from psd_deflection.records import FloatArray, IntArray

ORDER = 4
"""Highest order: it follows a quarter period inside a block to 1e-4 of the amplitude."""

_FORGET = 1.0 / 12.0
"""Share of the newest block in the running mean of c_k^2. The energy of a mode of 14 Hz with 2 % of damping falls to
1/e in 14 blocks: a longer memory would weigh, and state, motion that is over."""

_BIAS = 0.5
"""Times v_k, taken off tau_k^2: a mean that cannot be negative is too large by about that where there is no motion."""

_LASTING = 250.0
"""Blocks, at the most, of the mean of motion that goes on alike: 5 s of 20 samples at 1 kHz. Its error is a fifth of
that of the short one, so that motion which bends a block by a fifth of its noise is told from noise."""

_OVER = 0.35
"""Times the noise and the motion of late: a lasting mean that begins anew and is larger by that is of motion that is
over. It rises to 1 as the mean gets older."""

_LASTING_BIAS = 0.03
"""As ``_BIAS``, of the mean over ``_LASTING`` blocks: half of its standard deviation where there is no motion."""

_SUDDEN = 16.0
"""c_k^2 over what the blocks before let expect of it, above which this block alone says how much motion there is."""

_MISFIT = 5.0
"""Standard deviations of the sum of squares that is left, above which the polynomial does not fit."""

LARGEST = 64
"""Samples a block up to which the colour of the noise makes the weights; of larger ones it makes the variance alone."""

_WIDEN = 1.0
"""Times what is left of the samples: the standard deviation of a misfit's error in the middle."""


class Fitted(NamedTuple):
    """``dots`` (C,) m at the stamp, their ``covariance`` (C, C) m^2, ``misfit``: the polynomial does not fit."""

    dots: tuple[float, ...]
    covariance: FloatArray
    misfit: bool


def basis(size: int, by: Arithmetic = FIXED) -> FloatArray:
    """Orthonormal polynomials (N, K) over the places 0 ... N - 1; at most one order for each four samples.

    Of 5 to 11 samples it is one for each two: a motion of 14 Hz and 0.3 mm bends them by more than their noise.
    """
    orders = min(ORDER, (size - 1) // (2 if 5 <= size < 12 else 4)) + 1
    u = np.asarray((np.arange(size) - 0.5 * (size - 1)) / max(0.5 * (size - 1), 0.5), dtype=np.float64)
    columns: list[FloatArray] = []
    column: FloatArray
    for k in range(orders):
        column = by.power_many(u, k)
        # Twice: once leaves rounding that shows.
        for _ in range(2):
            for q in columns:
                column = column - by.sum(q * column, 0) * q
        columns.append(column / by.root(float(by.sum(column * column, 0))))
    return np.stack(columns, axis=1)


class _Vibration(NamedTuple):
    """A tone as the fit meets it: in its combinations, ``covariance`` (C, C) m^2.

    ``waves`` (2, N): cosine and sine about the middle of the block. ``whole`` (C, K): what ``u`` of a whole block
    makes of the cosine; of the sine its symmetric weights make nothing.
    """

    covariance: FloatArray
    waves: FloatArray
    whole: FloatArray


class _Terms(NamedTuple):
    """What the samples that are present say of the coefficients, for K orders of which ``told`` can be told.

    ``q`` (n, K). ``u`` (C, n, K): precision times q. ``information`` (C, K, K): of the coefficients. ``v`` (C, told):
    variances of the first ones. ``all`` (C, n, K + told + n): u, u times the covariance of the first ones, precision.
    ``used``: orders above 0 that the middle needs. Once order 0, of which nothing is known beforehand, is taken out:
    ``rest`` (C, k, k) and ``right`` (C, k) are the equations of those; ``first`` (C,) and ``share`` (C, k) give its
    weight from theirs.
    """

    q: FloatArray
    u: FloatArray
    information: FloatArray
    v: FloatArray
    all: FloatArray
    used: slice
    rest: list[list[list[float]]]
    right: list[list[float]]
    first: list[float]
    share: list[list[float]]


def _terms(q: FloatArray, precision: FloatArray, middle: FloatArray, whole: bool, by: Arithmetic) -> _Terms:
    samples, orders = q.shape
    told = min(orders, (samples + 1) // 2)
    u = by.einsum('ast,tk->ask', precision, q)
    information = by.einsum('sj,ask->ajk', q, u)
    inverted = inverse(information[:, :told, :told])
    v = np.diagonal(inverted, axis1=1, axis2=2).copy()
    estimate = by.einsum('ask,akj->asj', u[:, :, :told], inverted)
    # In a whole block odd orders are 0 in the middle and uncorrelated with even ones.
    used = slice(2, told, 2) if whole else slice(1, told)
    own, mixed = information[:, 0, 0], information[:, 0, used]
    share = mixed / own[:, None]
    rest = (information[:, used, used] - share[:, :, None] * mixed[:, None, :]).tolist()
    right = (middle[used] - share * middle[0]).tolist()
    # In memory sample by sample: that is how they are summed.
    every = np.concatenate((u, estimate, precision), axis=2).transpose(1, 0, 2).copy().transpose(1, 0, 2)
    return _Terms(q, u, information, v, every, used, rest, right, (middle[0] / own).tolist(), share.tolist())


class BlockFit:
    """Fits block after block; see the module's text. It remembers how much motion there was."""

    def __init__(
        self,
        size: int,
        centers: FloatArray,
        beams: FloatArray,
        slopes: FloatArray | None = None,
        by: Arithmetic = FIXED,
    ) -> None:
        """``size``: N samples of a whole block. ``centers``, ``beams`` (P, 2) m, C = 2P.

        ``slopes``: as :func:`combinations_of` takes them.
        """
        self._size = size
        self._by = by
        self._q = basis(size, by)
        self._orders = self._q.shape[1]
        self._middle = _at_middle(self._q, by)
        self._count = 2 * len(centers)
        self._diagonal = np.arange(self._count)
        self._squares = np.zeros((self._count, self._orders))
        # Until motion is seen there was none.
        self._weight = np.ones((self._count, self._orders))
        self._gaps = False
        self._long = np.zeros((self._count, self._orders))
        self._blocks = np.full((self._count, self._orders), 1.0 / _FORGET)
        self.set_geometry(centers, beams, slopes)

    def set_geometry(self, centers: FloatArray, beams: FloatArray, slopes: FloatArray | None = None) -> None:
        """Use these places (P, 2), m, from now on; :meth:`set_noise` must follow."""
        self._combinations = combinations_of(centers, beams, slopes, by=self._by)

    def set_noise(self, gamma: FloatArray, tones: Sequence[Tone] = ()) -> None:
        """Use the autocovariance ``gamma`` (C, C, N) m^2 of the readings, and what vibrates."""
        by, turn = self._by, self._combinations.turn
        turned = by.einsum('ac,cdl,bd->abl', turn, gamma, turn)
        # The covariance with an earlier sample is the transposed one with a later.
        both = np.concatenate((turned.transpose(1, 0, 2)[:, :, :0:-1], turned), axis=2)
        self._between = np.lib.stride_tricks.sliding_window_view(both, self._size, axis=2)[:, :, :, ::-1]
        own = turned[self._diagonal, self._diagonal]
        self._precision = _precision(own, white=self._size > LARGEST)
        self._whole = _terms(self._q, self._precision, self._middle, True, by)
        self._bias, self._least = _BIAS * self._whole.v, 1e-9 * self._whole.v
        self._long_bias = _LASTING_BIAS * self._whole.v
        self._before: FloatArray | None = None
        u = self._whole.u
        self._of_whole = by.einsum('ask,absj->akbj', u, by.einsum('abts,btj->absj', self._between, u))
        self._vibrations = [self._vibration(tone) for tone in tones]

    def _vibration(self, tone: Tone) -> _Vibration:
        by, turn = self._by, self._combinations.turn
        angle = np.asarray(2.0 * pi * tone.frequency * (np.arange(self._size) - 0.5 * (self._size - 1)), np.float64)
        waves = np.stack((by.cos_many(angle), by.sin_many(angle)))
        covariance = by.einsum('ac,cd,bd->ab', turn, tone.covariance, turn)
        return _Vibration(covariance, waves, by.einsum('ask,s->ak', self._whole.u, waves[0]))

    def _left_of(self, vibration: _Vibration, x: FloatArray, weights: FloatArray | None) -> FloatArray:
        """Covariance (C, C), m^2, of what the answer leaves of a tone; ``weights`` (C, N) of a block with gaps."""
        by = self._by
        if weights is None:
            left = 1.0 - by.einsum('ak,ak->a', x, vibration.whole)
            return vibration.covariance * (left[:, None] * left)
        kept = by.einsum('as,ws->wa', weights, vibration.waves)
        left = 1.0 - kept[0]
        return np.asarray(vibration.covariance * (left[:, None] * left + kept[1][:, None] * kept[1]))

    def fit(self, slots: IntArray, dots: FloatArray) -> Fitted:
        """The dots at the middle of the block. ``slots`` (n,): which samples are present. ``dots`` (n, C), m."""
        by = self._by
        z = self._combinations.of(dots)
        # Of numbers about their mean: motion of millimetres leaves no rounding in what is left of it.
        offset = by.sum(z, 1) / len(slots)
        z -= offset[:, None]
        whole = len(slots) == self._size
        terms = self._whole if whole else _terms(self._q[slots], self._without(slots), self._middle, False, by)
        orders, told = self._orders, terms.v.shape[1]
        seen = by.einsum('asj,as->aj', terms.all, z)
        more = None
        if orders > 1:
            c = seen[:, orders : orders + told]
            motion = self._motion(c, terms.v)
            x, more = _weights(terms, motion, self._middle, by)
            left = len(slots) - told
            # In units of the noise: a chi-square of n - K degrees of freedom.
            squares = by.sum(z * seen[:, orders + told :], 1) - by.sum(seen[:, :told] * c, 1)
        else:
            x = np.array(terms.first)[:, None]
        value = by.sum(x * seen[:, :orders], 1) + offset
        weights: FloatArray | None = None
        if whole:
            covariance = by.einsum('ak,akbj,bj->ab', x, self._of_whole, x)
        else:
            weights = np.zeros((self._count, self._size))
            weights[:, slots] = by.einsum('ask,ak->as', terms.u, x)
            covariance = self._spread(weights)
        misfit = False
        if more is not None:
            limit = left + _MISFIT * by.root(2.0 * left)
            misfit = left > 0 and max(squares.tolist()) > limit
            if misfit:
                rest = z - by.einsum('sk,ak->as', terms.q[:, :told], c)
                more += np.where(squares > limit, _WIDEN * _WIDEN * by.sum(rest * rest, 1) / left, 0.0)
            covariance.flat[:: self._count + 1] += more
        for vibration in self._vibrations:
            covariance += self._left_of(vibration, x, weights)
        return Fitted(*self._combinations.back(value.tolist(), covariance), misfit)

    def state(self) -> tuple[float, ...]:
        """What :meth:`set_state` needs to go on from here."""
        own = (self._squares, self._weight, self._long, self._blocks)
        return tuple(v for one in own for v in one.ravel().tolist())

    def set_state(self, values: tuple[float, ...]) -> None:
        """Go on from :meth:`state` of another one. Raises ValueError where it is not of this block size."""
        wanted = 4 * self._squares.size
        if len(values) != wanted:
            raise ValueError(f'a fit of {self._size} samples a block has {wanted} values, not {len(values)}')
        parts = np.array(values).reshape(-1, self._count, self._orders)
        self._squares, self._weight, self._long, self._blocks = (part.copy() for part in parts)
        self._gaps, self._before = True, None

    def _without(self, slots: IntArray) -> FloatArray:
        """The precision (C, n, n) of the samples that are present: a block of a matrix's inverse, inverted."""
        lost = np.ones(self._size, dtype=bool)
        lost[slots] = False
        gone = np.flatnonzero(lost)
        p = self._precision
        cross = p[:, slots[:, None], gone]
        inner = inverse(p[:, gone[:, None], gone])
        return np.asarray(
            p[:, slots[:, None], slots]
            - self._by.einsum('asg,atg->ast', self._by.einsum('asg,agh->ash', cross, inner), cross)
        )

    def _motion(self, c: FloatArray, v: FloatArray) -> FloatArray:
        """tau^2 (C, K) after this block; order 0, of which nothing is known beforehand, is not meant.

        ``c``, ``v`` (C, told): coefficients and their variances of the orders that this block tells of.
        """
        told = v.shape[1]
        square = c * c
        excess = square - v
        before = self._before if self._before is not None else self._usual(self._late())
        squares, weight = self._squares[:, :told], self._weight[:, :told]
        sure: FloatArray | None = None
        if v is self._whole.v:
            squares += _FORGET * (excess - squares)
            if self._gaps:
                weight += _FORGET * (1.0 - weight)
        else:
            # A block with gaps says less the more noise its coefficients have.
            sure = np.minimum(self._whole.v[:, :told] / v, 1.0) ** 2
            squares += _FORGET * (sure * excess - squares)
            weight += _FORGET * (sure - weight)
            self._gaps = True
        late = self._late()
        self._remember(excess, sure, late[:, :told])
        self._before = self._usual(late)
        tau = self._before.copy()
        sudden = square > _SUDDEN * (v + before[:, :told])
        if np.count_nonzero(sudden):
            usual = tau[:, :told]
            np.maximum(excess, usual, out=usual, where=sudden)
        # What does not move with the link has no motion that this block alone tells of: that would be noise, chosen
        # for being large.
        still = slice(self._combinations.still, None)
        tau[still] = before[still]
        return tau

    def _late(self) -> FloatArray:
        """Mean of c_k^2 less its noise (C, K), of the blocks of late."""
        if not self._gaps:
            # All weights are 1.
            return self._squares
        return np.asarray(self._squares / np.maximum(self._weight, 1e-12))

    def _remember(self, excess: FloatArray, sure: FloatArray | None, late: FloatArray) -> None:
        """Take a block into the mean of what goes on alike; where that is over, begin with what is of ``late``."""
        told = late.shape[1]
        long, blocks, v = self._long[:, :told], self._blocks[:, :told], self._whole.v[:, :told]
        blocks += 1.0 if sure is None else sure
        np.minimum(blocks, _LASTING, out=blocks)
        step = excess - long
        step /= blocks
        if sure is not None:
            step *= sure
        long += step
        # Of the noise and the motion of late: three standard deviations of the short mean; less where both began alike.
        over = long - late > (_OVER + blocks * ((1.0 - _OVER) / _LASTING)) * (v + np.maximum(late, 0.0))
        if np.count_nonzero(over):
            long[over] = late[over]
            blocks[over] = 1.0 / _FORGET

    def _usual(self, late: FloatArray) -> FloatArray:
        """tau^2 (C, K) by the blocks so far; ``late``: by those of late."""
        usual = np.maximum(late - self._bias, self._least)
        return np.asarray(np.maximum(usual, self._long - self._long_bias))

    def _spread(self, weights: FloatArray) -> FloatArray:
        """Covariance (C, C) of the weighted sums; ``weights`` (C, N)."""
        by = self._by
        return by.einsum('as,abs->ab', weights, by.einsum('abts,bt->abs', self._between, weights))


def inverse(matrices: FloatArray) -> FloatArray:
    """Inverses of positive definite ``matrices`` (n, k, k), by elimination; no pivots are needed.

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


def _weights(terms: _Terms, motion: FloatArray, middle: FloatArray, by: Arithmetic) -> tuple[FloatArray, FloatArray]:
    """Weights (C, K) of the sums h in the middle, and the variance (C,), m^2, of the motion that they leave out.

    A few numbers: floats, of which numpy's calls would cost a multiple.
    """
    used, orders = terms.used, motion.shape[1]
    priors = (1.0 / motion[:, used]).tolist()
    rows = []
    more = []
    for rest, right, first, share, prior in zip(terms.rest, terms.right, terms.first, terms.share, priors, strict=True):
        found = _solved(rest, prior, right)
        # What the weights miss of an order is its weight times its prior's precision.
        missed = 0.0
        for w, p, s in zip(found, prior, share, strict=True):
            missed += w * w * p
            first -= s * w
        row = [0.0] * orders
        row[used] = found
        row[0] = first
        rows.append(row)
        more.append(missed)
    x, left_out = np.array(rows), np.array(more)
    told = terms.v.shape[1]
    if told < orders:
        # So few samples cannot tell of these.
        untold = middle[told:] - by.einsum('akj,aj->ak', terms.information[:, told:], x)
        left_out += by.sum(untold * untold * motion[:, told:], 1)
    return x, left_out


def _solved(matrix: list[list[float]], added: list[float], right: list[float]) -> list[float]:
    """x (k,) of ``matrix`` (k, k), positive definite once ``added`` is on its diagonal, times x = ``right`` (k,)."""
    size = len(right)
    x = right.copy()
    pivots: list[list[float]] = []
    for i, row in enumerate(matrix):
        row = row.copy()
        row[i] += added[i]
        for j, pivot in enumerate(pivots):
            factor = row[j] / pivot[j]
            for m in range(j + 1, size):
                row[m] -= factor * pivot[m]
            x[i] -= factor * x[j]
        pivots.append(row)
    for i in range(size - 1, -1, -1):
        row = pivots[i]
        for m in range(i + 1, size):
            x[i] -= row[m] * x[m]
        x[i] /= row[i]
    return x


def _precision(gamma: FloatArray, white: bool) -> FloatArray:
    """Inverse (C, N, N) of the covariance that ``gamma`` (C, N) stands for; of white noise as strong if ``white``."""
    size = gamma.shape[1]
    lags = np.abs(np.arange(size)[:, None] - np.arange(size))
    if not white:
        out = inverse(gamma[:, lags])
        if np.isfinite(out).all() and (np.diagonal(out, axis1=1, axis2=2) > 0.0).all():
            return out
    return np.asarray(np.eye(size) / gamma[:, :1, None])


def _at_middle(q: FloatArray, by: Arithmetic) -> FloatArray:
    """The polynomials' values (K,) in the middle of the block, between two places where N is even."""
    size, orders = q.shape
    u = (np.arange(size) - 0.5 * (size - 1)) / max(0.5 * (size - 1), 0.5)
    # Each is a combination of powers of u; the middle is u = 0, its constant term.
    powers = np.stack([by.power_many(u, k) for k in range(orders)], axis=1)
    return np.asarray(by.solve(by.product(powers.T, powers), by.product(powers.T, q))[0])
