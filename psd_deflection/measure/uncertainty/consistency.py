# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whether the readings of a block belong to one pose of the plate, and which PSD's do not.

N PSDs give 2N readings for p unknowns (3 of a flat plate). With the residual r of the readings, their covariance C and
their slopes J by the unknowns, what no pose explains has

    chi-square = r^T Q r,     Q = W - W J (J^T W J)^-1 J^T W,     W = C^-1,

of 2N - p degrees of freedom (generalised least squares; Q J = 0, so r may come from any solver). If PSD i alone is
wrong, its error is e_i = Q_ii^-1 (Q r)_i (Baarda's data snooping, by pairs); with one or two degrees of freedom, which
tell no PSD from another, each reading has its own e_i.

The one redundant reading of two PSDs on a flat plate is known without linearising: r = a^T e, by how much the base
line between the dots is longer than that between the beams, with a = (n, -n)/sqrt(2) and n along it.

A PSD is excluded if the readings are inconsistent with it and consistent without it, and no other PSD could be
blamed; for a second, because its readings may be right for a block while the link rings. If several could be blamed,
or none alone, the covariance is widened by sum_i (K e_i)(K e_i)^T with the solver's gain K and half as much again, so
that the truth stays inside; the errors are held and fade over a second. A residual that lasts is widened for at a
smaller size than that of a single block.
"""

import abc
import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.base.arithmetic.matrices import inverse
from psd_deflection.records import FloatArray

CONTRADICTS, DOUBTFUL = 5.7330e-7, 0.01
"""Shares of consistent blocks that are taken for inconsistent (one in 1.7 million), and for doubtful."""

ONE_DEGREE = (25.0, 6.635)
"""Chi-squares of those shares with one degree of freedom: SciPy's take a fifth of a second to import."""

UNMEASURED = 16.0
"""Factor on the limits while the noise is not measured yet: it may be four times what the rig file says."""

LASTING = 2.5
"""Chi-square, by the covariance of one block, of a mean residual that lasts. Hum of constant phase has at most 2."""

SLOWLY = 1.0 / 8.0
"""Weight of the newest block in that mean."""

HOLD = 50
"""Blocks for which a PSD stays excluded after its last inconsistent block: a second at 50 blocks a second."""

_WIDEN = 1.5
"""Factor on the error of one reading alone: errors of two readings cancel in part in the residual."""

_FADE = 0.98
"""Factor a block on held squares."""

_FORGET = 1.0 / 500.0
"""Share of the past that a block takes off the moments of the readings of two PSDs."""

_ENOUGH = 10
"""Blocks before a reading is named."""

_NEAR = 0.02
"""How near to -1 the slope of an inverted reading on its true value must be."""

_UNSEEN = 4e-4
"""A reading with a smaller share of what is redundant cannot be checked."""

_UNSEEN_PART = 0.02
"""The same for a component of a: a^2 of 4e-4."""


class ConsistencyResult(NamedTuple):
    """The check of one block.

    ``chi_square`` of this block, of ``freedom`` degrees. ``contradict``: this block, or one shortly before, is
    inconsistent. ``errors`` (2N,) m: of each reading if its PSD alone is wrong. ``possible_errors`` (2N,) m: those
    that the covariance is to allow for. ``excluded``: the PSD to exclude, from 1 among those that are checked; 0: none.
    """

    chi_square: float
    contradict: bool
    errors: tuple[float, ...]
    possible_errors: tuple[float, ...]
    excluded: int = 0
    freedom: int = 1


class Unexplained(abc.ABC):
    """What no pose explains of the readings of one block.

    ``value`` (k,) m and its ``chi_square``. ``information`` (k,) 1/m^2: chi-square of each error over its square.
    """

    value: list[float]
    chi_square: float
    information: list[float]

    @abc.abstractmethod
    def chi_square_of(self, value: list[float]) -> float:
        """Return the chi-square of another ``value``, such as a mean over blocks."""

    @abc.abstractmethod
    def errors_of(self, value: list[float]) -> list[float]:
        """Return the errors (k,), m, that would cause ``value``, each alone."""

    @abc.abstractmethod
    def of_readings(self, errors: list[float]) -> tuple[float, ...]:
        """Return ``errors`` (k,) as errors (2N,) of the readings, m."""


class BaseLineExcess(Unexplained):
    """Excess length r of the base line between two dots; k = 1."""

    def __init__(
        self, apart: tuple[float, float], residual: tuple[float, ...], covariance: FloatArray, xp: Arithmetic = FIXED
    ) -> None:
        """``apart``: dot of PSD 1 less that of PSD 2, m, not (0, 0). ``residual`` (4,) m, ``covariance`` (4, 4) m^2."""
        x, y = apart
        size = xp.root(2.0 * (x * x + y * y))
        ax, ay = x / size, y / size
        x1, y1, x2, y2 = residual
        r = ax * (x1 - x2) + ay * (y1 - y2)
        u1, v1, u2, v2 = [ax * (c[0] - c[2]) + ay * (c[1] - c[3]) for c in covariance.tolist()]
        self._variance = ax * (u1 - u2) + ay * (v1 - v2)
        self._per_reading = [1.0 / a if abs(a) > _UNSEEN_PART else 0.0 for a in (ax, ay, -ax, -ay)]
        self.value = [r]
        self.chi_square = self.chi_square_of(self.value)
        self.information = [1.0 / self._variance if self._variance > 0.0 else 0.0]

    def chi_square_of(self, value: list[float]) -> float:
        """See :class:`Unexplained`."""
        return value[0] * value[0] / self._variance if self._variance > 0.0 else 0.0

    def errors_of(self, value: list[float]) -> list[float]:
        """See :class:`Unexplained`."""
        return value

    def of_readings(self, errors: list[float]) -> tuple[float, ...]:
        """See :class:`Unexplained`."""
        (r,) = errors
        return tuple([r * part for part in self._per_reading])


class UnexplainedResidual(Unexplained):
    """Residual of N PSDs; k = 2N."""

    def __init__(
        self, residual: tuple[float, ...], slopes: FloatArray, covariance: FloatArray, xp: Arithmetic = FIXED
    ) -> None:
        """``residual`` (2N,) m, ``slopes`` J (2N, p), ``covariance`` (2N, 2N) m^2."""
        self._xp = xp
        weights = inverse(covariance[None])[0]
        # Each unknown in its own unit, so that the elimination sees numbers of one size.
        scaled = slopes / np.sqrt(xp.sum(slopes * slopes, 0))
        weighted = xp.einsum('ij,jk->ik', weights, scaled)
        normal = inverse(xp.einsum('ji,jk->ik', scaled, weighted)[None])[0]
        self._q = np.asarray(weights - xp.einsum('ia,ab,jb->ij', weighted, normal, weighted))
        self._freedom = len(residual) - slopes.shape[1]
        self.value = list(residual)
        self.chi_square = max(self.chi_square_of(self.value), 0.0)
        self.information = np.diag(self._q).tolist()

    def _pull(self, value: list[float]) -> FloatArray:
        return self._xp.einsum('ij,j->i', self._q, np.array(value))

    def chi_square_of(self, value: list[float]) -> float:
        """See :class:`Unexplained`."""
        return float(self._xp.sum(np.array(value) * self._pull(value), 0))

    def errors_of(self, value: list[float]) -> list[float]:
        """See :class:`Unexplained`."""
        q, pull = self._q, self._pull(value).tolist()
        if self._freedom < 3:
            least = _UNSEEN * float(q.max())
            return [p / info if info > least else 0.0 for info, p in zip(self.information, pull, strict=True)]
        errors: list[float] = []
        for at in range(0, len(pull), 2):
            (a, b), (_, d) = q[at : at + 2, at : at + 2].tolist()
            u, v = pull[at : at + 2]
            determinant = a * d - b * b
            if determinant > _UNSEEN * a * d:
                errors += [(d * u - b * v) / determinant, (a * v - b * u) / determinant]
            else:
                # It is seen in one direction only.
                errors += [u / (a + d), v / (a + d)]
        return errors

    def of_readings(self, errors: list[float]) -> tuple[float, ...]:
        """See :class:`Unexplained`."""
        return tuple(errors)


class ConsistencyCheck:
    """Checks block after block; its state is which PSD was excluded lately, and the errors that are held."""

    def __init__(self, psds: int, unknowns: int, size: int, xp: Arithmetic = FIXED) -> None:
        """``psds``: N. ``unknowns``: p; with 2N or more nothing is redundant. ``size``: k of what it is given."""
        self._xp = xp
        self._psds = psds
        self.freedom = max(2 * psds - unknowns, 0)
        self.limit, self._doubtful = _limits(self.freedom)
        self._excluded, self._blocks_left = 0, 0
        self._held, self._mean, self._lasting = [0.0] * size, [0.0] * size, [0.0] * size

    def agrees(self, unexplained: Unexplained | None, factor: float) -> bool:
        """Whether the readings are consistent, and there are enough of them to tell; ``factor`` on the limits."""
        return unexplained is not None and unexplained.chi_square <= factor * self.limit

    def candidates(self, unexplained: Unexplained | None, factor: float) -> tuple[int, ...]:
        """Return the PSDs (from 1) of which :meth:`update` needs to know whether the others are consistent."""
        if unexplained is None:
            return ()
        if unexplained.chi_square > factor * self.limit:
            return tuple(range(1, self._psds + 1))
        return (self._excluded,) if self._excluded and self._blocks_left > 1 else ()

    def update(
        self, unexplained: Unexplained | None, factor: float, blamed: Collection[int] | None
    ) -> ConsistencyResult:
        """Check one block; ``factor`` on the limits.

        ``blamed``: those of the :meth:`candidates` without which the readings are consistent; None: no PSD may be
        excluded. Of all readings together a wrong one is mixed into the others, so they need fits of their own.
        """
        if unexplained is None:
            none = (0.0,) * (2 * self._psds)
            return ConsistencyResult(0.0, False, none, none, 0, self.freedom)
        contradict = unexplained.chi_square > factor * self.limit
        self._exclude(contradict, blamed)
        errors = unexplained.errors_of(unexplained.value)
        self._update_lasting(unexplained, factor)
        hold = contradict and not self._excluded
        doubtful = hold or unexplained.chi_square > factor * self._doubtful
        squares = [e * e if doubtful else 0.0 for e in errors]
        if contradict and blamed:
            squares = [square * (1 + i // 2 in blamed) for i, square in enumerate(squares)]
        self._hold(unexplained, squares if hold else [0.0] * len(squares), factor)
        contradict = contradict or self._excluded > 0 or any(self._held)
        possible = self._possible(squares)
        result = unexplained.chi_square, contradict, unexplained.of_readings(errors), unexplained.of_readings(possible)
        return ConsistencyResult(*result, self._excluded, self.freedom)

    def _possible(self, squares: list[float]) -> list[float]:
        """Return the errors that the covariance is to allow for: those of this block, held ones, lasting ones."""
        if self._excluded:
            return [0.0] * len(squares)
        # Both readings of a PSD may be wrong together: the sum of two outer products is at least half of theirs.
        together = 2.0 if self.freedom >= 3 else 1.0
        largest = map(max, squares, self._held, self._lasting)
        return [_WIDEN * self._xp.root(together * square) for square in largest]

    def _exclude(self, contradict: bool, blamed: Collection[int] | None) -> None:
        if blamed is None:
            self._excluded = 0
        elif contradict:
            if self._excluded not in blamed:
                self._excluded = next(iter(blamed)) if len(blamed) == 1 else 0
            self._blocks_left = HOLD if self._excluded else 0
        elif self._excluded:
            self._blocks_left -= 1
            if self._blocks_left <= 0 or self._excluded not in blamed:
                self._excluded = 0

    def _update_lasting(self, unexplained: Unexplained, factor: float) -> None:
        """Update the mean of the last blocks, and hold the errors of a residual that lasts."""
        self._mean = [mean + SLOWLY * (r - mean) for mean, r in zip(self._mean, unexplained.value, strict=True)]
        lasts = unexplained.chi_square_of(self._mean) > factor * LASTING
        squares = [e * e for e in unexplained.errors_of(self._mean)] if lasts else [0.0] * len(self._mean)
        faded = [max(_FADE * old, new) for old, new in zip(self._lasting, squares, strict=True)]
        self._lasting = faded if _exceeds(faded, unexplained, 1.0) else [0.0] * len(faded)

    def _hold(self, unexplained: Unexplained, squares: list[float], factor: float) -> None:
        faded = [max(_FADE * old, new) for old, new in zip(self._held, squares, strict=True)]
        exceeds = not self._excluded and _exceeds(faded, unexplained, factor * self.limit)
        self._held = faded if exceeds else [0.0] * len(faded)

    def state(self) -> tuple[float, ...]:
        """Return the state as numbers."""
        return (float(self._excluded), float(self._blocks_left), *self._held, *self._mean, *self._lasting)

    def load_state(self, values: tuple[float, ...]) -> None:
        """Go on from :meth:`state`. Raises ValueError if it is that of another number of PSDs."""
        excluded, blocks_left, *numbers = values
        size = len(self._held)
        if len(numbers) != 3 * size or not 0 <= excluded <= self._psds:
            raise ValueError(f'the check of {self._psds} PSDs has {2 + 3 * size} values, not {len(values)}')
        self._excluded, self._blocks_left = int(excluded), int(blocks_left)
        self._held, self._mean, self._lasting = numbers[:size], numbers[size : 2 * size], numbers[2 * size :]


def _exceeds(squares: list[float], unexplained: Unexplained, limit: float) -> bool:
    """Whether the chi-square of one of the squared errors is above ``limit``."""
    return any(square * i > limit for square, i in zip(squares, unexplained.information, strict=True))


def _limits(freedom: int) -> tuple[float, float]:
    """Return the chi-squares of ``CONTRADICTS`` and ``DOUBTFUL``."""
    if freedom < 2:
        return ONE_DEGREE
    from scipy.special import chdtri

    return float(chdtri(freedom, CONTRADICTS)), float(chdtri(freedom, DOUBTFUL))


def survival(chi_square: float, freedom: int) -> float:
    """Return the probability that a chi-square of ``freedom`` degrees is larger; 1 for none."""
    if freedom == 1:
        return math.erfc(math.sqrt(0.5 * chi_square))
    from scipy.special import chdtrc

    return float(chdtrc(freedom, chi_square)) if freedom else 1.0


def widened(covariance: FloatArray, gain: FloatArray, errors: tuple[float, ...], xp: Arithmetic = FIXED) -> FloatArray:
    """Return ``covariance`` (3, 3) + sum_i (K e_i)(K e_i)^T; ``errors`` e (2N,), ``gain`` K (3, 2N)."""
    caused = gain * np.array(errors)
    return np.asarray(covariance + xp.einsum('ik,jk->ij', caused, caused))


class OutlierSearch:
    """Which reading of two PSDs is most likely wrong, by many blocks and poses; a single block cannot tell.

    Kept are moments of the readings and of their true values, each if the other readings are right: then that of
    reading i is m_i - r/a_i. Over many poses m_i must follow one law of it: constant (dead or stuck), or its opposite
    (inverted). Exchanged axes make the length of the base line right. If two readings would do, none is named.
    """

    def __init__(self, centers: FloatArray, beams: FloatArray) -> None:
        """``centers``, ``beams`` (2, 2), m."""
        self._apart = tuple((centers[0] - centers[1]).tolist())
        self._base_line = float(np.hypot(*(beams[0] - beams[1])))
        self._swapped = [0.0, 0.0, 0.0]
        self._blocks = 0
        self._weight = 0.0
        self._sum = np.zeros(8)
        self._squares = np.zeros((3, 4))

    def add(self, dots: tuple[float, ...], errors: tuple[float, ...]) -> None:
        """Take a block: its readings (4,) m and :attr:`ConsistencyResult.errors`."""
        x1, y1, x2, y2 = dots
        true = np.array(dots) - errors
        ax, ay = self._apart
        for i, (x, y) in enumerate(((x1 - x2, y1 - y2), (y1 - x2, x1 - y2), (x1 - y2, y1 - x2))):
            r = ((ax + x) ** 2 + (ay + y) ** 2) ** 0.5 - self._base_line
            self._swapped[i] = (1.0 - _FORGET) * self._swapped[i] + r * r
        both = np.concatenate((dots, true))
        if not self._blocks:
            self._first = both
        both = both - self._first
        read, true = both[:4], both[4:]
        keep = 1.0 - _FORGET
        self._blocks += 1
        self._weight = keep * self._weight + 1.0
        self._sum = keep * self._sum + both
        self._squares = keep * self._squares + np.stack((read * read, read * true, true * true))

    def most_likely(self, noise: float) -> str:
        """Return what is wrong, such as 'y2 does not move', or '' if unknown. ``noise``: sd of a reading, m."""
        if self._blocks < _ENOUGH:
            return ''
        for psd in (1, 2):
            # The length of the base line is right if the axes are exchanged, and far off if not.
            if self._swapped[psd] < min(0.01 * self._swapped[0], self._weight * (10.0 * noise) ** 2):
                return f'the axes of psd_{psd} are exchanged'
        mean = self._sum / self._weight
        read, true = mean[:4], mean[4:]
        moments = self._squares / self._weight - np.stack((read * read, read * true, true * true))
        matches = []
        for c, name in enumerate(('x1', 'y1', 'x2', 'y2')):
            var_read, shared, var_true = moments[:, c].tolist()
            # It must have had reason to move, by far more than noise.
            if var_true < (100.0 * noise) ** 2:
                continue
            slope = shared / var_true
            off = var_read - slope * shared
            if var_read < (5.0 * noise) ** 2:
                matches.append(f'{name} does not move with the others')
            elif abs(slope + 1.0) < _NEAR and off < (10.0 * noise) ** 2 + 1e-4 * var_true:
                matches.append(f'{name} has the wrong sign')
        return matches[0] if len(matches) == 1 else ''
