# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The noise of the readings, measured in the stream: how they vary about a link at rest.

What an estimate's covariance needs is the variance of a weighted mean over one block, so colour
counts as much as size: gamma_cd(l), the covariance of reading c with reading d l samples later, for
l from 0 to N - 1. It is measured in segments of 50 blocks; each segment's mean and slope are taken
off, and with them two degrees of freedom of what is slow in it, which are put back (what is slow: the variance of
means over 5 blocks, in which little is left of hum).

Motion is no noise. The readings are more than the unknowns, and one combination of them (of two PSDs: how much longer
the base line between the dots is than that between the beams) holds still whatever the plate does. A
segment is at rest where no combination that moves with the link has a block mean that varies much
more, against its roughness inside the blocks, than the one that does not move. During motion the
values of the last rest hold, times what that combination's roughness has become if it is other in
segment after segment. Hum is taken off the readings before, and its own tone added afterwards.
Before there was any rest, the roughness inside the blocks gives each reading's size, and the
combination that does not move gives the colour.

A converter's steps set the least noise: rounding to steps of q is noise of variance q^2/12 a sample
(Widrow & Kollar, Quantization Noise, 2008), and what the noise does not dither stays as an error
that no mean removes, of variance sum_k q^2/(2 pi^2 k^2) exp(-4 pi^2 k^2 s^2/q^2) for noise s (ibid.,
the characteristic function of the noise at multiples of 2 pi/q).
"""

import itertools
from math import pi

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.base.arithmetic.matrices import inverse
from psd_deflection.base.arithmetic.spectra import lagged_products
from psd_deflection.measure.averaging import SEGMENT_BLOCKS
from psd_deflection.measure.uncertainty.block_fit import LARGEST, basis
from psd_deflection.measure.uncertainty.combinations import Residual, combinations_of
from psd_deflection.measure.uncertainty.drift import Drift
from psd_deflection.measure.uncertainty.vibration import Hum, Tone, ToneSearch
from psd_deflection.records import FloatArray, IntArray

_FAR = 5
"""Blocks over whose means what is slow is measured."""

STATED_SEGMENTS = 2
"""Segments after which measured noise is used: two seconds at 50 blocks a second."""

_LEAST_SHARE = 0.5
"""A segment of which fewer samples are present tells nothing."""

_PAIRS = 0.4
"""Least share of pairs of samples that are both present, of the samples that are."""

_HEAD = 6
"""Numbers of a state before the average."""

_SHARES = (0.0, 0.03, 0.1, 0.3, 1.0)
"""Parts of the sure autocovariance that are tried."""

_LONGEST = 20
"""Segments that the running mean remembers."""

_OWN_SHARE = 1e-3
"""Share of the loudest reading's variance that each reading has for itself: readings that say the same leave no
combination without noise, which nothing could be weighted by."""

_LEAST = 1e-24
"""m^2: (1 pm)^2. A stream of constant numbers has that much noise too."""

_MOTION = 4.0
"""Times more variance of the block means than roughness explains: motion. Chance does it once in 10^6."""

_RISEN = 2.0
"""Times the variance so far: motion, or more noise. Chance does it once in 10^5 segments."""

_FALLEN = 0.4
"""Times the variance so far: what was taken for noise was motion, or the noise is less now."""

_PATIENCE = 3
"""Segments in a row at rest and louder, or in which what does not move has ``_OTHER`` noise: the noise is other now."""

_OTHER = 1.4
"""Times the roughness so far of what does not move, or the inverse. Chance does it once in 10^7 segments."""


class StreamNoise:
    """Autocovariance of the C readings x1, y1, x2, y2 ..., m; see the module's text.

    ``gamma`` (C, C, N): what to compute with, the converter's share included, m^2. ``measured``: whether
    it comes from the stream; until then it is the rig file's. ``at_rest``: whether the stream was ever
    seen at rest. ``tones``: of the last segment, what vibrates; () unless it is asked for.
    """

    def __init__(
        self,
        size: int,
        centers: FloatArray,
        beams: FloatArray,
        variances: FloatArray | float,
        steps: FloatArray | float,
        slopes: FloatArray | None = None,
        residual: Residual | None = None,
        xp: Arithmetic = FIXED,
    ) -> None:
        """``size``: N. ``centers``, ``beams`` (P, 2) m. Of each reading (C,), or of all: ``variances`` m^2 of a sample
        by the rig file, ``steps`` m of the converter. ``slopes``, ``residual``: as :func:`combinations_of` takes them.
        """
        self._size = size
        self._xp = xp
        count = self._readings = 2 * len(centers)
        self._wanted = _HEAD + count * count * size
        self._stated = np.broadcast_to(variances, (count,))
        self._steps = np.broadcast_to(steps, (count,))
        # Motion is judged with the largest.
        self._step = float(self._steps.max())
        self.set_geometry(centers, beams, slopes, residual)
        self._mean_of = _mean_weights(size)
        self._q = basis(size, xp)
        self._sums: list[FloatArray] = []  # Bound: emptied with the blocks.
        self._signals = 0
        self._search: ToneSearch | None = None
        self.tones: tuple[Tone, ...] = ()
        self.candidates: tuple[float, ...] = ()
        self.hum: tuple[Hum, ...] = ()
        self.drift = Drift(count, xp)
        self._average: FloatArray | None = None
        self._sure = np.ones(size)
        self._count = 0
        self._observed = 0
        self._louder = self._other = 0
        self._rough = 0.0
        self.at_rest = False
        self._segment = -1
        self._blocks: list[tuple[int, IntArray, FloatArray]] = []  # Bound: emptied when it is full.
        self.gamma = self._from_file()

    def set_steps(self, steps: FloatArray) -> None:
        """Use the converter's ``steps`` (C,), m, from now on."""
        self._steps = steps
        self._step = float(steps.max())
        self.gamma = self._in_use()

    def look_for_tones(self, sums: int) -> None:
        """From now on; so many sum signals are told with the readings."""
        self._signals = sums
        self._search = ToneSearch(self._size, SEGMENT_BLOCKS, self._xp)

    def set_geometry(
        self, centers: FloatArray, beams: FloatArray, slopes: FloatArray | None = None, residual: Residual | None = None
    ) -> None:
        """Use these places, m, from now on."""
        self._combinations = combinations_of(centers, beams, slopes, residual, self._xp)
        self._moving = self._combinations.matrix[: self._combinations.moving]

    @property
    def measured(self) -> bool:
        """Whether ``gamma`` comes from the stream."""
        return self._observed >= STATED_SEGMENTS

    def sample_sd(self) -> FloatArray:
        """Standard deviation (C,), m, of one sample."""
        return np.asarray(np.sqrt(self.gamma[range(self._readings), range(self._readings), 0]))

    def _own(self, gamma: FloatArray) -> FloatArray:
        """The autocovariance (C, N) of each reading with itself."""
        return gamma[range(self._readings), range(self._readings)]

    def _least(self) -> float:
        """Variance, m^2, that a sample has at least."""
        return self._xp.square(self._step) / 12.0 + _LEAST

    def mean_sd(self) -> FloatArray:
        """Standard deviation (C,), m, of the mean of a whole block."""
        return np.asarray(np.sqrt(self._xp.einsum('cl,l->c', self._own(self.gamma), self._mean_of)))

    def add(self, index: int, slots: IntArray, dots: FloatArray, sums: FloatArray | None = None) -> bool:
        """A block's samples; True where they ended a segment that changed ``gamma``.

        ``index``: the block's number. ``slots`` (n,): which of its N samples are present. ``dots`` (n, C), m. ``sums``
        (n, P): the sum signals as dots of as many volts, m; they are needed if tones are looked for.
        """
        changed = False
        segment = index // SEGMENT_BLOCKS
        if segment != self._segment:
            changed = self._close()
            if segment > self._segment + 1:
                self.drift.interrupt()
            self._segment = segment
        self._blocks.append((index, slots, dots))
        if self._search is not None:
            self._sums.append(np.zeros((len(slots), self._signals)) if sums is None else sums)
        if index % SEGMENT_BLOCKS == SEGMENT_BLOCKS - 1:
            changed |= self._close()
        return changed

    @property
    def buffered(self) -> int:
        """How many numbers :meth:`segment` has."""
        return sum(2 + len(slots) + dots.size for _, slots, dots in self._blocks) + sum(s.size for s in self._sums)

    def segment(self) -> tuple[float, ...]:
        """The blocks of the segment under way: number, how many samples, their places, their dots, of each.

        Empty between two segments.
        """
        out: list[float] = []
        for index, slots, dots in self._blocks:
            out += [index, len(slots), *slots.tolist(), *dots.ravel().tolist()]
        return tuple(out)

    def sums(self) -> tuple[float, ...]:
        """The sum signals of the blocks of :meth:`segment`, in their order; empty if tones are not looked for."""
        return tuple(v for sums in self._sums for v in sums.ravel().tolist())

    def set_segment(self, values: tuple[float, ...], sums: tuple[float, ...] = ()) -> None:
        """Go on with the :meth:`segment` and the :meth:`sums` of another one.

        Raises ValueError if they are of other readings. One that looked for no tones has told no sums: without them no
        tone of this segment is hum.
        """
        blocks = []
        at = 0
        while at < len(values):
            index, count = (int(v) for v in (*values[at : at + 2], 0)[:2])
            dots = at + 2 + count
            at = dots + count * self._readings
            if not 0 < count <= self._size or at > len(values):
                raise ValueError(f'blocks of {self._readings} readings, {self._size} samples each')
            slots = np.array(values[dots - count : dots], dtype=np.int64)
            blocks.append((index, slots, np.array(values[dots:at], dtype=np.float64).reshape(count, -1)))
        counts = [len(slots) for _, slots, _ in blocks]
        if self._search is not None:
            rows = np.zeros((sum(counts), self._signals))
            if sums:
                if len(sums) != rows.size:
                    raise ValueError(f'{rows.size} sum signals of the same blocks')
                rows = np.reshape(sums, rows.shape)
            self._sums = np.split(rows, list(itertools.accumulate(counts))[:-1]) if counts else []
        self._blocks = blocks
        self._segment = blocks[-1][0] // SEGMENT_BLOCKS if blocks else -1

    def state(self) -> tuple[float, ...]:
        """What :meth:`set_state` needs to go on from here."""
        counts = (self._observed, self._count, self._louder, self._other, self.at_rest)
        head = (*map(float, counts), self._rough)
        return head if self._average is None else (*head, *self._average.ravel().tolist(), *self._sure.tolist())

    def set_state(self, values: tuple[float, ...]) -> None:
        """Go on from :meth:`state` of another one. Raises ValueError where it is not of this block size."""
        wanted = self._wanted + self._size
        if len(values) not in (_HEAD, wanted):
            raise ValueError(f'noise of {self._size} samples a block has {wanted} values, not {len(values)}')
        self._observed, self._count, self._louder, self._other, at_rest = (int(v) for v in values[:5])
        self.at_rest, self._rough = bool(at_rest), values[5]
        average = np.array(values[_HEAD : self._wanted])
        self._average = average.reshape(self._readings, self._readings, -1) if len(values) > _HEAD else None
        self._sure = np.array(values[self._wanted :]) if len(values) > self._wanted else np.ones(self._size)
        self.gamma = self._in_use()

    def _from_file(self) -> FloatArray:
        count = self._readings
        gamma = np.zeros((count, count, self._size))
        gamma[range(count), range(count), 0] = self._stated
        return self._with_steps(gamma)

    def _in_use(self) -> FloatArray:
        if self._average is None or not self.measured:
            gamma = self._from_file()
        else:
            # Of the average: each segment alone is so uncertain that much would be taken off its colour.
            gamma = self._with_steps(_covariance(self._average, self._sure, self._xp))
        for hum in self.hum:
            gamma = gamma + hum.autocovariance(self._size, self._xp)
        return gamma

    def _with_steps(self, gamma: FloatArray) -> FloatArray:
        out = gamma.copy()
        for c, (stated, step) in enumerate(zip(self._stated.tolist(), self._steps.tolist(), strict=True)):
            rounding = self._xp.square(step) / 12.0
            level = max(float(out[c, c, 0]), rounding)
            out[c, c, 0] = level
            # More than the rig file's noise does not dither with certainty: a reading on the edge between
            # two steps varies by half a step with next to no noise.
            out[c, c] += undithered(min(level, stated) - rounding, step, self._xp)
        return out

    def _close(self) -> bool:
        """Take the segment into the average where it may be."""
        blocks, self._blocks = self._blocks, []
        sums, self._sums = self._sums, []
        size = self._size
        if sum(len(slots) for _, slots, _ in blocks) < _LEAST_SHARE * SEGMENT_BLOCKS * size:
            if blocks:
                self.drift.interrupt()
            return False
        start = self._segment * SEGMENT_BLOCKS
        places = np.concatenate([(index - start) * size + slots for index, slots, _ in blocks])
        dots = np.concatenate([d for _, _, d in blocks])
        if self._search is not None:
            dots = self._without_hum(self._search, places, dots, np.concatenate(sums))
        series = np.column_stack((dots, self._combinations.fixed(dots)))
        lags, sure = _autocovariance(places, series, SEGMENT_BLOCKS * size, size, self._xp)
        self._observed += 1
        moved = self._xp.einsum('sc,ac->sa', dots, self._moving)
        rough = _roughness(places, np.column_stack((moved, series)), self._q, self._xp)
        count = self._readings
        fixed = _covariance(lags[count:, count:], sure, self._xp)[0, 0]
        at_rest = self._classify(lags[:count, :count], sure, fixed, rough + self._least())
        self.gamma = self._in_use()
        if at_rest:
            mean_sd = self.mean_sd() * self._xp.root(size / len(dots))
            self.drift.add(self._xp.sum(dots, 0) / len(dots), mean_sd)
        else:
            self.drift.interrupt()
        return True

    def _without_hum(self, search: ToneSearch, places: IntArray, dots: FloatArray, sums: FloatArray) -> FloatArray:
        """Look for tones of a segment; return its ``dots`` (n, C), m, without those of the electronics."""
        still = np.column_stack((self._combinations.fixed(dots), sums))
        known = [*(tone.frequency for tone in self.tones), *(hum.frequency for hum in self.hum)]
        tones = search.tones(places, dots, still, self._moving, known, self.candidates)
        self.tones, self.candidates, self.hum = tones.moving, tones.candidates, ()
        for frequency in tones.hum:
            dots, hum = search.without(places, dots, frequency)
            self.hum += (hum,)
        return dots

    def _classify(self, gamma: FloatArray, sure: FloatArray, fixed: FloatArray, rough: FloatArray) -> bool:
        """Take a segment into the average, if that may be; return whether the link was at rest.

        ``gamma``, ``sure``: as measured, of a segment. ``fixed`` (N,): of the combination that does not move.
        ``rough``: of the combinations that move, the readings and the combination that does not, m^2.
        """
        moving, xp, least = self._moving, self._xp, self._least()
        rotated = xp.einsum('ac,cdl,ad->al', moving, _covariance(gamma, sure, xp), moving)
        means = xp.product(rotated, self._mean_of) + least / self._size
        fixed_mean = float(xp.product(fixed, self._mean_of)) + least / self._size
        fixed_rough = float(rough[-1])
        still = bool((means * fixed_rough <= _MOTION * rough[: len(moving)] * fixed_mean).all())
        if not self.at_rest:
            if still:
                self._restart(gamma, sure, fixed_rough)
                self.at_rest = True
            else:
                self._into_average(_guess(fixed, rough[len(moving) : -1] / fixed_rough), np.ones(self._size))
            return still
        before = self._average if self._average is not None else gamma
        known = xp.einsum('ac,cdl,ad,l->a', moving, before, moving, self._mean_of) + least / self._size
        ratio = means / known
        if (ratio > _RISEN).any():
            self._louder = self._louder + 1 if still else 0
            if self._louder >= _PATIENCE:
                self._restart(gamma, sure, fixed_rough)
        elif (ratio < _FALLEN).any():
            self._restart(gamma, sure, fixed_rough)
        else:
            self._into_average(gamma, sure)
            self._rough += (fixed_rough - self._rough) / self._count
        # In motion this alone tells it.
        other = not self._rough < _OTHER * fixed_rough < _OTHER * _OTHER * self._rough
        self._other = self._other + 1 if other else 0
        if self._other >= _PATIENCE:
            self._restart(before * (fixed_rough / self._rough), self._sure, fixed_rough)
        return still

    def _restart(self, gamma: FloatArray, sure: FloatArray, rough: float) -> None:
        self._average, self._sure, self._rough = gamma, sure, rough
        self._count, self._louder, self._other = 1, 0, 0

    def _into_average(self, gamma: FloatArray, sure: FloatArray) -> None:
        self._louder = 0
        self._count = min(self._count + 1, _LONGEST)
        before = self._average if self._average is not None else gamma
        self._average = before + (gamma - before) / self._count
        self._sure = self._sure + (sure - self._sure) / self._count


def _guess(fixed: FloatArray, size: FloatArray) -> FloatArray:
    """In motion: each reading ``size`` (C,) times the combination that does not move, coloured like it."""
    count = len(size)
    out = np.zeros((count, count, len(fixed)))
    out[range(count), range(count)] = fixed * size[:, None]
    return out


def _mean_weights(size: int) -> FloatArray:
    """Weights (N,) of gamma(l) that give the variance of a block's mean."""
    lags = np.arange(size)
    return np.asarray(np.where(lags > 0, 2.0, 1.0) * (size - lags) / size**2)


def _roughness(places: IntArray, series: FloatArray, q: FloatArray, xp: Arithmetic = FIXED) -> FloatArray:
    """Variance (c,) of ``series`` (n, c) about a polynomial in each block: the median over the blocks of a segment."""
    size, orders = q.shape
    blocks, slots = np.divmod(places, size)
    full = np.zeros((SEGMENT_BLOCKS, size, series.shape[1]))
    here = np.zeros((SEGMENT_BLOCKS, size))
    full[blocks, slots] = series
    here[blocks, slots] = 1.0
    count = xp.sum(here, 1)
    enough = count >= orders + 2
    full, here, count = full[enough], here[enough], count[enough]
    full = (full - xp.sum(full, 1)[:, None] / count[:, None, None]) * here[:, :, None]
    gram = xp.einsum('bsk,sj->bkj', here[:, :, None] * q, q)
    h = xp.einsum('bsc,sk->bkc', full, q)
    residual = xp.einsum('bsc,bsc->bc', full, full) - xp.einsum(
        'bkc,bkc->bc', h, xp.einsum('bkj,bjc->bkc', inverse(gram), h)
    )
    if not len(residual):
        return np.zeros(series.shape[1])
    return np.asarray(np.median(residual / (count - orders)[:, None], axis=0))


def _autocovariance(
    places: IntArray, series: FloatArray, length: int, lags: int, xp: Arithmetic = FIXED
) -> tuple[FloatArray, FloatArray]:
    """(c, c, lags) of ``series`` (n, c) at ``places`` (n,) below ``length``, less mean and slope; gaps are left out.

    It need not be a covariance. The second is for :func:`_covariance`.
    """
    at = places - places.sum() / len(places)
    centred = series - xp.sum(series, 0) / len(series)
    centred -= at[:, None] * (xp.einsum('t,tc->c', at, centred) / float(xp.sum(at * at, 0)))
    count = series.shape[1]
    max_lag = _FAR * lags
    padded = np.zeros((length, count + 1))
    padded[places, :count] = centred
    padded[places, count] = 1.0
    products = lagged_products(padded, max_lag)
    present = products[count, count]
    # Where two samples are never that far apart, nothing is known: taken as independent.
    each = np.where(present > 0.5, products[:count, :count] / np.maximum(present, 1.0), 0.0)
    # Mean and slope were taken off: 2 of length / far degrees of freedom of what is slower than that.
    slow = xp.einsum('cdl,l->cd', each, _mean_weights(max_lag))
    taken = (slow + slow.T)[:, :, None] / (length / max_lag - 2)
    # Products with 0 for what is absent are those of a covariance whatever the samples are, and stay so over one
    # divisor: that of the lag at which gaps cost most, so that none is too small.
    present = present[:lags]
    full = present / (1.0 - np.arange(lags) / length)
    return each[:, :, :lags] + taken, present / max(float(full.min()), _PAIRS * float(full[0]))


def _covariance(each: FloatArray, sure: FloatArray, xp: Arithmetic = FIXED) -> FloatArray:
    """The autocovariance (c, c, N) ``each`` as the covariance of N samples.

    ``sure`` (N,): times it, it is one. As little of that is taken as makes it one.
    """
    count, _, size = each.shape
    ridge = _OWN_SHARE * float(each[range(count), range(count), 0].max()) + _LEAST
    for share in _SHARES if size <= LARGEST else (1.0,):
        mixed = each * (1.0 + share * (sure - 1.0))
        mixed[range(count), range(count), 0] += ridge
        if share == 1.0 or _positive(mixed, xp):
            break
    return mixed


def _positive(gamma: FloatArray, xp: Arithmetic) -> bool:
    """Whether no weighted sum of N samples of each reading has a variance of 0 or below."""
    count, _, size = gamma.shape
    both = np.concatenate((gamma.transpose(1, 0, 2)[:, :, :0:-1], gamma), axis=2)
    lags = np.arange(size) - np.arange(size)[:, None] + size - 1
    full = both[:, :, lags].transpose(0, 2, 1, 3).reshape(count * size, count * size)
    return bool(np.isfinite(full).all()) and xp.is_positive(full)


def undithered(variance: float, step: float, xp: Arithmetic = FIXED) -> float:
    """Variance of the error that rounding to ``step`` leaves in the mean of many readings of that noise."""
    if step <= 0.0:
        return 0.0
    decay = 4.0 * pi * pi * max(variance, 0.0) / xp.square(step)
    total = 0.0
    for k in range(1, 200):
        term = xp.exp(-min(decay * k * k, 700.0)) / (k * k)
        total += term
        if term < 1e-9:
            break
    return xp.square(step) / (2.0 * pi * pi) * total
