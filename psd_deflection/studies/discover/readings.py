# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A table of readings: one row for each load that was hung on the link and left until it was at rest.

It is a plant for :func:`~psd_deflection.studies.discover.plant_search.discover_in`. Nobody knows how long each
reading was averaged, so the level of what remains is fitted. An effect takes part if what it does to a row depends
on that row alone: what depends on time or on the row before (drift, creep, friction, mains) cannot be distinguished
from a table.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.simulation.catalogue import catalogue, effects_for, effects_of_rig, sort_effects
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.model.solvers import solver_from_rig
from psd_deflection.records import FloatArray, IntArray, dot_names
from psd_deflection.rig.config import Rig
from psd_deflection.studies.discover.conclusion import model_yaml
from psd_deflection.studies.discover.plants import Model, Plant
from psd_deflection.studies.loads.plate_motion import dots_of
from psd_deflection.studies.study import Notify, warn_caller

CHANNELS: Mapping[str, tuple[str, ...]] = {
    'dots': dot_names(2),
    'estimates': ('dx', 'dy', 'theta'),
    'poses': ('ref_dx', 'ref_dy', 'ref_theta'),
}
"""Of two PSDs."""
OF_POSE = ('µm', 'µm', 'µrad')
MICRO = 1e6
LEAST_LOADS = 4
FOLDS = 6
"""Parts into which the loads are dealt in turn; each is left out of the fit once."""


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """One table. ``loads`` (n, 3) N, N, N m; ``values`` (n, channels) of ``kind``; ``temperature`` (n,) degrees Celsius
    or None.

    ``dots``: readings of the PSDs, m; ``estimates``: what the daemon made of them, m and rad; ``poses``: the tip's pose
    as something else measured it. NaN where nothing was read. Raises RecordingError if there is too little to search.
    """

    name: str
    rig: Rig
    kind: str
    loads: FloatArray
    values: FloatArray
    temperature: FloatArray | None = None
    digest: str = ''

    def __post_init__(self) -> None:
        count = len(self.distinct)
        if count < LEAST_LOADS:
            raise RecordingError(f'{self.name}: {count} different loads: discover needs at least {LEAST_LOADS}')

    @property
    def distinct(self) -> FloatArray:
        """The different loads (k, 3)."""
        return np.asarray(np.unique(self.loads, axis=0))

    @property
    def psds(self) -> int:
        """How many PSDs the rig has."""
        return len(self.rig.psds)


class ReadingsPlant(Plant):
    """The rig as its tables show it. All tables hold the same kind of readings; each has its own rig.

    ``known``: the effects that the rig file has already. Raises RecordingError if the tables differ in kind, or their
    rigs in the number of PSDs.
    """

    def __init__(
        self,
        tables: Sequence[Readings],
        without: Sequence[str] = (),
        params_file: str | Path | None = None,
        notify: Notify = warn_caller,
    ) -> None:
        """``params_file``: of the rig, if it has one. ``notify`` gets a warning if that cannot be edited."""
        kinds = {t.kind for t in tables}
        if len(kinds) > 1:
            words = ' and '.join(','.join(CHANNELS[k]) for k in sorted(kinds))
            raise RecordingError(f'{", ".join(t.name for t in tables)}: one has {words}: search them one by one')
        different = next((t for t in tables if t.psds != tables[0].psds), None)
        if different is not None:
            raise RecordingError(
                f'{different.name}: is of {different.psds} PSDs, {tables[0].name} of {tables[0].psds}: '
                'search them one by one'
            )
        self.tables = tuple(tables)
        self._params_file, self._notify = params_file, notify
        self.kind = tables[0].kind
        of_dots = self.kind == 'dots'
        self.channels = dot_names(tables[0].psds) if of_dots else CHANNELS[self.kind]
        self.units = ('µm',) * len(self.channels) if of_dots else OF_POSE
        if not of_dots:
            # A twist counts as what it moves at the distance of the PSDs.
            self.levers = (1.0, 1.0, float(np.sqrt(np.mean(np.sum(tables[0].rig.centers ** 2, axis=1)))))
        self.cases = tuple(t.name for t in tables)
        self.physics = Physics.of(tables[0].rig)
        self.known = tuple(effects_of_rig(tables[0].rig))
        self.library = tuple(
            e
            for effect in effects_for(tables[0].psds)
            if effect.name not in without and not effect.value_grid and (e := self._observable(effect)) is not None
        )

    def measured(self) -> Sequence[FloatArray]:
        """Return the readings, µm and µrad."""
        return [MICRO * t.values.T for t in self.tables]

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """Return the loads, and the temperature where every table has it."""
        names = ('load_fx / N', 'load_fy / N', 'load_tz / N m')
        out = {name: [t.loads[:, i] for t in self.tables] for i, name in enumerate(names)}
        warm = [t.temperature for t in self.tables if t.temperature is not None]
        if len(warm) == len(self.tables):
            out['temperature / °C'] = warm
        return out

    def simulate(self, model: Model) -> Sequence[FloatArray]:
        """What the rig would read with the effects of ``model``, each once."""
        every = catalogue(self.tables[0].psds)
        return self.simulate_effects([ActiveEffect(every[name], values) for name, values in model.items()])

    def simulate_effects(self, effects: Sequence[ActiveEffect]) -> Sequence[FloatArray]:
        """What the rig would read with ``effects``."""
        return [self._rows(t, effects, np.arange(len(t.loads))) for t in self.tables]

    def parts(self) -> Sequence[IntArray]:
        """All rows of one load are in one part."""
        out = []
        for t in self.tables:
            _, index = np.unique(t.loads, axis=0, return_inverse=True)
            out.append(np.asarray(index.ravel() % min(FOLDS, len(t.distinct)), dtype=np.int64))
        return out

    def files(self, effects: Sequence[ActiveEffect]) -> Mapping[str, str]:
        """Return the rig file with the effects."""
        rig = self.tables[0].rig
        return {'model.yaml': model_yaml(self._params_file, rig, [*self.known, *effects], {}, self._notify)}

    def _rows(self, table: Readings, effects: Sequence[ActiveEffect], order: IntArray) -> FloatArray:
        """Return the readings (channels, n) of the rows, which are simulated in ``order``."""
        rig, warm = table.rig, table.temperature
        model = ForwardModel(rig, sort_effects([*self.known, *effects]), settled=True)
        samples = model.expect(table.loads[order], None if warm is None else warm[order])
        dots = dots_of(rig, samples.volts)
        back = np.argsort(order)
        if self.kind == 'dots':
            return np.asarray(MICRO * dots[:, back])
        if self.kind == 'poses':
            return np.asarray(MICRO * samples.pose[:, back])
        pose = solver_from_rig(rig.estimator.solver, rig).solve_many(dots.T, dot_noise_variances(rig)).pose
        return np.asarray(MICRO * pose.T[:, back])

    def _observable(self, effect: Effect) -> Effect | None:
        """``effect`` without the choices that make no difference here; None if a table cannot show it."""
        table = self.tables[0]
        forward = np.arange(len(table.loads))
        # The first row stays: temperatures count from it.
        backward = np.concatenate((forward[:1], forward[:0:-1]))
        by_choice: dict[tuple[float, ...], list[FloatArray]] = {}
        choices = [p for p in effect.parameters if p.kind == 'choice' and not p.each]
        for choice in effect.variants(table.psds):
            active = ActiveEffect(effect, with_first_dose(effect, effect.off_values(self.physics, choice)))
            rows = self._rows(table, [active], forward)
            if not np.allclose(rows, self._rows(table, [active], backward), rtol=1e-9, atol=1e-6):
                return None
            by_choice.setdefault(tuple(choice[p.name] for p in choices), []).append(rows)
        first, *other_choices = by_choice.values()
        if choices and all(np.array_equal(a, b) for other in other_choices for a, b in zip(first, other, strict=True)):
            return dataclasses.replace(effect, parameters=tuple(map(fixed_choice, effect.parameters)))
        return effect


def with_first_dose(effect: Effect, off: Mapping[str, float]) -> dict[str, float]:
    """``effect`` with a small size and the first shape that its declaration names."""
    out = dict(off)
    for p in effect.parameters:
        if p.kind in ('amplitude', 'coupled'):
            dose = p.grid[-1] if p.grid else out[p.name] + p.scale
            out[p.name] = min(max(dose, p.minimum), p.maximum)
        elif p.kind == 'shape' and p.grid:
            out[p.name] = p.grid[0]
    return out


def fixed_choice(p: EffectParameter) -> EffectParameter:
    """Return a choice with one value, for one that makes no difference at rest; anything else as it is."""
    if p.kind != 'choice' or p.each:
        return p
    return dataclasses.replace(p, choices=(int(p.nominal) if p.nominal in p.choices else p.choices[0],))
