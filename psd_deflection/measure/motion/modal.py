# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How a mode moves from sample to sample, and what a block of samples says about it.

Each of dX, dY and theta is a damped oscillator about the static deflection u of the load. The load wanders by steps, or
smoothly, if its rate of change r does:

    q'' + 2 zeta w q' + w^2 (q - u) = 0,
    u' = r + noise of density Q_u (m^2/s),    r' = noise of density Q_r (m^2/s^3).

The state is x = (q, q'/w, u, r/w), all in m (or rad). The samples of one block are y = O x0 + process noise + noise of
the readings, with x0 the state one sample before the block. So a whole block is one update of four unknowns, and
:class:`BlockTables` holds what does not depend on x0: the answer is that of a Kalman filter that runs sample by sample
(Bar-Shalom, Li & Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.2), also if the noise of
the readings is coloured within the block.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.base.arithmetic.matrices import inverse
from psd_deflection.measure.state import mismatch
from psd_deflection.records import AppliedLoad, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Oscillator:
    """One mode. ``frequency`` Hz, undamped, above 0; ``damping_ratio`` 0 or more, below 1; ``xp``: what computes it."""

    frequency: float
    damping_ratio: float
    xp: Arithmetic = FIXED

    @property
    def w(self) -> float:
        """Angular frequency, rad/s."""
        return 2.0 * math.pi * self.frequency

    def step(self, seconds: float) -> FloatArray:
        """Phi (4, 4): the state after ``seconds`` of its own motion."""
        w, zeta, xp = self.w, self.damping_ratio, self.xp
        root = math.sqrt(1.0 - xp.square(zeta))
        decay = xp.exp(-zeta * w * seconds)
        c, s = xp.cos(root * w * seconds), xp.sin(root * w * seconds) / root
        in_phase, out_of_phase = decay * (c + zeta * s), decay * s
        out = np.zeros((4, 4))
        out[:2, :2] = [[in_phase, out_of_phase], [-out_of_phase, decay * (c - zeta * s)]]
        out[:, 2:] = self.pushed(np.array([seconds]))[0].T
        return out

    def pushed(self, seconds: FloatArray) -> FloatArray:
        """(n, 2, 4): the state ``seconds`` (n,) after u, or r/w, went from 0 to 1: columns of Phi; 0 before that."""
        w, zeta, xp = self.w, self.damping_ratio, self.xp
        root = math.sqrt(1.0 - xp.square(zeta))
        since = np.maximum(seconds, 0.0)
        decay = xp.exp_many(-zeta * w * since)
        c, s = xp.cos_many(root * w * since), xp.sin_many(root * w * since) / root
        zeros, ones = np.zeros(len(since)), np.ones(len(since))
        rest = 1.0 - decay * (c + zeta * s)
        lag = 2.0 * zeta - decay * (2.0 * zeta * c + (2.0 * xp.square(zeta) - 1.0) * s)
        out = np.array([[rest, decay * s, ones, zeros], [w * since - lag, rest, w * since, ones]]).transpose(2, 0, 1)
        return np.asarray(np.where(seconds[:, None, None] >= 0.0, out, 0.0))

    def added_covariance(self, seconds: FloatArray) -> FloatArray:
        """D (n, 2, 4, 4): covariance that Q_u = 1, or Q_r = w^2, adds in ``seconds`` (n,).

        It is the integral of the column of Phi times itself, by Gauss-Legendre in pieces of an eighth of a
        period at most.
        """
        nodes, weights = self.xp.legendre(8)
        pieces = max(1, math.ceil(8.0 * float(seconds.max()) * self.frequency))
        shares = ((np.arange(pieces)[:, None] + 0.5 * (nodes + 1.0)) / pieces).ravel()
        pushed = self.pushed((seconds[:, None] * shares).ravel()).reshape(len(seconds), len(shares), 2, 4)
        parts = np.tile(0.5 * weights / pieces, pieces) * seconds[:, None]
        return self.xp.einsum('np,npci,npcj->ncij', parts, pushed, pushed)


class BlockGains(NamedTuple):
    """What n samples of a block say; A axes, K rates. S: their covariance if x0 is known, X: that of x_end with them.

    ``observed`` (A, n, 4): O. ``precision`` (A, K, n, n): S^-1. ``pulled`` (A, K, 4, n): O^T S^-1. ``smoothed``
    (A, K, 4, n): X S^-1. ``information`` (A, K, 4, 4): O^T S^-1 O, of x0. ``transition`` (A, K, 4, 4): x_end for x0,
    with the samples given. ``residual`` (A, K, 4, 4): covariance of x_end if x0 and the samples are known. ``log_size``
    (A, K): log det S.
    """

    observed: FloatArray
    precision: FloatArray
    pulled: FloatArray
    smoothed: FloatArray
    information: FloatArray
    transition: FloatArray
    residual: FloatArray
    log_size: FloatArray


class BlockTables:
    """What a block of N samples says about A axes for each of K rates of their loads.

    ``phi`` (A, 4, 4): over the whole block. ``added`` (A, K, 4, 4): what the load adds to the covariance over it.
    """

    def __init__(self, modes: tuple[Oscillator, ...], size: int, period: float) -> None:
        """``size``: N. ``period``: of a sample, s."""
        xp = self._xp = modes[0].xp
        self.size = size
        self._observed = np.empty((len(modes), size, 4))
        self._random_walk = np.empty((len(modes), 2, size, size))
        self._to_end = np.empty((len(modes), 2, 4, size))
        self._added_covariance = np.empty((len(modes), 2, 4, 4))
        self.phi = np.stack([mode.step(size * period) for mode in modes])
        for a, mode in enumerate(modes):
            steps = [mode.step(n * period) for n in range(size + 1)]
            added_covariance = mode.added_covariance(period * np.arange(size + 1, dtype=np.float64))
            self._observed[a] = [steps[n + 1][0] for n in range(size)]
            self._added_covariance[a] = added_covariance[size]
            for s in range(size):
                # Covariance of the state at sample s with itself, carried on to later samples.
                for t in range(s, size):
                    self._random_walk[a, :, s, t] = self._random_walk[a, :, t, s] = xp.product(
                        added_covariance[s + 1][:, :, 0], steps[t - s][0]
                    )
                self._to_end[a, :, :, s] = xp.product(added_covariance[s + 1][:, :, 0], steps[size - 1 - s].T)

    def fill(self, noise: FloatArray, rates: FloatArray) -> None:
        """Use this noise and these rates.

        ``noise`` (A, N, N): covariance of the readings in one block. ``rates`` (A, K, 2): Q_u
        and Q_r/w^2.
        """
        self._covariance = noise[:, None] + self._xp.einsum('akc,acnm->aknm', rates, self._random_walk)
        self._reach = self._xp.einsum('akc,acin->akin', rates, self._to_end)
        self.added = self._xp.einsum('akc,acij->akij', rates, self._added_covariance)
        self._full = self._of(np.arange(self.size))

    def gains(self, slots: IntArray) -> BlockGains:
        """What the samples at ``slots`` (n,) of the block say. A whole block is at hand, others are computed."""
        return self._full if len(slots) == self.size else self._of(slots)

    def _of(self, slots: IntArray) -> BlockGains:
        covariance = self._covariance[:, :, slots[:, None], slots]
        count = len(slots)
        precision = inverse(covariance.reshape(-1, count, count)).reshape(covariance.shape)
        observed = self._observed[:, slots]
        reach = self._reach[..., slots]
        pulled = self._xp.einsum('ani,aknm->akim', observed, precision)
        smoothed = self._xp.einsum('akin,aknm->akim', reach, precision)
        size = self._xp.log_det(covariance)
        return BlockGains(
            observed,
            precision,
            pulled,
            smoothed,
            self._xp.einsum('akin,anj->akij', pulled, observed),
            self.phi[:, None] - self._xp.einsum('akin,anj->akij', smoothed, observed),
            self.added - self._xp.einsum('akin,akjn->akij', smoothed, reach),
            size,
        )


DOUBT = 0.05
"""Share by which the deflection of a known load may differ from the rig file's link, one standard
deviation."""
MOST_LOADS = 1000
"""So many known loads may wait for samples."""


class Pushed(NamedTuple):
    """What the known loads of a block do.

    ``samples`` (3, N): to each sample, m, m, rad. ``end`` (3, 4): to the state at its end.
    ``variance`` (3,): what they add to that of the static deflection.
    """

    samples: FloatArray
    end: FloatArray
    variance: FloatArray


class KnownLoads:
    """The load that acts, and those whose stamps lie ahead of the samples.

    ``modes``: of dX, dY and theta. ``compliance`` (3,): m/N, m/N, rad/(N m). ``size``: samples of a
    block; ``period``: of them, s. ``held`` (3,): the load that acts, N, N, N m; None if none was
    told.

    Loads that other nodes announce: what they do to the tip from their stamps on.
    """

    def __init__(self, modes: Sequence[Oscillator], compliance: FloatArray, size: int, period: float) -> None:
        self._modes, self._compliance = modes, compliance
        self._size, self._period = size, period
        self._waiting: list[AppliedLoad] = []  # Bound: MOST_LOADS.
        self.held: FloatArray | None = None

    def __bool__(self) -> bool:
        """Whether any load is known."""
        return self.held is not None or bool(self._waiting)

    def is_new(self, load: AppliedLoad) -> bool:
        """Whether ``load`` differs from the last one that was reported."""
        if self._waiting:
            return load[1:] != self._waiting[-1][1:]
        return self.held is None or load[1:] != tuple(self.held.tolist())

    def add(self, load: AppliedLoad) -> None:
        """Take a load that acts from its stamp on; if more than ``MOST_LOADS`` wait, the oldest is forgotten."""
        self._waiting.append(load)
        del self._waiting[:-MOST_LOADS]

    def pushed(self, t_ns: int, first: bool) -> Pushed | None:
        """What the loads do in the block whose middle is ``t_ns``; None if none waits. ``first``: of a run."""
        if not self._waiting:
            return None
        period_ns = 1e9 * self._period
        end_ns = t_ns + round(0.5 * (self._size - 1) * period_ns)
        samples, end, variance = np.zeros((3, self._size)), np.zeros((3, 4)), np.zeros(3)
        while self._waiting and self._waiting[0].t_ns <= end_ns:
            load = self._waiting.pop(0)
            before, self.held = self.held, np.array(load[1:])
            since = self._period * self._size - (end_ns - load.t_ns) / 1e9
            # The first one may have acted before the run. One from before these samples was seen in
            # earlier ones.
            if first or before is None or since < 0.0:
                continue
            step = self._compliance * (self.held - before)
            variance = variance + np.square(DOUBT * step)
            for a, mode in enumerate(self._modes):
                pushed = step[a] * mode.pushed(self._period * np.arange(1.0, self._size + 1.0) - since)[:, 0]
                samples[a] += pushed[:, 0]
                end[a] += pushed[-1]
        return Pushed(samples, end, variance)

    def state(self) -> tuple[tuple[float, ...], list[float]]:
        """The load that acts, with whether there is one, four numbers; and those that wait, five numbers each."""
        held = (1.0, *self.held.tolist()) if self.held is not None else (0.0,) * 4
        return held, [v for load in self._waiting for v in (*split_ns(load.t_ns), *load[1:])]

    def load_state(self, name: str, values: tuple[float, ...]) -> None:
        """Go on from another one's :meth:`state_dict`. Raises ValueError, which names ``name``, for a wrong length."""
        if len(values) < 4 or (len(values) - 4) % 5:
            raise mismatch(name, values, 'four numbers and five for each load that waits')
        self.held = np.array(values[1:4]) if values[0] else None
        waiting = np.reshape(values[4:], (-1, 5)).tolist()
        self._waiting = [AppliedLoad(joined_ns(s, ns), fx, fy, tz) for s, ns, fx, fy, tz in waiting]


def split_ns(t_ns: int) -> tuple[float, float]:
    """Seconds and nanoseconds: one float does not hold a time to the nanosecond."""
    return float(t_ns // 1_000_000_000), float(t_ns % 1_000_000_000)


def joined_ns(seconds: float, ns: float) -> int:
    """The time that :func:`split_ns` split."""
    return 1_000_000_000 * int(seconds) + int(ns)
