# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Vibration that a block cannot follow: tones of the readings that move together.

A motion whose period is shorter than a block looks like noise to one block: it varies inside, and hardly from mean to
mean. But noise has no tones. Each second (50 blocks) the spectrum of the combinations of the readings that move with
the link is searched for peaks above 1/2N a sample, 25 Hz for blocks of 20 at 1 kHz, that stand far out of the floor
about them (the median of the neighbours). A peak that the combination that does not move has too, or the sum signals,
is hum of the electronics and no motion (:class:`Hum`): its autocovariance is a cosine, known exactly. What vibrates
without a tone is found where readings of two PSDs vary together over a group of bins, and the sums do not.

Noise alone makes a bin exceed its floor T times with probability exp(-T); the floor of 50 neighbours is uncertain by
1/7, so that of the 450 bins of three combinations, in each of 3600 seconds, one passes T = 28 in some 300 hours.
Slow motion is kept out by a Hann window (periodic), whose lobes fall as the cube of the distance; gaps are bridged by
cubics, so that a regular gap makes no tone of a slow motion.

What a tone of variance P does to an answer w^T z that is meant for the block's middle is known: it leaves |1 - H|^2 P,
H the sum of w_s exp(i omega (s - middle)). :class:`Tone` has P of all readings, and
:mod:`psd_deflection.measure.uncertainty.block_fit` computes H of the weights that it used. A block in which that is
much reports it; a strong tone below 0.9 cycles a block is followed, and is not.
"""

from collections.abc import Iterator, Sequence
from math import pi
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.base.arithmetic.spectra import transform
from psd_deflection.records import FloatArray, IntArray, dot_names

SIGNIFICANT = 28.0
"""Times the floor about it: a peak is a tone."""

_OBSERVED = 12.0
"""Times the floor: a combination, or a sum signal, takes part in a tone that is there."""

_CANDIDATE = 16.0
"""Times the floor: a peak that is a tone if the next segment has it too, one bin off at most. Chance does it once in
ten years."""

_ELECTRIC = 0.01
"""Share of a tone's variance in what cannot move, from which it is hum and no motion."""

LOWEST = 0.5
"""Cycles a block: the polynomials of a block follow what is slower, however weak."""

FOLLOWED = 0.9
"""Cycles a block: they follow what is slower and strong."""

MATTERS = 0.2
"""Share of a block's variance, from which it says that it vibrates."""

_GROUP = 50
"""Bins of one floor."""

_NARROW, _BROAD = 3, 0.04
"""Bins to each side, and share of the frequency if that is more, that belong to a tone: the mode of a link that
something random drives is as broad as its damping."""

_COHERENT, _STILL_COHERENT = 0.7, 0.5
"""Correlation of readings of two PSDs in a group of bins from which the link vibrates there. Of independent noise it is
0.12 rms: chance reaches 0.7 once in some 600 hours. The lower one is for a group that vibrated before, and of what
cannot move from which it is the electronics."""

_MOST = 4
"""Tones that are looked for in a second."""


class Tone(NamedTuple):
    """``frequency``: cycles a sample. ``covariance`` (C, C) m^2: of the readings."""

    frequency: float
    covariance: FloatArray


class Hum(NamedTuple):
    """A tone of the electronics: ``frequency`` in cycles a sample, ``cosine`` and ``sine`` (C,) m of the readings."""

    frequency: float
    cosine: FloatArray
    sine: FloatArray

    def autocovariance(self, lags: int, xp: Arithmetic = FIXED) -> FloatArray:
        """(C, C, lags) m^2: of a reading with another one that is ``lag`` samples later."""
        angle = np.asarray(2.0 * pi * self.frequency * np.arange(lags), np.float64)
        a, b = self.cosine[:, None], self.sine[:, None]
        together = (a * self.cosine + b * self.sine)[:, :, None] * xp.cos_many(angle)
        return np.asarray(0.5 * (together + (a * self.sine - b * self.cosine)[:, :, None] * xp.sin_many(angle)))


class Tones(NamedTuple):
    """What a segment has: ``moving`` of the link, and the frequencies, cycles a sample, of ``hum`` and ``candidates``:
    peaks that the next segment may confirm."""

    moving: tuple[Tone, ...] = ()
    hum: tuple[float, ...] = ()
    candidates: tuple[float, ...] = ()


class ToneSearch:
    """Looks for tones in segments of ``blocks`` blocks of ``size`` samples."""

    def __init__(self, size: int, blocks: int, xp: Arithmetic = FIXED, lowest: float = LOWEST) -> None:
        """``lowest``: cycles a block from which on tones are looked for."""
        self._xp = xp
        self._length = size * blocks
        angle = np.asarray(2.0 * pi / self._length * np.arange(self._length), np.float64)
        self._window = 0.5 - 0.5 * xp.cos_many(angle)
        self._scale = 2.0 / (self._length * float(xp.sum(self._window * self._window, 0)))
        self._first, self._followed = int(lowest * blocks), int(FOLLOWED * blocks)
        # At half the sample rate a tone's other half folds onto it.
        self._last = self._length // 2 - 2
        self._groups = max((self._length // 2 - self._first // 2) // _GROUP, 1)
        start = self._first // 2
        middle = start + _GROUP * (np.arange(self._groups) + 0.5)
        bins = np.arange(self._length // 2 + 1)
        self._start = start
        self._lower = np.clip((bins - middle[0]) // _GROUP, 0, max(self._groups - 2, 0)).astype(np.int64)
        self._upper = np.minimum(self._lower + 1, self._groups - 1)
        self._share = np.clip((bins - middle[self._lower]) / _GROUP, 0.0, 1.0)[:, None]

    def tones(
        self,
        places: IntArray,
        dots: FloatArray,
        still: FloatArray,
        combinations: FloatArray,
        known: Sequence[float] = (),
        candidates: Sequence[float] = (),
    ) -> Tones:
        """The tones of samples at ``places`` (n,), in order, of a segment; the strongest against its limit first.

        ``dots`` (n, C), m: the readings, ``combinations`` (a, C): rows of their combinations that move with the link.
        ``still`` (n, b), m: what cannot move. ``known``: frequencies of the segment before, cycles a sample: those may
        be weaker. ``candidates``: of the segment before.
        """
        if self._last - self._first < _GROUP or len(places) < 2:
            return Tones()
        count, readings = combinations.shape
        series = _filled(places, np.column_stack((dots, still)), self._length)
        every = transform(series * self._window[:, None])
        moving = np.empty((len(every), count), np.complex128)
        moving.real = self._xp.einsum('fc,ac->fa', every.real[:, :readings], combinations)
        moving.imag = self._xp.einsum('fc,ac->fa', every.imag[:, :readings], combinations)
        spectrum = np.column_stack((moving, every[:, readings:]))
        power = self._xp.power_spectrum(spectrum)
        above = power / self._floor(power)
        free = np.zeros(len(power), dtype=bool)
        free[self._first : self._last + 1] = True
        limit = np.full(len(power), SIGNIFICANT)
        for at in (round(frequency * self._length) for frequency in candidates):
            limit[max(at - 1, 0) : at + 2] = _CANDIDATE
        for at in (round(frequency * self._length) for frequency in known):
            limit[max(at - _NARROW, 0) : at + _NARROW + 1] = _OBSERVED
        peaks = above[:, :count].max(axis=1) / limit
        scale = self._scale * self._xp.square(self._length / len(places))
        out: list[Tone] = []
        hum: list[float] = []
        for _ in range(_MOST):
            peak = int(np.argmax(np.where(free, peaks, 0.0)))
            if not free[peak] or peaks[peak] < 1.0:
                break
            wide = max(_NARROW, int(_BROAD * peak))
            band = slice(max(peak - wide, self._first), min(peak + wide, self._last) + 1)
            free[band] = False
            strength = self._xp.sum(power[band], 0)
            observed = above[band].max(axis=0) >= _OBSERVED
            moved = strength[:count] * observed[:count]
            weight = self._xp.sum(power[band, :count] * observed[:count], 1)
            mean = self._xp.product(weight, np.arange(band.start, band.stop, dtype=np.float64))
            frequency = float(mean) / float(self._xp.sum(weight, 0)) / self._length
            # Hum is narrow; and of fewer bins less by chance.
            narrow = slice(max(peak - _NARROW, self._first), min(peak + _NARROW, self._last) + 1)
            shown = above[narrow, count:].max(axis=0) >= _OBSERVED
            if bool((shown & (self._xp.sum(power[narrow, count:], 0) > _ELECTRIC * moved.max())).any()):
                hum.append(frequency)
                continue
            covariance = scale * self._cross_spectrum(spectrum[None, band, :count] * observed[:count])[0]
            out.append(Tone(frequency, self._xp.einsum('ac,ab,bd->cd', combinations, covariance, combinations)))
        peaks = np.where(free, above[:, :count].max(axis=1), 0.0)
        strongest = np.argsort(-peaks, kind='stable')[:_MOST]
        maybe = tuple((strongest[peaks[strongest] >= _CANDIDATE] / self._length).tolist())
        # What the tones have is theirs already.
        for band in self._broad(every * free[:, None], readings, known):
            # The quietest group has the noise alone, or hardly more.
            noise = np.median(self._grouped(power[:, :count]), axis=1).min(axis=0) / _LN_2
            covariance = self._cross_spectrum(spectrum[None, band, :count] * free[band, None])[0]
            # Each combination less its noise; scaled, so that it stays a covariance.
            total = np.diagonal(covariance) + _LEAST
            signal = np.sqrt(np.maximum(1.0 - np.count_nonzero(free[band]) * noise / total, 0.0))
            covariance = signal[:, None] * covariance * signal
            frequency = 0.5 * (band.start + band.stop - 1) / self._length
            out.append(Tone(frequency, self._xp.einsum('ac,ab,bd->cd', combinations, scale * covariance, combinations)))
        return Tones(tuple(out), tuple(hum), maybe)

    def _grouped(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """``values`` (F, k) as (groups, bins, k)."""
        return values[self._start : self._start + self._groups * _GROUP].reshape(self._groups, _GROUP, -1)

    def _cross_spectrum(self, spectra: npt.NDArray[np.complex128]) -> FloatArray:
        """(g, k, k): how k ``spectra`` (g, bins, k) vary together in each of g groups of bins."""
        cross = self._xp.times_conjugate(spectra[:, :, :, None], spectra[:, :, None, :]).real
        return self._xp.sum(np.ascontiguousarray(cross.swapaxes(0, 1)), 0)

    def _broad(self, every: npt.NDArray[np.complex128], readings: int, known: Sequence[float]) -> Iterator[slice]:
        """The bins, in runs of groups, in which readings of two PSDs vary together and what cannot move does not.

        ``every``: the spectra, those of ``readings`` first. What falls from one group to the next is the flank of
        slower motion.
        """
        cross = self._cross_spectrum(self._grouped(every))
        amplitudes = np.sqrt(np.diagonal(cross, axis1=1, axis2=2)) + _LEAST
        alike = np.abs(cross) / (amplitudes[:, :, None] * amplitudes[:, None, :])
        level, psd = self._xp.sum(np.square(amplitudes[:, :readings]), 1), np.arange(readings) // 2
        coherent = alike[:, :readings, :readings][:, psd[:, None] != psd].max(axis=1)
        still = alike[:, readings:, readings:]
        electric = (still - np.eye(still.shape[1])).max(axis=(1, 2)) > _STILL_COHERENT
        starts = self._start + _GROUP * np.arange(self._groups)
        held = np.isin(np.arange(self._groups), [(round(f * self._length) - self._start) // _GROUP for f in known])
        vibrates = (coherent > np.where(held, _STILL_COHERENT, _COHERENT)) & ~electric & (starts >= self._followed)
        for run in np.split(np.arange(self._groups), np.flatnonzero(np.diff(vibrates)) + 1):
            if vibrates[run[0]] and level[run].max() > level[run[0] - 1]:
                yield slice(int(starts[run[0]]), int(starts[run[-1]]) + _GROUP)

    def without(self, places: IntArray, dots: FloatArray, frequency: float) -> tuple[FloatArray, Hum]:
        """``dots`` (n, C), m, at ``places`` (n,) less their hum of that frequency, by weighted least squares."""
        xp, angle = self._xp, np.asarray(2.0 * pi * frequency * places, np.float64)
        waves = np.stack((xp.cos_many(angle), xp.sin_many(angle)), axis=1)
        weighted = waves * self._window[places, None]
        ((cc, cs), (_, ss)) = xp.einsum('si,sj->ij', weighted, waves).tolist()
        along, across = xp.einsum('si,sc->ic', weighted, dots - xp.sum(dots, 0) / len(dots))
        det = cc * ss - cs * cs
        hum = Hum(frequency, (ss * along - cs * across) / det, (cc * across - cs * along) / det)
        return dots - waves[:, :1] * hum.cosine - waves[:, 1:] * hum.sine, hum

    def _floor(self, power: FloatArray) -> FloatArray:
        """Of each bin (F,) of each series the power of the noise about it, between the medians of groups of bins."""
        grouped = self._grouped(power)
        # The median of an exponential distribution is ln 2 of its mean.
        medians = np.median(grouped, axis=1) / _LN_2
        lower = medians[self._lower]
        return np.asarray(lower + self._share * (medians[self._upper] - lower) + _LEAST)


_LN_2 = 0.6931471805599453
_LEAST = 1e-27
"""m^2: readings that do not vary have a floor too."""


def _filled(places: IntArray, series: FloatArray, length: int) -> FloatArray:
    """Return ``series`` (n, c) at ``places`` (n,) as (length, c): cubics across gaps, constant at the ends.

    A cubic goes through the samples at both sides of a gap, and those as far from them as the gap is wide.
    """
    if len(places) == length:
        return series
    out = np.empty((length, series.shape[1]))
    out[: places[0]], out[places[-1] :] = series[0], series[-1]
    out[places] = series
    at = np.setdiff1d(np.arange(places[0], places[-1]), places, assume_unique=True)
    after = np.searchsorted(places, at)
    before = after - 1
    width = places[after] - places[before]
    first = np.maximum(np.searchsorted(places, places[before] - width, 'right') - 1, 0)
    last = np.minimum(np.searchsorted(places, places[after] + width), len(places) - 1)
    for inner, knots in (
        ((first < before) & (last > after), (first, before, after, last)),
        ((first == before) | (last == after), (before, after)),
    ):
        u, x = at[inner].astype(np.float64), [places[k[inner]] for k in knots]
        out[at[inner]] = 0.0
        for k, knot in zip(knots, x, strict=True):
            weight = np.ones(len(u))
            for other in x:
                if other is not knot:
                    weight *= (u - other) / (knot - other)
            out[at[inner]] += weight[:, None] * series[k[inner]]
    return out


def rms_of(tone: Tone | Hum) -> float:
    """m: of the reading that it moves most."""
    if isinstance(tone, Tone):
        return float(np.sqrt(np.diagonal(tone.covariance).max()))
    return float(np.sqrt(0.5 * (np.square(tone.cosine) + np.square(tone.sine)).max()))


def words_of(tones: Sequence[Tone | Hum], rate_hz: float) -> str:
    """Such as "14 um rms near 87 Hz", '' without tones; ``rate_hz``: samples per second."""
    return ', '.join(f'{_micrometres(rms_of(t))} rms near {t.frequency * rate_hz:.3g} Hz' for t in tones)


def _micrometres(size: float) -> str:
    value = size * 1e6
    return f'{value:.0f} µm' if value >= 9.95 else f'{value:.1f} µm'


MOVING, RINGS, STILL = 5.0, 10e-6, 2e-6
"""A zero is rejected if the dots scatter or drift by so many times the noise and by more than so much, m: see
:func:`why_moving`."""


def why_moving(dots: FloatArray, noise: tuple[float, ...]) -> str:
    """Why ``dots`` (n, C), m, of the last blocks are not those of a link at rest; '' if they may be.

    ``noise`` (C,): variance of a block's dots, m^2. Moving is what scatters ``MOVING`` times as much as the noise says
    and by more than ``RINGS``, or what drifts by as much and by more than ``STILL`` from the first half to the second.
    A mean over whole periods leaves little of what rings, and all of what drifts.
    """
    if len(dots) < 3:
        return ''
    scatter = dots.std(axis=0, ddof=1)
    half = len(dots) // 2
    drift = np.abs(dots[half:].mean(axis=0) - dots[:half].mean(axis=0))
    least = MOVING * np.sqrt(noise)
    ratios = np.maximum(scatter / np.maximum(least, RINGS), drift / np.maximum(least, STILL))
    worst = int(np.argmax(ratios))
    if ratios[worst] <= 1.0:
        return ''
    return (
        f'the link moves: {dot_names(len(noise) // 2)[worst]} varied by {scatter[worst] * 1e6:.1f} µm rms in the last '
        f'{len(dots)} blocks, noise explains {noise[worst] ** 0.5 * 1e6:.1f} µm; wait until it is at rest'
    )
