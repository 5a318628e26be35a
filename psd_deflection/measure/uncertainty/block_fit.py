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

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.base.arithmetic.matrices import AT_ONCE, inverse
from psd_deflection.measure.uncertainty.combinations import combinations_of
from psd_deflection.measure.uncertainty.vibration import MATTERS, Tone
from psd_deflection.records import FloatArray, IntArray

ORDER = 4
"""Highest order: it follows a quarter period inside a block to 1e-4 of the amplitude."""

_FORGET = 1.0 / 12.0
"""Share of the newest block in the running mean of c_k^2. The energy of a mode of 14 Hz with 2 % of damping falls to
1/e in 14 blocks: a longer memory would weigh, and state, motion that is over."""

_BIAS = 0.5
"""Times v_k, taken off tau_k^2: a mean that cannot be negative is too large by about that where there is no motion."""

_GAPS = 0.15
"""Times what v_k of the last blocks is above that of a whole one, added to tau_k^2: so uncertain is what blocks with
gaps say of the motion."""

_BENT = 8e-4
"""Times the slope's c_1^2, of blocks of two samples: their mean's error while they move with 0.025 cycles a sample. Two
samples do not show how a motion bends."""

_LASTING = 250.0
"""Blocks, at the most, of the mean of motion that goes on alike: 5 s of 20 samples at 1 kHz. Its error is a fifth of
that of the short one, so that motion which bends a block by a fifth of its noise is distinguished from noise."""

_OVER = 0.35
"""Times the noise and the motion of late: a lasting mean that begins anew and is larger by that is of motion that is
over. It rises to 1 as the mean gets older."""

_LASTING_BIAS = 0.03
"""As ``_BIAS``, of the mean over ``_LASTING`` blocks: half of its standard deviation where there is no motion."""

_SUDDEN = 16.0
"""c_k^2 over what the blocks before let expect of it, above which this block alone says how much motion there is."""

_POOR_FIT = 3.5
"""Standard deviations of a normal distribution: chance alone makes a fit poor once in 4,300 of each combination."""

_CONTRADICTED = 3.0
"""Standard deviations of the chi-square of all coefficients of a block with gaps above which they contradict what the
blocks before let expect."""

LARGEST = 64
"""Samples a block up to which the colour of the noise makes the weights; of larger ones it makes the variance alone."""

_WIDEN = 1.0
"""Times what is left of the samples: the standard deviation of a poor fit's error in the middle."""


class MotionMemory(NamedTuple):
    """What is known of the motion after a block. ``recent`` (2, K, C): running mean of c_k^2 less its noise, m^2, and
    its weight; ``lasting`` (2, K, C): mean of motion that goes on alike, m^2, and over how many blocks.
    """

    recent: FloatArray
    lasting: FloatArray


class FittedBlock(NamedTuple):
    """``dots`` (C,) m at the stamp, their ``covariance`` (C, C) m^2, ``poor_fit``: the polynomial does not fit,
    ``vibrating``: which tones, from 0, are a share of ``MATTERS`` of the covariance, ``memory``: after this block."""

    dots: tuple[float, ...]
    covariance: FloatArray
    poor_fit: bool
    vibrating: tuple[int, ...]
    memory: MotionMemory


class FittedRun(NamedTuple):
    """B blocks that were fitted together: of each what a :class:`FittedBlock` has; ``covariance`` (B, C, C)."""

    dots: list[tuple[float, ...]]
    covariance: FloatArray
    poor_fit: list[bool]
    vibrating: list[tuple[int, ...]]
    memories: Sequence[MotionMemory]

    def block(self, at: int) -> FittedBlock:
        """Return the fit of block ``at`` (from 0)."""
        return FittedBlock(self.dots[at], self.covariance[at], self.poor_fit[at], self.vibrating[at], self.memories[at])


def basis(size: int, xp: Arithmetic = FIXED) -> FloatArray:
    """Orthonormal polynomials (N, K) over the places 0 ... N - 1; at most one order for each four samples.

    Of 5 to 16 samples it is one for each two: a motion of 14 Hz and 0.3 mm bends them by more than their noise. Of 3
    and 4 samples it is a parabola, of 2 a line.
    """
    orders = size if size < 4 else min(ORDER, max((size - 1) // (2 if size < 17 else 4), 2)) + 1
    u = np.asarray((np.arange(size) - 0.5 * (size - 1)) / max(0.5 * (size - 1), 0.5), dtype=np.float64)
    columns: list[FloatArray] = []
    column: FloatArray
    for k in range(orders):
        column = xp.power_many(u, k)
        # Twice: once leaves rounding that shows.
        for _ in range(2):
            for q in columns:
                column = column - xp.sum(q * column, 0) * q
        columns.append(column / xp.root(float(xp.sum(column * column, 0))))
    return np.stack(columns, axis=1)


class _Vibration(NamedTuple):
    """A tone as the fit meets it: in its combinations, ``covariance`` (C, C) m^2.

    ``waves`` (2, N): cosine and sine about the middle of the block. ``full`` (C, K): what ``u`` of a whole block
    makes of the cosine; of the sine its symmetric weights make nothing.
    """

    covariance: FloatArray
    waves: FloatArray
    full: FloatArray


class _Terms(NamedTuple):
    """What the n samples that are present say of the coefficients of K orders, of which they determine the first R.

    ``q`` (n, K). ``u`` (C, n, K): precision times q. ``information`` (C, K, K): of the coefficients. ``v`` (R, C):
    variances of the first R; ``sure`` (R, C): how much a block says of them, 1 of a whole one. ``all``
    (n, K + R + n, C): u, u times the covariance of the first R, precision. ``used``: orders above 0 that the middle
    needs. Once order 0, of which nothing is known beforehand, is taken out: ``rest`` (k, k, C) and ``right`` (k, C)
    are the equations of those; ``first`` (C,) and ``share`` (k, C) give its weight from theirs. ``together``
    (C, R - 1, R - 1): covariances of orders 1 to R - 1.
    """

    q: FloatArray
    u: FloatArray
    information: FloatArray
    v: FloatArray
    sure: FloatArray
    all: FloatArray
    used: slice
    rest: FloatArray
    right: FloatArray
    first: FloatArray
    share: FloatArray
    together: FloatArray


def _terms(
    q: FloatArray, precision: FloatArray, middle: FloatArray, usual_v: FloatArray | None, xp: Arithmetic
) -> _Terms:
    """``usual_v`` (K, C): ``v`` of a whole block, None for one."""
    samples, orders = q.shape
    reported = orders if usual_v is None else min(orders, (samples + 1) // 2)
    u = xp.einsum('ast,tk->ask', precision, q)
    information = xp.einsum('sj,ask->ajk', q, u)
    inverted = inverse(information[:, :reported, :reported])
    v = np.diagonal(inverted, axis1=1, axis2=2).T.copy()
    # A block with gaps says less the more noise its coefficients have.
    sure = np.ones(v.shape) if usual_v is None else np.minimum(usual_v[:reported] / v, 1.0) ** 2
    estimate = xp.einsum('ask,akj->asj', u[:, :, :reported], inverted)
    # In a whole block odd orders are 0 in the middle and uncorrelated with even ones.
    used = slice(2, reported, 2) if usual_v is None else slice(1, reported)
    mean_info, mixed = information[:, 0, 0], information[:, 0, used].T
    share = mixed / mean_info
    rest = information[:, used, used].transpose(1, 2, 0) - share[:, None] * mixed
    right = middle[used, None] - share * middle[0]
    every = np.concatenate((u, estimate, precision), axis=2).transpose(1, 2, 0).copy()
    return _Terms(
        q, u, information, v, sure, every, used, rest, right, middle[0] / mean_info, share, inverted[:, 1:, 1:]
    )


class BlockFit:
    """Fits blocks with the present noise; see the module's text. ``memory``: of the motion before the next block.

    The bits of a block do not depend on how many are computed together.
    """

    def __init__(
        self,
        size: int,
        centers: FloatArray,
        beams: FloatArray,
        slopes: FloatArray | None = None,
        xp: Arithmetic = FIXED,
    ) -> None:
        """``size``: N samples of a whole block. ``centers``, ``beams`` (P, 2) m, C = 2P.

        ``slopes``: as :func:`combinations_of` takes them.
        """
        self._size = size
        self._xp = xp
        self._q = basis(size, xp)
        self._orders = self._q.shape[1]
        self._middle = _at_middle(self._q, xp)
        self._count = 2 * len(centers)
        self._diagonal = np.arange(self._count)
        nothing = np.zeros((self._orders, self._count))
        # Until motion is seen there was none.
        self.memory = MotionMemory(np.stack((nothing, nothing + 1.0)), np.stack((nothing, nothing + 1.0 / _FORGET)))
        self.set_geometry(centers, beams, slopes)

    def set_geometry(self, centers: FloatArray, beams: FloatArray, slopes: FloatArray | None = None) -> None:
        """Use these places (P, 2), m, from now on; :meth:`set_noise` must follow."""
        self._combinations = combinations_of(centers, beams, slopes, xp=self._xp)

    def set_noise(self, gamma: FloatArray, tones: Sequence[Tone] = ()) -> None:
        """Use the autocovariance ``gamma`` (C, C, N) m^2 of the readings, and what vibrates."""
        xp, matrix = self._xp, self._combinations.matrix
        rotated = xp.einsum('ac,cdl,bd->abl', matrix, gamma, matrix)
        # The covariance with an earlier sample is the transposed one with a later.
        both = np.concatenate((rotated.transpose(1, 0, 2)[:, :, :0:-1], rotated), axis=2)
        self._between = np.lib.stride_tricks.sliding_window_view(both, self._size, axis=2)[:, :, :, ::-1]
        autocovariance = rotated[self._diagonal, self._diagonal]
        self._precision = _precision(autocovariance, white=self._size > LARGEST)
        self._full = _terms(self._q, self._precision, self._middle, None, xp)
        u = self._full.u
        self._of_full = xp.einsum('ask,absj->kjab', u, xp.einsum('abts,btj->absj', self._between, u))
        self._vibrations = [self._vibration(tone) for tone in tones]

    def _vibration(self, tone: Tone) -> _Vibration:
        xp, matrix = self._xp, self._combinations.matrix
        angle = np.asarray(2.0 * pi * tone.frequency * (np.arange(self._size) - 0.5 * (self._size - 1)), np.float64)
        waves = np.stack((xp.cos_many(angle), xp.sin_many(angle)))
        covariance = xp.einsum('ac,cd,bd->ab', matrix, tone.covariance, matrix)
        return _Vibration(covariance, waves, xp.einsum('ask,s->ak', self._full.u, waves[0]))

    def _residual_of(self, vibration: _Vibration, x: FloatArray, weights: FloatArray | None) -> FloatArray:
        """Covariance (B, C, C), m^2, of what the answers leave of a tone; ``weights`` (B, C, N) of blocks with gaps."""
        xp = self._xp
        if weights is None:
            residual = 1.0 - xp.einsum('kza,ak->za', x, vibration.full)
            return np.asarray(vibration.covariance * (residual[:, :, None] * residual[:, None, :]))
        response = xp.einsum('zas,ws->wza', weights, vibration.waves)
        residual, sine = 1.0 - response[0], response[1]
        both = residual[:, :, None] * residual[:, None, :] + sine[:, :, None] * sine[:, None, :]
        return np.asarray(vibration.covariance * both)

    def fit(self, slots: IntArray, dots: FloatArray) -> FittedBlock:
        """Return the fit of one block, and remember its motion.

        ``slots`` (n,): which samples are present. ``dots`` (n, C), m.
        """
        (run,) = self.fit_blocks(slots, dots[None])
        self.memory = run.memories[0]
        return run.block(0)

    def fit_blocks(self, slots: IntArray, dots: FloatArray, memory: MotionMemory | None = None) -> list[FittedRun]:
        """Return the fits of B blocks in turn, without remembering their motion.

        ``slots`` (n,): which samples the blocks have. ``dots`` (B, n, C), m. ``memory``: before them, None for ours.
        """
        full = len(slots) == self._size
        # Sums over more numbers than that take another order.
        most = max(AT_ONCE // dots[0].size, 1) if full else 1
        terms = self._full if full else self._terms_without(slots)
        runs: list[FittedRun] = []
        memory = self.memory if memory is None else memory
        for at in range(0, len(dots), most):
            runs.append(self._run(terms, slots, dots[at : at + most], memory))
            memory = runs[-1].memories[-1]
        return runs

    def _run(self, terms: _Terms, slots: IntArray, dots: FloatArray, memory: MotionMemory) -> FittedRun:
        """The fits of blocks of which none has a sum over more than ``AT_ONCE`` numbers."""
        xp, count = self._xp, self._count
        blocks, samples, _ = dots.shape
        # Samples first, then orders, blocks and combinations: sums are over what is first.
        z = self._combinations.of(dots.swapaxes(0, 1).reshape(-1, count)).T.reshape(samples, blocks, count)
        # Of numbers about their mean: motion of millimetres leaves no rounding in what is left of it.
        offset = xp.sum(z, 0) / samples
        z = z - offset
        orders, reported = self._orders, len(terms.v)
        observed = xp.einsum('sja,sza->jza', terms.all, z)
        c = observed[orders : orders + reported]
        memories, motion = self._motion(c, terms, memory)
        x, missed = _weights(terms, motion, self._middle, xp)
        value = xp.sum(x * observed[:orders], 0) + offset
        weights: FloatArray | None = None
        if terms is self._full:
            covariance = xp.einsum('kza,kjab,jzb->zab', x, self._of_full, x)
        else:
            weights = np.zeros((blocks, count, self._size))
            weights[:, :, slots] = xp.einsum('ask,kza->zas', terms.u, x)
            covariance = self._covariance_of(weights)
        poor_fit = [False] * blocks
        if orders > 1:
            free = samples - reported
            # In units of the noise: a chi-square of n - K degrees of freedom.
            squares = xp.sum(z * observed[orders + reported :], 0) - xp.sum(observed[:reported] * c, 0)
            over = squares > _poor_fit(free)
            if np.count_nonzero(over):
                poor_fit = [any(row) for row in over.tolist()]
                rest = z - xp.einsum('sk,kza->sza', terms.q[:, :reported], c)
                missed += np.where(over, _WIDEN * _WIDEN * xp.sum(rest * rest, 0) / free, 0.0)
            if self._size == 2:
                missed += _BENT * motion[1]
            covariance[:, self._diagonal, self._diagonal] += missed
        vibrating: list[tuple[int, ...]] = [()] * blocks
        if self._vibrations:
            vibrating = self._vibrate(covariance, x, weights)
        rows, covariance = self._combinations.back(value, covariance)
        return FittedRun(list(map(tuple, rows.tolist())), covariance, poor_fit, vibrating, memories)

    def _vibrate(self, covariance: FloatArray, x: FloatArray, weights: FloatArray | None) -> list[tuple[int, ...]]:
        """Add what vibrates to the ``covariance`` (B, C, C) of blocks; for each the tones that matter there."""
        parts = [self._residual_of(vibration, x, weights) for vibration in self._vibrations]
        for part in parts:
            covariance += part
        limit = MATTERS * covariance[:, self._diagonal, self._diagonal]
        matters = np.stack([(part[:, self._diagonal, self._diagonal] > limit).any(axis=1) for part in parts], axis=1)
        return [tuple(np.flatnonzero(row).tolist()) for row in matters]

    def state(self) -> tuple[float, ...]:
        """What :meth:`set_state` needs to go on from here."""
        return tuple(np.concatenate(self.memory).swapaxes(1, 2).ravel().tolist())

    def set_state(self, values: tuple[float, ...]) -> None:
        """Go on from :meth:`state` of another one. Raises ValueError where it is not of this block size."""
        wanted = 4 * self._count * self._orders
        if len(values) != wanted:
            raise ValueError(f'a fit of {self._size} samples a block has {wanted} values, not {len(values)}')
        self.memory = MotionMemory(*np.array(values).reshape(2, 2, self._count, self._orders).swapaxes(2, 3))

    def _terms_without(self, slots: IntArray) -> _Terms:
        """Of the samples that are present: their precision is a block of a matrix's inverse, inverted."""
        lost = np.ones(self._size, dtype=bool)
        lost[slots] = False
        gone = np.flatnonzero(lost)
        p = self._precision
        cross = p[:, slots[:, None], gone]
        inner = inverse(p[:, gone[:, None], gone])
        xp = self._xp
        schur = p[:, slots[:, None], slots] - xp.einsum('asg,atg->ast', xp.einsum('asg,agh->ash', cross, inner), cross)
        return _terms(self._q[slots], schur, self._middle, self._full.v, xp)

    def _motion(self, c: FloatArray, terms: _Terms, memory: MotionMemory) -> tuple[Sequence[MotionMemory], FloatArray]:
        """Return the memory after each block, and tau^2 (K, B, C) by it; of order 0 nothing is known beforehand.

        ``c`` (R, B, C): coefficients of the orders that the blocks determine. ``memory``: before them.
        """
        c = c.swapaxes(0, 1)
        if self._orders == 1:
            return [memory] * len(c), c.swapaxes(0, 1)
        reported, usual_v = c.shape[1], self._full.v
        square = c * c
        excess = square - terms.v
        recent = _recent_after(memory.recent, excess, terms.sure)
        share = np.maximum(recent[:, 1], 1e-12)
        late = recent[:, 0] / share
        # Of the noise and the motion of late.
        expected = usual_v[:reported] + np.maximum(late[1:, :reported], 0.0)
        lasting = _lasting_after(memory.lasting, excess, terms.sure, late[1:, :reported], expected)
        bias = _BIAS - _GAPS * (1.0 / np.sqrt(share) - 1.0)
        usual = np.maximum(late - bias * usual_v, 1e-9 * usual_v)
        np.maximum(usual, lasting[:, 0] - _LASTING_BIAS * usual_v, out=usual)
        before, tau = usual[:-1], usual[1:].copy()
        sudden = square > _SUDDEN * (terms.v + before[:, :reported])
        np.maximum(excess, tau[:, :reported], out=tau[:, :reported], where=sudden)
        if terms is not self._full and reported > 1:
            self._believe(c, terms, tau)
        # What does not move with the link has no motion that this block alone tells of: that would be noise, chosen
        # for being large.
        still = self._combinations.still
        tau[:, :, still:] = before[:, :, still:]
        return list(map(MotionMemory, recent[1:], lasting[1:])), tau.swapaxes(0, 1)

    def _believe(self, c: FloatArray, terms: _Terms, tau: FloatArray) -> None:
        """Give ``tau`` (B, K, C) what a block alone says where its coefficients ``c`` contradict it together.

        Those of a block with gaps depend on each other: each may be within its noise, and all of them not.
        """
        blocks, reported, count = c.shape
        higher, usual = c[:, 1:], tau[:, 1:reported]
        expected = terms.together + usual.swapaxes(1, 2)[..., None] * np.eye(reported - 1)
        inverted = inverse(expected.reshape(-1, reported - 1, reported - 1)).reshape(
            blocks, count, reported - 1, reported - 1
        )
        squares = self._xp.einsum('zja,zajk,zka->za', higher, inverted, higher)
        over = squares > reported - 1 + _CONTRADICTED * self._xp.root(2.0 * (reported - 1))
        np.maximum(usual, higher * higher + terms.v[1:], out=usual, where=over[:, None])

    def _covariance_of(self, weights: FloatArray) -> FloatArray:
        """Covariance (B, C, C) of the weighted sums; ``weights`` (B, C, N)."""
        xp = self._xp
        return xp.einsum('zas,zabs->zab', weights, xp.einsum('abts,zbt->zabs', self._between, weights))


def _recent_after(recent: FloatArray, excess: FloatArray, sure: FloatArray) -> FloatArray:
    """:attr:`MotionMemory.recent` (B + 1, 2, K, C) before the first block and after each.

    ``excess`` (B, R, C): c_k^2 less its noise; ``sure`` (R, C): how much a block says of it.
    """
    reported = len(sure)
    out = np.empty((len(excess) + 1, *recent.shape))
    out[0] = recent
    news = np.empty((len(excess), 2, *sure.shape))
    news[:, 0], news[:, 1] = sure * excess, sure
    for before, after, new in zip(out, out[1:], news, strict=False):
        after[:] = before
        determined = after[:, :reported]
        determined += _FORGET * (new - determined)
    return out


def _lasting_after(
    lasting: FloatArray, excess: FloatArray, sure: FloatArray, late: FloatArray, expected: FloatArray
) -> FloatArray:
    """:attr:`MotionMemory.lasting` (B + 1, 2, K, C) before the first block and after each; what is over begins anew.

    ``late`` (B, R, C): the mean of late; ``expected`` (B, R, C): with the noise.
    """
    reported = len(sure)
    out = np.empty((len(excess) + 1, *lasting.shape))
    out[0] = lasting
    for before, after, new, short, limit in zip(out, out[1:], excess, late, expected, strict=False):
        after[:] = before
        mean, blocks = after[:, :reported]
        blocks += sure
        np.minimum(blocks, _LASTING, out=blocks)
        mean += (new - mean) / blocks * sure
        # Three standard deviations of the short mean; less where both began alike.
        over = mean - short > (_OVER + blocks * ((1.0 - _OVER) / _LASTING)) * limit
        if np.count_nonzero(over):
            mean[over] = short[over]
            blocks[over] = 1.0 / _FORGET
    return out


def _weights(terms: _Terms, motion: FloatArray, middle: FloatArray, xp: Arithmetic) -> tuple[FloatArray, FloatArray]:
    """Weights (K, B, C) of the sums h in the middle, and the variance (B, C), m^2, of the motion that they leave out.

    ``motion``: tau^2 (K, B, C).
    """
    reported, used = len(terms.v), terms.used
    priors = 1.0 / motion[used]
    solution = _solved(terms.rest, priors, terms.right)
    x, missed = np.zeros(motion.shape), np.zeros(motion.shape[1:])
    first: FloatArray = terms.first
    # What the weights miss of an order is its weight times its prior's precision.
    for w, prior, share in zip(solution, priors, terms.share, strict=True):
        missed += w * w * prior
        first = first - share * w
    x[0] = first
    if solution:
        x[used] = solution
    if reported < len(motion):
        # So few samples do not determine these orders.
        undetermined = middle[reported:, None, None] - xp.einsum('akj,jza->kza', terms.information[:, reported:], x)
        missed += xp.sum(undetermined * undetermined * motion[reported:], 0)
    return x, missed


def _solved(matrix: FloatArray, added: FloatArray, right: FloatArray) -> list[FloatArray]:
    """The k unknowns (B, C) of ``matrix`` (k, k, C), positive definite once ``added`` (k, B, C) is on its diagonal,
    times them = ``right`` (k, C).
    """
    rows: list[list[FloatArray]] = []
    x: list[FloatArray] = []
    for i, (line, more, rhs) in enumerate(zip(matrix, added, right, strict=True)):
        row = list(line)
        row[i] = row[i] + more
        for j, pivot in enumerate(rows):
            factor = row[j] / pivot[j]
            for m in range(j + 1, len(row)):
                row[m] = row[m] - factor * pivot[m]
            rhs = rhs - factor * x[j]
        rows.append(row)
        x.append(rhs)
    for i in range(len(x) - 1, -1, -1):
        for m in range(i + 1, len(x)):
            x[i] = x[i] - rows[i][m] * x[m]
        x[i] = x[i] / rows[i][i]
    return x


def _poor_fit(free: int) -> float:
    """Return the sum of squares above which the polynomial does not fit (Wilson & Hilferty 1931)."""
    if not free:
        return np.inf
    cube_root = 1.0 - 2.0 / (9.0 * free) + _POOR_FIT * FIXED.root(2.0 / (9.0 * free))
    return free * cube_root * cube_root * cube_root


def _precision(gamma: FloatArray, white: bool) -> FloatArray:
    """Inverse (C, N, N) of the covariance that ``gamma`` (C, N) stands for; of white noise as strong if ``white``."""
    size = gamma.shape[1]
    lags = np.abs(np.arange(size)[:, None] - np.arange(size))
    if not white:
        out = inverse(gamma[:, lags])
        if np.isfinite(out).all() and (np.diagonal(out, axis1=1, axis2=2) > 0.0).all():
            return out
    return np.asarray(np.eye(size) / gamma[:, :1, None])


def _at_middle(q: FloatArray, xp: Arithmetic) -> FloatArray:
    """The polynomials' values (K,) in the middle of the block, between two places where N is even."""
    size, orders = q.shape
    u = (np.arange(size) - 0.5 * (size - 1)) / max(0.5 * (size - 1), 0.5)
    # Each is a combination of powers of u; the middle is u = 0, its constant term.
    powers = np.stack([xp.power_many(u, k) for k in range(orders)], axis=1)
    return np.asarray(xp.solve(xp.product(powers.T, powers), xp.product(powers.T, q))[0])
