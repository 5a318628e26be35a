# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a machine that simulates itself tells of itself, so that :func:`discover_in` can ask it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray, IntArray

FOLDS = 4
"""Parts that are left out in turn, at least; few cases are cut into pieces."""

Model = Mapping[str, Values]
"""Name of an effect to the values of its parameters."""


def plant_effect(
    name: str,
    *parameters: EffectParameter,
    summary: str = '',
    equation: str = '',
    source: str = '',
    finite: bool = False,
) -> Effect:
    """Return an effect of a plant, which its ``simulate`` finds in the model under ``name``.

    Each parameter's ``nominal`` is the value at which the effect is off, ``scale`` roughly its prior standard
    deviation. ``finite``: a small change at the nominal value shows nothing (a limit that is not reached), so exactly
    the values of the parameter's ``grid`` are tried. Raises ConfigError for a parameter that refers to a rig.
    """
    for p in parameters:
        if p.of_rig or p.within is not None or p.propose:
            raise ConfigError(f'{name}: {p.name}: of_rig, within and propose are for effects of the PSD rig; leave out')
    return Effect(
        name, 'link', summary, equation, source, '', tuple(parameters), 'configure', _per_plant, finite=finite
    )


def _per_plant(physics: Physics, values: Values) -> None:
    raise TypeError('an effect of a plant is simulated by its plant')


class Plant(ABC):
    """A machine: what was measured of it, and its simulation with any of its effects on.

    ``channels``, with their ``units``: the rows of every table. ``cases``: names of the recordings, or of what else is
    left out of the fit in one piece to test it (a length, a trajectory). ``library``: the effects that may be missing;
    ``nuisance``: those whose size is not known, which every model has and which are never named. ``noise``: of each
    channel, rms; empty if not known. ``levers``: what one unit of each channel counts as in that of the first, if it
    does (a small angle at some distance is a movement). ``period``: s between the columns; 0: every column is a reading
    by itself. ``physics``: of a PSD rig, whose effects have bounds that depend on it.
    """

    channels: tuple[str, ...]
    units: tuple[str, ...]
    cases: tuple[str, ...]
    library: tuple[Effect, ...]
    nuisance: tuple[Effect, ...] = ()
    noise: tuple[float, ...] = ()
    levers: tuple[float, ...] = ()
    period: float = 0.0
    physics: Physics | None = None

    @abstractmethod
    def measured(self) -> Sequence[FloatArray]:
        """Of each case (channels, n); NaN where nothing was measured."""

    @abstractmethod
    def simulate(self, model: Model) -> Sequence[FloatArray]:
        """Return the same with the effects of ``model`` on, without noise."""

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """What was done to the machine, by name: of each case (n,). What remains is held against it."""
        return {}

    def variables(self) -> Mapping[str, Sequence[FloatArray]]:
        """Of what an unnamed smooth function may be determined, by name: of each case (n,), or (n, k) if a variable has
        several coordinates, as a direction has. By default each of the inputs.
        """
        return self.inputs()

    def simulate_effects(self, effects: Sequence[ActiveEffect]) -> Sequence[FloatArray]:
        """What the search calls: :meth:`simulate`, unless a plant may have one effect several times."""
        return self.simulate({a.effect.name: dict(a.values) for a in effects})

    def files(self, effects: Sequence[ActiveEffect]) -> Mapping[str, str]:
        """Files by name that describe the machine with the ``effects`` found; they are saved with the answer."""
        return {}

    def parts(self) -> Sequence[IntArray]:
        """Of each case, the part (n,), from 0, that each column is in. A part is left out of the fit in one piece to
        test it: by default the whole case, or a piece of it where there are few cases.
        """
        pieces = -(-FOLDS // len(self.cases))
        counts = [np.shape(m)[1] for m in self.measured()]
        return [np.arange(n) * pieces // n for n in counts]


def table_of(rows: object, source: str) -> FloatArray:
    """``rows`` as an array; ``source`` names it in the ConfigError that is raised if they are no numbers."""
    try:
        table = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f'{source}: must be numbers, (channels, n)') from None
    return table


def measured_tables(plant: Plant) -> list[FloatArray]:
    """Return the tables of ``plant``. Raises ConfigError if they do not fit its channels and cases."""
    tables = plant.measured()
    if len(tables) != len(plant.cases):
        raise ConfigError(f'measured: {len(tables)} tables for {len(plant.cases)} cases')
    measured = [table_of(t, f'measured, {c}') for c, t in zip(plant.cases, tables, strict=True)]
    if not measured:
        raise ConfigError('cases: there is none; discover_in needs at least one')
    for name, rows in zip(plant.cases, measured, strict=True):
        if rows.ndim != 2 or len(rows) != len(plant.channels) or rows.shape[1] < 1:
            raise ConfigError(f'measured, {name}: has the shape {rows.shape}: must be ({len(plant.channels)}, n)')
    return measured


def check_plant(plant: Plant) -> None:
    """Raise ConfigError if units, noise, levers and library contradict each other."""
    if len(plant.units) != len(plant.channels):
        raise ConfigError(f'units: {len(plant.units)} of them for {len(plant.channels)} channels')
    if plant.noise and (len(plant.noise) != len(plant.channels) or min(plant.noise) <= 0.0):
        raise ConfigError(f'noise = {plant.noise}: must be one number above 0 for each channel, or none at all')
    if plant.levers and (len(plant.levers) != len(plant.channels) or min(plant.levers) <= 0.0):
        raise ConfigError(f'levers = {plant.levers}: must be one number above 0 for each channel, or none at all')
    names = [e.name for e in (*plant.library, *plant.nuisance)]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(f'library: {", ".join(twice)} is there twice, in library or nuisance')
