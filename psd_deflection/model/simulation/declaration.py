# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The declaration of an effect, made by a file in ``effects/`` or by your own file.

It holds everything that the simulation, the correction and the discovery know about an effect. None
of them refers to an effect by name.
"""

from __future__ import annotations

import functools
import itertools
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import MOST_PSDS, FloatArray
from psd_deflection.rig.parameters import Parameter, check_value, shown

Stage = Literal['load', 'link', 'optics', 'psd', 'electronics']
Point = Literal['configure', 'load', 'static', 'pose', 'beam', 'dots', 'volts', 'output']
Kind = Literal['amplitude', 'coupled', 'phase', 'shape', 'choice']
Proposal = Literal['', 'spectral', 'line', 'highest', 'highest_dots', 'value_grid', 'value_grid_dots']
Use = Literal['time', 'temperature']
State = dict[str, Any]
Values = Mapping[str, float]

POINTS: tuple[Point, ...] = typing.get_args(Point)
"""In the order in which they are passed."""
STAGES: tuple[Stage, ...] = typing.get_args(Stage)
"""In the order in which they act."""


CALIBRATED_OF_LINK = ('link.slope_ratio', 'clamp.bending_compliance', 'clamp.torsional_compliance')
"""What a calibration finds of the link; an effect without a PSD may declare it."""
CALIBRATED_OF_PSD = ('rotation', 'gain_x', 'gain_y', 'crosstalk_xy', 'crosstalk_yx', 'nonlinearity')
"""What a calibration finds of each PSD; an effect with a PSD may declare it."""
PLACED_OF_PSD = ('center_x', 'center_y', 'height', 'aimed')
"""The same, if the rig file has a parameter of its own for it: a calibrated file does not list the effect."""


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One parameter of an effect, with its bounds and the settings of a search.

    ``nominal``: the value at which the effect is off, and the default of a parameter that is not
    given. NaN means the rig file's value, the field ``of_rig`` of :class:`Physics`. ``scale``: the
    size of a probe, roughly the prior's standard deviation. ``within``: narrower bounds that the
    rig sets, given the effect's values.

    ``kind``: an ``amplitude`` switches the effect on; ``coupled`` means nothing while the amplitudes
    are nominal; a ``phase`` (rad) belongs to the amplitude that ``partner`` names; a ``shape`` also
    means nothing while they are, and ``grid`` says where to look; a ``choice`` takes the values of
    ``choices``. A rig may have one such effect for each value of an ``each`` choice (one for each
    PSD), otherwise one.

    ``propose``: how the values to try are found in the recordings, or a function of the choices that returns
    this. ``spectral``: peaks of the residual's spectrum, and ``grid``; ``line``: those of steady amplitude and
    phase; ``highest``: the largest voltage seen, ``highest_dots``: the same without the sums; ``value_grid``: the
    step on whose multiples all readings lie, and then the effect is named without a search; ``lattice_dots``: the same
    without the sums. ``of_psd``: the PSD that it is
    of, from 3: a rig without that PSD has no such parameter. ``power``: the
    signature of a ``finite`` effect grows with this power of the parameter; 0: it does not grow in proportion.
    ``starts``: values of an amplitude from which a fit that is far off is tried, too.
    """

    name: str
    unit: str
    minimum: float
    maximum: float
    scale: float
    description: str
    nominal: float = 0.0
    kind: Kind = 'amplitude'
    choices: tuple[int, ...] = ()
    grid: tuple[float, ...] = ()
    starts: tuple[float, ...] = ()
    propose: Proposal | Callable[[Values], Proposal] = ''
    power: int = 0
    partner: str = ''
    of_rig: str = ''
    required: bool = False
    each: bool = False
    of_psd: int = 0
    within: Callable[[Physics, Values], tuple[float, float]] | None = None

    def checked(self, value: object, source: str) -> float:
        """``value`` as a number. Raises ConfigError as :func:`check_value` does."""
        if not self.choices:
            low, high = self.minimum, self.maximum
            declared = Parameter(self.name, 'double', self.nominal, self.unit, self.description, low, high)
            return cast(float, check_value(declared, value, source))
        number = cast(float, check_value(Parameter(self.name, 'double', 0.0, self.unit, ''), value, source))
        if number not in self.choices:
            words = ', '.join(map(str, self.choices))
            raise ConfigError(f'{source}: {self.name} = {shown(value)}: must be one of {words}')
        return number

    def off(self, physics: Physics | None) -> float:
        """The nominal value on this rig."""
        return float(getattr(physics, self.of_rig)) if self.of_rig else self.nominal

    def bounds(self, physics: Physics | None, values: Values) -> tuple[float, float]:
        """Least and greatest value that is physical on this rig."""
        if self.within is None or physics is None:
            return self.minimum, self.maximum
        low, high = self.within(physics, values)
        return max(low, self.minimum), min(high, self.maximum)

    def proposed_by(self, values: Values) -> Proposal:
        """``propose``, given the effect's choices."""
        return self.propose(values) if callable(self.propose) else self.propose


PSD = EffectParameter(
    'psd',
    '',
    1,
    MOST_PSDS,
    1,
    'which PSD',
    nominal=1,
    kind='choice',
    choices=tuple(range(1, MOST_PSDS + 1)),
    required=True,
    each=True,
)
"""A parameter of every effect of one detector."""
MOVES_FREQUENCY = EffectParameter(
    'moves_frequency',
    '',
    0,
    1,
    1,
    '1: the mode moves with it, by sqrt(1 + scale); 0: the frequency was measured',
    kind='choice',
    choices=(0, 1),
)
"""A parameter of every effect on a stiffness."""


@dataclass(slots=True, eq=False)
class Reading:
    """n readings during the correction: ``dots`` (2P, n) m, ``sums`` (P, n) V, ``warmer`` (n,) K,
    ``t`` (n,) s. Changed in place. ``xp``: what computes.
    """

    dots: FloatArray
    sums: FloatArray
    warmer: FloatArray
    t: FloatArray
    xp: Arithmetic = LIBRARY


@dataclass(slots=True, eq=False)
class Traced:
    """One block on the way back from the tip's pose to the load. Changed in place.

    ``pose``: [dX m, dY m, theta rad], without the constants' ``at_rest``. ``loads``: [Fx N, Fy N, Tz N m], set
    after the last effect on a pose. ``seconds``: since the last block. ``physics``: the constants with all effects.
    """

    pose: list[float]
    loads: list[float]
    seconds: float
    physics: Physics


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect: its description, where it acts, and how.

    ``equation`` and ``source`` are for the reader. ``needs``: the excitation that shows it.
    ``configure`` changes the constants before a run; ``apply`` changes samples at ``point``;
    ``correct`` undoes it on a reading, if that is possible without the load. An effect that moves
    the beams (``point`` is ``beam``) or changes the constants of the optics needs no ``correct``.
    ``trace_back`` undoes it on a block's pose (``point`` is ``static`` or ``pose``) or on the loads (``load``), for the
    published wrench; it needs to be right for a link that has come to rest. Its list is what it remembers between
    blocks: empty at first, then always as many numbers. What ``configure`` changes needs no ``trace_back``.
    ``uses``: inputs of the correction besides dots and sums. ``order``: among the effects of one
    stage. ``finite``: the signature at the nominal value vanishes, so exactly the values of
    ``grid`` are probed. ``full``: ``apply`` must see the whole history at once, because a sample depends on later
    ones; no effect of the catalogue does. ``ahead``: of how many later samples it takes a reading; the last load then
    stays.

    ``calibrated_as``: what a calibration calls the effect's parameters, each one of ``CALIBRATED_OF_PSD`` or
    ``PLACED_OF_PSD`` (an effect with a PSD) or of ``CALIBRATED_OF_LINK``. The calibration then finds their sizes;
    without it a calibration rejects rigs that have the effect. ``law``: its text in YAML, if it is a law.
    ``also``: what people call it, for whoever types one of these words. ``least_psds``: the fewest PSDs of a rig that
    may have it. ``further``: what the same cause does at other points; these parts take the values of the whole.
    Raises ValueError if the declaration contradicts itself.
    """

    name: str
    stage: Stage
    summary: str
    equation: str
    source: str
    needs: str
    parameters: tuple[EffectParameter, ...]
    point: Point
    configure: Callable[[Physics, Values], None] | None = None
    apply: Callable[[SimulatedSamples, Values, State], None] | None = None
    correct: Callable[[Reading, Values], None] | None = None
    trace_back: Callable[[Traced, Values, list[float]], None] | None = None
    uses: frozenset[Use] = frozenset()
    finite: bool = False
    full: bool = False
    order: int = 0
    calibrated_as: Mapping[str, str] = field(default_factory=dict, hash=False)
    law: str = ''
    least_psds: int = 2
    also: tuple[str, ...] = ()
    further: tuple[Effect, ...] = ()
    ahead: Callable[[Physics, Values], int] | None = None

    def __post_init__(self) -> None:
        if self.stage not in STAGES:
            raise ValueError(f'stage = {self.stage!r}: must be one of {", ".join(STAGES)}')
        if self.point not in POINTS:
            raise ValueError(f'point = {self.point!r}: must be one of {", ".join(POINTS)}')
        if (self.configure if self.point == 'configure' else self.apply) is None:
            raise ValueError(f'point = {self.point!r} needs {"configure" if self.point == "configure" else "apply"}')
        if self.trace_back is not None and self.point not in ('load', 'static', 'pose'):
            raise ValueError(f'point = {self.point!r}: trace_back is for the points load, static and pose')
        if not self.uses <= set(typing.get_args(Use)):
            raise ValueError(f'uses = {set(self.uses)!r}: must be of {", ".join(typing.get_args(Use))}')
        self._check_parameters()
        self._check_calibrated()

    def _check_parameters(self) -> None:
        names = [p.name for p in self.parameters]
        amplitudes = [p.name for p in self.parameters if p.kind == 'amplitude']
        if len(set(names)) < len(names) or not amplitudes:
            raise ValueError('parameters must have different names, and one must be an amplitude')
        for p in self.parameters:
            if p.kind == 'phase' and p.partner not in amplitudes:
                raise ValueError(f'{p.name}: partner = {p.partner!r}: must name an amplitude')
            if not p.minimum <= p.maximum or not p.scale > 0.0:
                raise ValueError(f'{p.name}: minimum must be at most maximum, and scale above 0')
            if (p.kind == 'choice') != bool(p.choices):
                raise ValueError(f'{p.name}: a choice, and nothing else, has choices')
        if not set(self.calibrated_as) <= set(names):
            raise ValueError(f'calibrated_as = {dict(self.calibrated_as)!r}: must name parameters')

    def _check_calibrated(self) -> None:
        called = list(self.calibrated_as.values())
        if rest := [p.name for p in self.parameters if called and p != PSD and p.name not in self.calibrated_as]:
            raise ValueError(
                f'calibrated_as: {", ".join(rest)}: not named; a calibration finds all parameters of an effect or none'
            )
        known = (*CALIBRATED_OF_PSD, *PLACED_OF_PSD) if PSD in self.parameters else CALIBRATED_OF_LINK
        for key, name in self.calibrated_as.items():
            if name not in known:
                whose = 'a PSD' if PSD in self.parameters else 'the link'
                raise ValueError(f'calibrated_as: {key} = {name!r}: a calibration finds of {whose}: {", ".join(known)}')
        if len(set(called)) < len(called):
            raise ValueError(f'calibrated_as = {dict(self.calibrated_as)!r}: has a name twice')
        if 0 < len(set(called) & set(PLACED_OF_PSD)) < len(called):
            raise ValueError(
                f'calibrated_as = {dict(self.calibrated_as)!r}: {", ".join(PLACED_OF_PSD)} need an effect of their own'
            )

    @property
    def is_placed(self) -> bool:
        """Whether the rig file has parameters for what a calibration finds of it: a calibrated file lists it not."""
        return not set(PLACED_OF_PSD).isdisjoint(self.calibrated_as.values())

    @property
    def rank(self) -> tuple[int, int, str]:
        """Sorts effects into the order in which they act."""
        return STAGES.index(self.stage), self.order, self.name

    @property
    def corrected(self) -> str:
        """What the daemon frees from it if the rig file lists it: ``reading``, ``wrench`` or ''."""
        if self.correct is not None or self.point == 'beam':
            return 'reading'
        if self.point == 'configure':
            return 'reading' if self.stage in ('optics', 'psd') else 'wrench'
        if self.trace_back is not None:
            return 'wrench'
        return next((part.corrected for part in self.further if part.corrected), '')

    @property
    def value_grid(self) -> str:
        """The name of the parameter that is the step of all readings, '' if there is none."""
        first = next(self.variants())
        return next((p.name for p in self.parameters if p.proposed_by(first) == 'value_grid'), '')

    def steps_sums(self, values: Values) -> bool:
        """Whether with ``values`` the step is that of the sums, too."""
        return self.parameter(self.value_grid).proposed_by(values) == 'value_grid'

    def parameter(self, name: str) -> EffectParameter:
        """The declared parameter of that name (KeyError if there is none)."""
        for p in self.parameters:
            if p.name == name:
                return p
        raise KeyError(name)

    def variants(self, psds: int = 2) -> Iterator[dict[str, float]]:
        """Each combination of the choices, by parameter name, on a rig of so many ``psds``."""
        discrete = [p for p in self.parameters if p.kind == 'choice']
        for combination in itertools.product(*(p.choices[:psds] if p is PSD else p.choices for p in discrete)):
            yield {p.name: float(c) for p, c in zip(discrete, combination, strict=True)}

    def on(self, psds: int) -> Effect:
        """The effect with the parameters that it has on a rig of so many ``psds``."""
        return _on(self, psds) if any(p.of_psd > psds for p in self.parameters) else self

    def off_values(self, physics: Physics | None, choice: Values) -> dict[str, float]:
        """All parameters at the value where the effect is off."""
        return {p.name: choice.get(p.name, p.off(physics)) for p in self.parameters}


@functools.cache
def _on(effect: Effect, psds: int) -> Effect:
    return replace(effect, parameters=tuple(p for p in effect.parameters if p.of_psd <= psds))


@dataclass(frozen=True, slots=True)
class ActiveEffect:
    """An effect that is on, with a value for every parameter."""

    effect: Effect
    values: Values

    @property
    def parts(self) -> tuple[ActiveEffect, ...]:
        """What it does at each point at which it acts; these have no further parts."""
        if not self.effect.further:
            return (self,)
        first = replace(self.effect, further=())
        return tuple(ActiveEffect(part, self.values) for part in (first, *self.effect.further))

    @property
    def choices(self) -> tuple[float, ...]:
        """The values of the discrete parameters."""
        return tuple(self.values[p.name] for p in self.effect.parameters if p.kind == 'choice')

    @property
    def label(self) -> str:
        """Name and discrete choices, for people: ``sensor_rotation (psd 2)``."""
        choice = [f'{p.name} {self.values[p.name]:g}' for p in self.effect.parameters if p.kind == 'choice']
        return self.effect.name + (f' ({", ".join(choice)})' if choice else '')
