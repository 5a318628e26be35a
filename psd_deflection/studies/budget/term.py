# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A term of the budget, and how it becomes deviations of dX, dY and theta.

A term declares a few independent error parameters, each with a standard deviation, and how their
values change the measuring chain. Two calculations use this. First order: half the difference of
the exact chain's readings at plus and minus one deviation, times the Jacobian of the estimator.
Some parameters act as a square (a tilted sensor is foreshortened by a^2/2 either way) or as a
product with another, so the second order is added: the mean of the two readings gives a bias and
adds 2 bias^2 to the variance, and the mixed difference adds its square (GUM 5.1.2, note, for normal
distributions). Monte Carlo: normal values, the exact chain, the exact estimator; or each value of the distribution
that its term declares (JCGM 101).

A *known* term is not random (the tilt that a flat model leaves out). It has one parameter, present
or absent, and its effect is a bias with a sign.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.link import LinkStatics
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.budget.chain import Estimator, MeasuringChain, estimator_of, measure
from psd_deflection.studies.budget.inputs import is_assumed

ROOT_3 = math.sqrt(3.0)
"""Half-width over deviation of a uniform distribution."""


class Kind(Enum):
    """When an error takes a new value."""

    PER_ESTIMATE = 'per estimate'
    """A new value in each block: averaging over time helps."""
    SYSTEMATIC = 'systematic'
    """One value per installation, zero or temperature: averaging does not help."""
    KNOWN = 'known bias'
    """Follows from the pose; a more complete model would remove it."""


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """The conditions of a budget: a rig, its inputs, a true pose (3,) of the tip, and a method."""

    rig: Rig
    inputs: Mapping[str, float]
    pose: FloatArray
    method: str
    chain: MeasuringChain
    estimator: Estimator

    @classmethod
    def at_load(cls, rig: Rig, inputs: Mapping[str, float], load: tuple[float, float, float], method: str) -> Situation:
        """At the pose of a tip load (Fx N, Fy N, Tz N m). Raises ConfigError if a dot leaves its sensor."""
        pose: FloatArray = np.array(LinkStatics.from_rig(rig).deflection(*load))
        words = f'load = {load[0]:g} {load[1]:g} {load[2]:g}'
        if not np.all(np.abs(pose) <= [rig.link.length, rig.link.length, math.pi]):
            raise ConfigError(
                f'{words}: the tip would move by more than the link is long '
                'or turn by more than half a turn: take a smaller load'
            )
        return cls.at_pose(rig, inputs, pose, method, (words, 'take a smaller load'))

    @classmethod
    def at_pose(
        cls, rig: Rig, inputs: Mapping[str, float], pose: FloatArray, method: str, words: tuple[str, str]
    ) -> Situation:
        """At a ``pose`` (3,). ``words``: what asks for it, and what to do if a dot leaves its sensor (ConfigError)."""
        chain = MeasuringChain.of(rig)
        estimator = estimator_of(rig, method)
        places, _ = measure(chain, pose)
        over = np.abs(places[0]) - chain.half_area
        if not np.all(over <= 0.0):
            psd, axis = (int(i) for i in np.unravel_index(int(np.argmax(over)), over.shape))
            raise ConfigError(
                f'{words[0]}: the dot of psd_{psd + 1} would lie at '
                f'{"xy"[axis]} = {places[0, psd, axis] * 1e3:.2f} mm, outside its '
                f'±{chain.half_area[psd, axis] * 1e3:g} mm: {words[1]}'
            )
        return cls(rig, inputs, pose, method, chain, estimator)

    def __getitem__(self, name: str) -> float:
        """Return one input."""
        return self.inputs[name]

    @property
    def area(self) -> FloatArray:
        """(P, 2) m: lengths of the active areas along x and y."""
        return 2.0 * self.chain.half_area


class Contribution(NamedTuple):
    """The effect of a term on (dX, dY, theta): ``bias`` (3,) m, m, rad and ``covariance`` (3, 3)."""

    bias: FloatArray
    covariance: FloatArray

    @property
    def rms(self) -> FloatArray:
        """(3,): root of bias^2 + variance."""
        return np.asarray(np.sqrt(self.bias**2 + np.diag(self.covariance)))


class Distribution(Enum):
    """Of an error parameter. ``UNIFORM``: of a tolerance. ``ARCSINE``: of a sinusoid at a random phase."""

    NORMAL = 'normal'
    UNIFORM = 'uniform'
    ARCSINE = 'arcsine'


class Sensitivity(NamedTuple):
    """One error parameter. ``name``: within its cause, '' if it is alone. ``deviation``: its standard uncertainty.

    ``coefficient`` (3,): how dX, dY, theta go with it, m and rad per unit of it.
    """

    name: str
    deviation: float
    coefficient: FloatArray


class Cause(abc.ABC):
    """One line of the budget.

    ``row``: its name in the thesis's Table 3.1 (or section 3.2), '' if the thesis leaves it out.
    ``formula``: in words of its ``inputs`` and the rig file. ``unit``: of its error parameters. ``observed``: whether
    its deviation comes from a series of observations (type A of the GUM); else it is of type B. ``calibrated``:
    whether ``psd-deflection calibrate`` measures it, so that of a calibrated rig the calibration's uncertainty counts.
    """

    name: str
    row: str
    kind: Kind
    formula: str
    inputs: tuple[str, ...]
    unit: str = 'm'
    distribution: Distribution = Distribution.NORMAL
    observed: bool = False
    calibrated: bool = False

    def freedom(self, at: Situation) -> float:
        """Degrees of freedom of its deviation: of the noise as measured; of an assumption by JCGM 100:2008, G.3.

        A deviation that is known to the relative standard uncertainty r has 1/(2 r^2); a bound of a data sheet, and
        an input that has another value than its default, are taken as known.
        """
        if self.observed:
            return at['noise_freedom']
        doubt = at['assumption_doubt']
        assumed = any(is_assumed(name, at[name]) for name in self.inputs)
        return 1.0 / (2.0 * doubt**2) if assumed and doubt > 0.0 else math.inf

    def sensitivities(self, at: Situation) -> list[Sensitivity]:
        """Its error parameters, none of a known bias."""
        return []

    @abc.abstractmethod
    def contribution(self, at: Situation) -> Contribution:
        """Its effect to first and second order."""

    @abc.abstractmethod
    def without(self, chain: MeasuringChain, at: Situation) -> MeasuringChain:
        """``chain`` with its errors at 0 (a known effect absent)."""

    @abc.abstractmethod
    def perturb(
        self, chain: MeasuringChain, at: Situation, count: int, random: np.random.Generator, *, shaped: bool = False
    ) -> MeasuringChain:
        """``chain`` with ``count`` draws of its errors: normal, or if ``shaped`` of the declared distributions.

        Of a normal distribution whose deviation has few degrees of freedom, ``shaped`` draws are those of a scaled
        t-distribution (JCGM 101:2008, 6.4.9).
        """

    @abc.abstractmethod
    def beside(self, at: Situation, count: int, random: np.random.Generator) -> FloatArray:
        """(count, 3): errors that it adds to the estimate itself, not through the chain."""


@dataclass(frozen=True, slots=True, eq=False)
class Term(Cause):
    """A cause that acts on the measuring chain.

    ``deviations``: of its k error parameters, at a situation. ``apply``: returns the chain with
    values (n, k) of these parameters; for a known term the value is 1 if it is present and 0 if
    not.
    """

    name: str
    row: str
    kind: Kind
    formula: str
    inputs: tuple[str, ...]
    deviations: Callable[[Situation], FloatArray]
    apply: Callable[[MeasuringChain, FloatArray, Situation], MeasuringChain]
    unit: str = 'm'
    distribution: Distribution = Distribution.NORMAL
    observed: bool = False
    calibrated: bool = False

    def contribution(self, at: Situation) -> Contribution:
        """As declared."""
        alone = np.diag(self.deviations(at))
        first, second = np.triu_indices(len(alone), k=1)
        steps = np.concatenate([np.zeros((1, len(alone))), alone, -alone, alone[first] + alone[second]])
        errors = _respond(at, self.apply(at.chain, steps, at))
        plus, minus, both = np.split(errors[1:] - errors[0], [len(alone), 2 * len(alone)])
        if self.kind is Kind.KNOWN:
            return Contribution(plus[0], np.zeros((3, 3)))
        linear, square = (plus - minus) / 2.0, (plus + minus) / 2.0
        product = both - plus[first] - plus[second]
        return Contribution(square.sum(axis=0), linear.T @ linear + 2.0 * square.T @ square + product.T @ product)

    def sensitivities(self, at: Situation) -> list[Sensitivity]:
        """As declared: half the difference at plus and minus one deviation, over the deviation."""
        if self.kind is Kind.KNOWN:
            return []
        sizes = self.deviations(at)
        alone = np.diag(sizes)
        plus, minus = np.split(_respond(at, self.apply(at.chain, np.concatenate([alone, -alone]), at)), 2)
        linear = (plus - minus) / 2.0
        # Of a deviation of 0 there is no difference; it has no share either.
        slopes = np.divide(linear, sizes[:, None], out=np.zeros_like(linear), where=sizes[:, None] > 0.0)
        names = _NAMES[len(sizes)]
        return [Sensitivity(*row) for row in zip(names, sizes.tolist(), slopes, strict=True)]

    def perturb(
        self, chain: MeasuringChain, at: Situation, count: int, random: np.random.Generator, *, shaped: bool = False
    ) -> MeasuringChain:
        """As declared; a known effect is there in each draw."""
        sizes = self.deviations(at)
        if self.kind is Kind.KNOWN:
            return self.apply(chain, np.ones((1, 1)), at)
        shape = (count, sizes.size)
        drawn = self._drawn(at, shape, random) if shaped else random.normal(size=shape)
        return self.apply(chain, drawn * sizes, at)

    def _drawn(self, at: Situation, shape: tuple[int, int], random: np.random.Generator) -> FloatArray:
        """Draws of its distribution with a standard deviation of 1."""
        if self.distribution is Distribution.UNIFORM:
            return random.uniform(-ROOT_3, ROOT_3, size=shape)
        if self.distribution is Distribution.ARCSINE:
            return np.asarray(math.sqrt(2.0) * np.sin(random.uniform(0.0, 2.0 * math.pi, size=shape)))
        freedom = self.freedom(at)
        return random.normal(size=shape) if math.isinf(freedom) else random.standard_t(freedom, size=shape)

    def beside(self, at: Situation, count: int, random: np.random.Generator) -> FloatArray:
        """As declared: nothing."""
        return np.zeros((count, 3))

    def without(self, chain: MeasuringChain, at: Situation) -> MeasuringChain:
        """As declared."""
        return self.apply(chain, np.zeros((1, self.deviations(at).size)), at)


_NAMES: Mapping[int, tuple[str, ...]] = {
    1: ('',),
    2: ('psd_1', 'psd_2'),
    4: ('x1', 'y1', 'x2', 'y2'),
    6: ('both x', 'both y', 'x1', 'y1', 'x2', 'y2'),
}
"""Of the error parameters of a term, by how many it has."""


def _respond(at: Situation, chain: MeasuringChain) -> FloatArray:
    """(n, 3): the estimator's first-order answer to a chain's readings, up to a constant."""
    readings, zeros = measure(chain, at.pose)
    by_readings, by_zeros = at.estimator.response(at.pose, at.chain.zeros)
    count = len(readings)
    return np.asarray(readings.reshape(count, -1) @ by_readings.T + zeros.reshape(count, -1) @ by_zeros.T)


def adds_to(name: str) -> Callable[[MeasuringChain, FloatArray, Situation], MeasuringChain]:
    """Return an ``apply`` that adds the values to one field of the chain: one for each sensor, or for each axis too."""

    def apply(chain: MeasuringChain, values: FloatArray, at: Situation) -> MeasuringChain:
        old: FloatArray = getattr(chain, name)
        changes: dict[str, Any] = {name: old + values.reshape(len(values), *(len(at.chain.centers), 2)[: old.ndim - 1])}
        return replace(chain, **changes)

    return apply
