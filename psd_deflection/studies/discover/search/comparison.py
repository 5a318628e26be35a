# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measured against simulated, as whitened vectors of one likelihood: what search, refit, hold-out and verdict ask of
the rig with its recordings or of any machine that simulates itself."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from scipy.special import ndtri
from scipy.stats import chi2 as chi2_law

from psd_deflection.base.charts import TimeAxis
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.studies.discover.thresholds import BANDS, BUDGET, P_CHANCE, P_LIBRARY, P_STRONG
from psd_deflection.studies.loads.thresholds import SIMULATION_ERROR

EQUIVALENT = round(4.0 * float(ndtri(1.0 - P_CHANCE)) ** 2, 1)
"""Loss in chi-square below which an alternative of no more parameters counts as equivalent: at
lambda sin²(theta/2) = z² one in a hundred would be misnamed, and sin²(theta) is four times that.
"""


class SimulationCount:
    """Counts the forward simulations of all comparisons that come from one."""

    def __init__(self) -> None:
        self.count = 0


class Comparison(ABC):
    """One or several recordings (or cases), each a table ``measured`` (channels, n); a *vector* (D,) joins all of them.

    It does not change: :meth:`replaced` and :meth:`renoised` give another. ``tally`` counts forward runs of all
    recordings, also of those others. ``base``: effects that every model has, with fixed values.
    ``nuisance``: effects that every model has and that every refit adjusts; they are never named. ``case``: the load
    case of each column, counted over all recordings. ``first``: names of effects that are only looked for before any
    other is found; ``setup``: of those that are mistakes of the set-up. ``open_level``: the level of what remains is
    fitted too, because nobody knows how exact the model of the machine is. ``budget``: forward simulations for each
    effect of the model after which nothing more is added; the alternatives end at twice as many. ``most_budgets``:
    more effects share the budgets of so many. ``p_accept``: largest library-wide p of an accepted
    effect. ``digits``: format of a gap in the sentence. ``correlated``: what remains is alike from one value
    to the next, as noise that nobody stated is not.
    """

    physics: Physics | None
    tally: SimulationCount
    base: tuple[ActiveEffect, ...]
    nuisance: tuple[ActiveEffect, ...] = ()
    measured: list[FloatArray]
    case: list[IntArray]
    first: frozenset[str] = frozenset()
    setup: frozenset[str] = frozenset()
    open_level: bool = False
    budget: int = BUDGET
    most_budgets: float = 4
    p_accept: float = P_LIBRARY
    digits: str = '.4g'
    correlated: bool = False

    @property
    def simulations(self) -> int:
        """Forward runs of all recordings so far."""
        return self.tally.count

    def replaced(self, **changes: Any) -> Self:
        """Return a copy with other attributes, such as ``base``, ``nuisance`` or ``noise``."""
        out = copy.copy(self)
        for name, value in changes.items():
            setattr(out, name, value)
        return out

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Of the recordings or cases."""

    @property
    @abstractmethod
    def channels(self) -> tuple[str, ...]:
        """Of the gap."""

    @property
    @abstractmethod
    def periods(self) -> list[float]:
        """s between the columns of each recording."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Elements of a vector that carry data."""

    @abstractmethod
    def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
        """What would have been measured, without noise, in the form of ``measured``."""

    @abstractmethod
    def whiten(self, tables: Sequence[FloatArray]) -> FloatArray:
        """Return one vector, of unit variance if the noise model holds; 0 where nothing was measured."""

    @abstractmethod
    def renoised(self, effects: Sequence[ActiveEffect]) -> Self:
        """With the noise as it is with ``effects`` in the model; this one if that is the same."""

    def refitted_beside(self, difference: Sequence[FloatArray], effects: Sequence[ActiveEffect]) -> Self:
        """With what is free besides the effects as ``difference`` of a fit of these asks for; this one if little is."""
        return self

    @abstractmethod
    def effective_size(self) -> float:
        """Sample size for BIC: values over correlation time."""

    @abstractmethod
    def gap_per_channel(self, residual: Sequence[FloatArray]) -> FloatArray:
        """rms of a residual, of each of ``channels``."""

    @abstractmethod
    def gap(self, residual: Sequence[FloatArray]) -> float:
        """rms over all channels."""

    @abstractmethod
    def floor(self) -> float:
        """Return the gap from noise alone; NaN if nobody knows the noise."""

    def noise_limit(self) -> float:
        """Return the gap that noise alone exceeds in one of a thousand recordings; NaN if nobody knows the noise."""
        size = self.effective_size() * len(self.channels) / len(self.measured[0])
        return self.floor() * float(np.sqrt(chi2_law.isf(P_STRONG, size) / size))

    @abstractmethod
    def pieces(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Log-likelihood that residual ``b`` gains over ``a`` (D,) on unseen cases, piece by piece."""

    @abstractmethod
    def unwhitened(self, white: FloatArray) -> list[FloatArray]:
        """Return the tables of a slow change of a vector (D,)."""

    @abstractmethod
    def folds(self) -> IntArray:
        """Return the fold of each load case, for the hold-out."""

    @property
    @abstractmethod
    def unit(self) -> str:
        """Of the gap over all channels."""

    @property
    @abstractmethod
    def display_scale(self) -> tuple[float, str]:
        """By what a gap is multiplied for people, and the unit that it has then."""

    @property
    @abstractmethod
    def display_units(self) -> tuple[str, ...]:
        """Of the rows of ``displayed``."""

    @abstractmethod
    def displayed(self, tables: Sequence[FloatArray]) -> list[FloatArray]:
        """Return a residual by ``channels``, as the gap counts it, for pictures; NaN where nothing was measured."""

    @abstractmethod
    def along(self) -> tuple[str | TimeAxis, list[FloatArray]]:
        """Return the time of what is ``displayed``, or the number of the reading."""

    @abstractmethod
    def against(self) -> dict[str, list[FloatArray]]:
        """What else ``displayed`` may be held against in a picture, by name with unit."""

    @abstractmethod
    def provenance(self) -> list[dict[str, object]]:
        """Of each recording, for result.json."""

    def worded(self, size: float, digits: str = '.3g') -> str:
        """Return a gap with its unit, for people."""
        scale, unit = self.display_scale
        return f'{scale * size:{digits}} {unit}'.rstrip() if np.isfinite(size) else 'not known'

    def sd(self, jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
        """(p,): standard deviations by the noise; the whitened ``jacobian`` (D, p) has the ``covariance`` (p, p)."""
        return np.sqrt(np.diag(covariance))

    def loss(self, residual: FloatArray) -> float:
        """Twice the negative log-likelihood of a vector (D,), up to a constant: chi-square if the noise is known."""
        return float(residual @ residual)

    def row(self, channel: int, values: Sequence[FloatArray]) -> FloatArray:
        """Whitened: ``values`` (n,) of each recording as those of one channel."""
        tables = [np.zeros_like(m) for m in self.measured]
        for table, v in zip(tables, values, strict=True):
            table[channel] = v
        return np.concatenate([part[channel] for part in self.split(self.whiten(tables))])

    def split(self, vector: FloatArray) -> list[FloatArray]:
        """Return the tables of a vector."""
        out, at = [], 0
        for m in self.measured:
            out.append(vector[at : at + m.size].reshape(m.shape))
            at += m.size
        return out

    def row_cases(self) -> IntArray:
        """Return the load case of every element of a vector."""
        return np.concatenate([np.tile(c, len(m)) for c, m in zip(self.case, self.measured, strict=True)])

    def residual(self, effects: Sequence[ActiveEffect]) -> tuple[FloatArray, list[FloatArray]]:
        """Whitened residual vector, and measured minus simulated."""
        difference = [m - s for m, s in zip(self.measured, self.simulate(effects), strict=True)]
        return self.whiten(difference), difference


def energies(workspace: Comparison, vector: FloatArray) -> FloatArray:
    """Chi-square of a whitened vector (D,) by recording, channel and band: (recordings, channels, bands)."""
    out = []
    for part, period in zip(workspace.split(vector), workspace.periods, strict=True):
        n = part.shape[1]
        power = np.abs(np.fft.rfft(part, axis=1)) ** 2 * (2.0 / n)
        power[:, 0] *= 0.5
        if n % 2 == 0:
            power[:, -1] *= 0.5
        starts = np.searchsorted(np.fft.rfftfreq(n, period), BANDS[:-1])
        padded = np.concatenate((power, np.zeros((len(power), 1))), axis=1)
        band = np.add.reduceat(padded, np.minimum(starts, power.shape[1]), axis=1)
        # reduceat gives the element itself for a band without frequencies.
        out.append(np.where(np.diff([*starts, power.shape[1]]) > 0, band, 0.0))
    return np.stack(out)


def gain_beyond(workspace: Comparison, smaller: FloatArray, larger: FloatArray, explained: FloatArray) -> float:
    """Chi-square gained from residual ``smaller`` to residual ``larger`` (D,), whitened, beyond the simulation's error.

    ``explained`` (D,): what the smaller model explains. A gain in a channel and band in which this error alone may give
    as much does not count; a loss counts.
    """
    if not np.any(explained):
        return float(smaller @ smaller - larger @ larger)
    gain = energies(workspace, smaller) - energies(workspace, larger)
    allowed = SIMULATION_ERROR**2 * energies(workspace, explained)
    return float(gain[(gain > allowed) | (gain < 0.0)].sum())
