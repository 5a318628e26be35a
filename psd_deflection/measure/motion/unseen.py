# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a load that nobody sees may do while no samples come, by what loads did lately.

The process noise of the filter says how the load wanders at present. A load that is switched now and then wanders not
at all before the switch, and a force that swings does not wander at random. So after each block the filter's states of
1, 2, 3 ... blocks before are carried on without the samples since, and held against the state that the samples gave.
What a miss is more than three of its standard deviations was not foreseen: the samples that are missing next may hide
as much again, and twice that. So much is added to the covariance while the filter goes on without samples, fading in
half a minute. It holds errors of the modes too.

A standard deviation does not describe a force that is switched: mostly nothing happens, and seldom much. What is added
makes three standard deviations a bound, not one of them an rms error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from psd_deflection.measure.motion.modal import Oscillator
from psd_deflection.records import FloatArray

GROWTH = 1.5
"""Factor from each span to the next, which is at least one block longer."""

LATELY = 30.0
"""Seconds in which the variance of what was seen fades to 1/e."""

BOUND = 3.0
"""Standard deviations that are to hold the truth."""

LARGER = 2.0
"""Times the largest miss: the next load may go from one end to the other, and the last one went from rest."""


class UnseenLoads:
    """Holds the misses of lately for spans of up to ``longest`` s of A axes with these modes.

    ``variances`` (A, H, 4): to add after each of the H spans, of the state as
    :mod:`psd_deflection.measure.motion.modal` has it.
    """

    def __init__(self, modes: tuple[Oscillator, ...], seconds: float, longest: float) -> None:
        """``seconds``: of a block."""
        spans = [1]
        while spans[-1] * seconds < longest:
            spans.append(max(spans[-1] + 1, math.floor(GROWTH * spans[-1])))
        self._spans = np.array(spans)
        self._seconds = seconds
        self._phi = np.stack([[mode.step(n * seconds) for mode in modes] for n in spans])
        self._added = np.stack(
            [mode.added_covariance(seconds * self._spans).diagonal(0, 2, 3) for mode in modes], axis=1
        )
        self._xp = modes[0].xp
        self._decay = self._xp.exp(-seconds / LATELY)
        self.variances = np.zeros((len(modes), len(spans), 4))
        self._x = np.zeros((spans[-1] + 1, len(modes), 4))
        self._p = np.zeros((spans[-1] + 1, len(modes), 4, 4))
        self._rate = np.zeros((spans[-1] + 1, len(modes), 2))
        self._buffered = 0

    def forget(self) -> None:
        """No load was seen."""
        self.variances[:] = 0.0
        self.begin()

    def begin(self) -> None:
        """Let spans begin at the next block: what is between is not the modes' motion, or is not known to a replay."""
        self._buffered = 0

    def buffered(self) -> tuple[float, ...]:
        """The states that spans may begin at, the oldest first: mean, covariance and process noise of each block."""
        count = min(self._buffered, len(self._x))
        rows = [k % len(self._x) for k in range(self._buffered - count, self._buffered)]
        states = [v for k in rows for array in (self._x, self._p, self._rate) for v in array[k].ravel().tolist()]
        return tuple(states)

    def gather(self, values: Sequence[float]) -> bool:
        """Go on from :meth:`buffered` of another one; False if it does not fit."""
        axes = self.variances.shape[0]
        count, rest = divmod(len(values), 22 * axes)
        if rest or count > len(self._x):
            return False
        states = np.reshape(values, (count, 22 * axes))
        self._x[:count] = states[:, : 4 * axes].reshape(count, axes, 4)
        self._p[:count] = states[:, 4 * axes : 20 * axes].reshape(count, axes, 4, 4)
        self._rate[:count] = states[:, 20 * axes :].reshape(count, axes, 2)
        self._buffered = count
        return True

    def add(self, x: FloatArray, p: FloatArray, rate: FloatArray) -> None:
        """The state after a block with samples: mean (A, 4), covariance (A, 4, 4), process noise (A, 2)."""
        self.variances *= self._decay
        there = self._spans[self._spans <= self._buffered]
        if len(there):
            count = len(there)
            at = (self._buffered - there) % len(self._x)
            phi = self._phi[:count]
            miss = np.square(x - self._xp.einsum('haij,haj->hai', phi, self._x[at]))
            carried = self._xp.einsum('haij,hajl->hail', phi, self._p[at])
            expected = self._xp.einsum('hail,hail->hai', carried, phi)
            expected += self._xp.einsum('hac,haci->hai', self._rate[at], self._added[:count])
            unforeseen = LARGER**2 * np.maximum(miss / BOUND**2 - expected, 0.0)
            held = self.variances[:, :count]
            np.maximum(held, unforeseen.transpose(1, 0, 2), out=held)
        here = self._buffered % len(self._x)
        self._x[here], self._p[here], self._rate[here] = x, p, rate
        self._buffered += 1

    def after(self, seconds: float) -> FloatArray:
        """Variances (A, 4) to add ``seconds`` after the last sample."""
        blocks = seconds / self._seconds
        later = int(np.searchsorted(self._spans, min(blocks, float(self._spans[-1]))))
        end = self.variances[:, later]
        before = self._spans[later - 1] if later else 0
        share = min((blocks - before) / (self._spans[later] - before), 1.0)
        start = self.variances[:, later - 1] if later else 0.0
        return np.asarray(start + share * (end - start))


class Innovations(NamedTuple):
    """How well the filter predicted the samples so far.

    ``squares``: sums of the normalised innovations squared (NIS) of dX, dY, theta; each has the
    mean 1 a sample.
    """

    squares: tuple[float, ...] = (0.0, 0.0, 0.0)
    samples: int = 0

    def since(self, before: Innovations) -> Innovations:
        """Those that came after ``before``."""
        squares = tuple(now - then for now, then in zip(self.squares, before.squares, strict=True))
        return Innovations(squares, self.samples - before.samples)

    def means(self) -> tuple[float, ...]:
        """NIS a sample, of dX, dY, theta; 0 without samples."""
        return tuple(square / max(self.samples, 1) for square in self.squares)

    def band(self, deviations: float) -> tuple[float, float]:
        """Where the mean NIS is, up to so many standard deviations: of a chi-square with a degree for each sample."""
        half = deviations * math.sqrt(2.0 / max(self.samples, 1))
        return max(1.0 - half, 0.0), 1.0 + half
