"""A term of the budget, and how it becomes deviations of dX, dY and theta.

A term declares a few independent error parameters, each with a standard deviation, and how their
values change the measuring chain. Two calculations use this. First order: half the difference of
the exact chain's readings at plus and minus one deviation, times the Jacobian of the estimator.
Some parameters act as a square (a tilted sensor is foreshortened by a^2/2 either way) or as a
product with another, so the second order is added: the mean of the two readings gives a bias and
adds 2 bias^2 to the variance, and the mixed difference adds its square (GUM 5.1.2, note, for normal
distributions). Monte Carlo: normal values, the exact chain, the exact estimator.

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
from psd_deflection.studies.budget.chain import MeasuringChain, measure
from psd_deflection.studies.budget.estimate import Estimator, estimator_of

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
        pose = np.array(LinkStatics.from_rig(rig).deflection(*load))
        if not np.all(np.abs(pose) <= [rig.link.length, rig.link.length, math.pi]):
            raise ConfigError(
                f'load = {load[0]:g} {load[1]:g} {load[2]:g}: the tip would move by more than the link is long '
                'or turn by more than half a turn: take a smaller load'
            )
        chain = MeasuringChain.of(rig)
        estimator = estimator_of(rig, method)
        places, _ = measure(chain, pose)
        over = np.abs(places[0]) - chain.half_area
        if not np.all(over <= 0.0):
            psd, axis = (int(i) for i in np.unravel_index(int(np.argmax(over)), over.shape))
            raise ConfigError(
                f'load = {load[0]:g} {load[1]:g} {load[2]:g}: the dot of psd_{psd + 1} would lie at '
                f'{"xy"[axis]} = {places[0, psd, axis] * 1e3:.2f} mm, outside its '
                f'±{chain.half_area[psd, axis] * 1e3:g} mm: take a smaller load'
            )
        return cls(rig, inputs, pose, method, chain, estimator)

    def __getitem__(self, name: str) -> float:
        """One input."""
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


class Cause(abc.ABC):
    """One line of the budget.

    ``row``: its name in the thesis's Table 3.1 (or section 3.2), '' if the thesis leaves it out.
    ``formula``: in words of its ``inputs`` and the rig file.
    """

    name: str
    row: str
    kind: Kind
    formula: str
    inputs: tuple[str, ...]

    @abc.abstractmethod
    def contribution(self, at: Situation) -> Contribution:
        """Its effect to first and second order."""

    @abc.abstractmethod
    def without(self, chain: MeasuringChain, at: Situation) -> MeasuringChain:
        """``chain`` with its errors at 0 (a known effect absent)."""

    @abc.abstractmethod
    def perturb(self, chain: MeasuringChain, at: Situation, count: int, random: np.random.Generator) -> MeasuringChain:
        """``chain`` with ``count`` draws of its errors."""

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

    def perturb(self, chain: MeasuringChain, at: Situation, count: int, random: np.random.Generator) -> MeasuringChain:
        """As declared: normal values, or the known effect."""
        sizes = self.deviations(at)
        if self.kind is Kind.KNOWN:
            return self.apply(chain, np.ones((1, 1)), at)
        return self.apply(chain, random.normal(size=(count, sizes.size)) * sizes, at)

    def beside(self, at: Situation, count: int, random: np.random.Generator) -> FloatArray:
        """As declared: nothing."""
        return np.zeros((count, 3))

    def without(self, chain: MeasuringChain, at: Situation) -> MeasuringChain:
        """As declared."""
        return self.apply(chain, np.zeros((1, self.deviations(at).size)), at)


def _respond(at: Situation, chain: MeasuringChain) -> FloatArray:
    """(n, 3): the estimator's first-order answer to a chain's readings, up to a constant."""
    readings, zeros = measure(chain, at.pose)
    by_readings, by_zeros = at.estimator.response(at.pose, at.chain.zeros)
    count = len(readings)
    return np.asarray(readings.reshape(count, -1) @ by_readings.T + zeros.reshape(count, -1) @ by_zeros.T)


def adds_to(name: str) -> Callable[[MeasuringChain, FloatArray, Situation], MeasuringChain]:
    """An ``apply`` that adds the values to one field of the chain: one for each sensor, or for each axis too."""

    def apply(chain: MeasuringChain, values: FloatArray, at: Situation) -> MeasuringChain:
        old: FloatArray = getattr(chain, name)
        changes: dict[str, Any] = {name: old + values.reshape(len(values), *(len(at.chain.centers), 2)[: old.ndim - 1])}
        return replace(chain, **changes)

    return apply
