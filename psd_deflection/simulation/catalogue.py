"""What an effect is, which there are, and how a rig file says that one is on.

An effect is one file in ``effects/`` with one :class:`Effect` called ``EFFECT``: adding a file adds
an effect. In a rig file the effects stand below ``effects:``, one map each, under any key::

    effects:
      sensor_rotation_2: {name: sensor_rotation, psd: 2, angle: 0.01}

so that the file remains a ROS 2 parameter file.
"""

from __future__ import annotations

import functools
import importlib
import math
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from psd_deflection.config import Rig
from psd_deflection.errors import ConfigError, did_you_mean
from psd_deflection.records import FloatArray
from psd_deflection.simulation.chunk import Chunk
from psd_deflection.simulation.physics import Physics

Stage = Literal['link', 'load', 'optics', 'psd', 'electronics']
Point = Literal['configure', 'load', 'static', 'pose', 'beam', 'dots', 'volts', 'output']
State = dict[str, Any]
Values = Mapping[str, float]

STAGES: tuple[Stage, ...] = ('load', 'link', 'optics', 'psd', 'electronics')


Kind = Literal['amplitude', 'coupled', 'phase', 'shape', 'choice']


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One parameter of an effect, with its bounds and what a search has to know of it.

    ``nominal``: the value at which the effect is off, or that a parameter takes when it is not
    given; NaN means the rig file's own, the field ``of_rig`` of :class:`Physics`. ``scale``: the
    size of a probe, about the prior's standard deviation. ``kind``: an ``amplitude`` switches the
    effect on; ``coupled`` and ``phase`` mean nothing while the amplitudes are nominal; a ``shape``
    likewise, and ``grid`` says where to look (``spectral``: at peaks of the residual's spectrum;
    ``line``: at those that hum steadily;
    ``highest``: at the largest voltage seen); a ``choice`` takes the values of ``choices``.
    ``within``: narrower bounds that the rig sets, given the effect's values.
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
    propose: Literal['', 'spectral', 'line', 'highest', 'lattice'] = ''
    of_rig: str = ''
    required: bool = False
    within: Callable[[Physics, Values], tuple[float, float]] | None = None

    def off(self, physics: Physics) -> float:
        """The nominal value on this rig."""
        return float(getattr(physics, self.of_rig)) if self.of_rig else self.nominal

    def bounds(self, physics: Physics, values: Values) -> tuple[float, float]:
        """Least and greatest value that is physical on this rig."""
        if self.within is None:
            return self.minimum, self.maximum
        low, high = self.within(physics, values)
        return max(low, self.minimum), min(high, self.maximum)


PSD = EffectParameter('psd', '', 1, 2, 1, 'which PSD', nominal=1, kind='choice', choices=(1, 2), required=True)
"""The parameter of every effect that belongs to one detector."""
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
"""The parameter of every effect on a stiffness."""


@dataclass(slots=True, eq=False)
class Reading:
    """n readings on their way back to what the PSDs would have shown: ``dots`` (4, n) m,
    ``sums`` (2, n) V, ``warmer`` (n,) K, ``t`` (n,) s. Changed in place.
    """

    dots: FloatArray
    sums: FloatArray
    warmer: FloatArray
    t: FloatArray


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect: what it is, where it acts, and how.

    ``equation`` and ``source`` are for the reader. ``needs``: the excitation that shows it.
    ``configure`` changes the constants before a run; ``apply`` changes a chunk at ``point``;
    ``correct`` undoes it on a reading, where that is possible without the load. ``order``: among
    the effects of one stage. ``finite``: the signature at the nominal value vanishes, so that
    only the values of ``grid`` are probed, each as it is.
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
    apply: Callable[[Chunk, Values, State], None] | None = None
    correct: Callable[[Reading, Values], None] | None = None
    finite: bool = False
    order: int = 0

    def parameter(self, name: str) -> EffectParameter:
        """The declared parameter of that name (KeyError if there is none)."""
        for p in self.parameters:
            if p.name == name:
                return p
        raise KeyError(name)


@dataclass(frozen=True, slots=True)
class ActiveEffect:
    """An effect that is on, with a value for every parameter."""

    effect: Effect
    values: Values

    @property
    def label(self) -> str:
        """Name and discrete choices, for people: ``sensor_rotation (psd 2)``."""
        choice = [f'{p.name} {self.values[p.name]:g}' for p in self.effect.parameters if p.kind == 'choice']
        return self.effect.name + (f' ({", ".join(choice)})' if choice else '')


@functools.cache
def catalogue() -> Mapping[str, Effect]:
    """Every effect by name, in the order in which they act."""
    package = importlib.import_module('psd_deflection.simulation.effects')
    found: list[Effect] = []
    for module in pkgutil.iter_modules(package.__path__):
        found.append(importlib.import_module(f'{package.__name__}.{module.name}').EFFECT)
    found.sort(key=lambda e: (STAGES.index(e.stage), e.order, e.name))
    return {e.name: e for e in found}


def make_active(name: str, values: Mapping[str, object], source: str) -> ActiveEffect:
    """Check one effect's parameters; raises ConfigError naming source, key, value, bound."""
    effect = catalogue().get(name)
    if effect is None:
        hint = did_you_mean(name, catalogue()) or f'; there are: {", ".join(catalogue())}'
        raise ConfigError(f'{source}: name = {name!r}: no effect of that name{hint}')
    known = [p.name for p in effect.parameters]
    for key in values:
        if key not in known:
            raise ConfigError(f'{source}: {key} = {values[key]!r}: {name} has the parameters {", ".join(known)}')
    out: dict[str, float] = {}
    for p in effect.parameters:
        if p.name not in values:
            if p.required:
                raise ConfigError(f'{source}: {p.name} is missing: {name} needs it ({p.description}, {p.unit or "1"})')
            out[p.name] = p.nominal
            continue
        raw = values[p.name]
        try:
            value = float(raw)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            raise ConfigError(f'{source}: {p.name} = {raw!r}: must be a number') from None
        if isinstance(raw, bool) or not math.isfinite(value):
            raise ConfigError(f'{source}: {p.name} = {raw!r}: must be a finite number')
        if p.choices and value not in p.choices:
            raise ConfigError(f'{source}: {p.name} = {raw!r}: must be one of {", ".join(map(str, p.choices))}')
        if not p.minimum <= value <= p.maximum:
            unit = f' {p.unit}' if p.unit else ''
            raise ConfigError(
                f'{source}: {p.name} = {raw!r}{unit}: must be at least {p.minimum:g} and at most {p.maximum:g}'
            )
        out[p.name] = value
    return ActiveEffect(effect, out)


def effects_of_rig(rig: Rig) -> list[ActiveEffect]:
    """The effects that a rig file has on, of flat keys ``KEY.name``, ``KEY.angle`` ...; raises ConfigError."""
    groups: dict[str, dict[str, object]] = {}
    for key, value in rig.effects.items():
        group, dot, name = key.partition('.')
        if not dot:
            raise ConfigError(f'effects.{key} = {value!r}: must be a map like {{name: sensor_gain, psd: 1, x: 0.001}}')
        groups.setdefault(group, {})[name] = value
    found = []
    for group, body in groups.items():
        name = str(body.pop('name', group))
        found.append(make_active(name, body, f'effects.{group}'))
    return sort_effects(found)


def sort_effects(effects: Sequence[ActiveEffect]) -> list[ActiveEffect]:
    """In the order in which they act."""
    order = {name: i for i, name in enumerate(catalogue())}
    return sorted(effects, key=lambda a: order[a.effect.name])


def effects_to_values(effects: Sequence[ActiveEffect]) -> dict[str, dict[str, object]]:
    """The map that goes below ``effects:`` in a rig file."""
    out: dict[str, dict[str, object]] = {}
    for active in effects:
        key = active.effect.name
        for p in active.effect.parameters:
            if p.kind == 'choice':
                key += f'_{active.values[p.name]:g}'
        base, n = key, 2
        while key in out:
            key, n = f'{base}_{n}', n + 1
        body: dict[str, object] = {'name': active.effect.name}
        for p in active.effect.parameters:
            value = float(active.values[p.name])
            if math.isfinite(value):
                body[p.name] = int(value) if p.kind == 'choice' else value
        out[key] = body
    return out
