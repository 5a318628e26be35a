# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a machine that simulates itself tells of itself, so that :func:`discover_in` can ask it; and a table of readings
as such a machine."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.simulation.catalogue import catalogue, effects_for, effects_of_rig, sort_effects
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter, Values
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.model.solvers import solver_from_rig
from psd_deflection.recordings.read.references import TIMES, ReadingsTable, references_in
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import BoolArray, FloatArray, IntArray, dot_names
from psd_deflection.rig.config import Rig
from psd_deflection.studies.discover.conclusion import model_yaml
from psd_deflection.studies.discover.noise import settling
from psd_deflection.studies.discover.thresholds import CERTAIN_SD, FEWEST_CASES, FOLDS, HALF
from psd_deflection.studies.loads.plate_motion import dots_of
from psd_deflection.studies.loads.thresholds import FEWEST_LOADS, SEVERAL
from psd_deflection.studies.study import Notify, warn_caller

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

    def like(self, path: str | Path) -> Plant:
        """Return the same machine with the measurements of another file. Raises ConfigError if it reads none."""
        raise ConfigError(f'{path}: this machine is not read from files; pass a Plant')

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


CHANNELS: Mapping[str, tuple[str, ...]] = {
    'dots': dot_names(2),
    'estimates': ('dx', 'dy', 'theta'),
    'poses': ('ref_dx', 'ref_dy', 'ref_theta'),
}
"""Of two PSDs."""
OF_POSE = ('µm', 'µm', 'µrad')
MICRO = 1e6


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
        if count < FEWEST_LOADS:
            raise RecordingError(f'{self.name}: {count} different loads: discover needs at least {FEWEST_LOADS}')

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
            out.append(np.asarray(index.ravel() % min(FEWEST_CASES, len(t.distinct)), dtype=np.int64))
        return out

    def files(self, effects: Sequence[ActiveEffect]) -> Mapping[str, str]:
        """Return the rig file with the effects."""
        rig = self.tables[0].rig
        return {'model.yaml': model_yaml(self._params_file, rig, [*self.known, *effects], {}, self._notify)}

    def _rows(self, table: Readings, effects: Sequence[ActiveEffect], order: IntArray) -> FloatArray:
        """Return the readings (channels, n) of the rows, which are simulated in ``order``."""
        rig, warm = table.rig, table.temperature
        model = ForwardModel(rig, sort_effects([*self.known, *effects]), steady=True)
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


@dataclass(frozen=True, slots=True, eq=False)
class Resting:
    """``loads`` (k, 3) N, N, N m; ``poses`` (k, 3) m, m, rad; ``temperature`` (k,) degrees Celsius or None."""

    loads: FloatArray
    poses: FloatArray
    temperature: FloatArray | None


def resting_in(recording: Recording, rig: Rig) -> Resting:
    """The references of a recording without samples. Raises RecordingError if it has no loads or too few of them."""
    references = references_in(recording)
    applied = sorted(recording.loads(), key=lambda load: load.t_ns)
    if references is None or not applied:
        raise RecordingError(
            f'{recording.path}: holds references, but neither samples nor loads; loads (topic /link_tip/load) are '
            f'needed to compare it with a simulation'
        )
    start = int(references.t_ns[0])
    t = np.asarray((references.t_ns - start) * 1e-9, dtype=np.float64)
    times = np.array([(a.t_ns - start) * 1e-9 for a in applied], dtype=np.float64)
    warm = recording.temperatures()
    at = np.array([(w.t_ns - start) * 1e-9 for w in warm])
    celsius = np.asarray(np.interp(t, at, [w.celsius for w in warm]), dtype=np.float64) if warm else None
    return _rows(
        str(recording.path),
        rig,
        times,
        np.array([a[1:] for a in applied], dtype=np.float64),
        t,
        references.poses,
        celsius,
    )


def resting_rows(
    table: ReadingsTable, rig: Rig, loads: FloatArray, poses: FloatArray, warm: FloatArray | None
) -> Resting:
    """The references of a table with times, of which each row says its load (n, 3); a pose that is not there is NaN."""
    t = table.column(TIMES)
    order = np.argsort(t, kind='stable')
    celsius = None if warm is None else warm[order]
    return _rows(str(table.path), rig, t[order], loads[order], t[order], poses[order], celsius)


def _rows(
    name: str,
    rig: Rig,
    annotated: FloatArray,
    loads: FloatArray,
    t: FloatArray,
    poses: FloatArray,
    warm: FloatArray | None,
) -> Resting:
    """Medians of ``poses`` (n, 3) at ``t`` (n,) s, between changes of ``loads`` (k, 3) that were noted at (k,) s.

    A load is often noted late. If more than half of the time is under it, what is far from the median is not.
    """
    new = np.append(True, np.any(np.diff(loads, axis=0) != 0.0, axis=1))
    starts, changed = annotated[new], loads[new]
    stops = np.append(starts[1:], math.inf)
    there = np.isfinite(poses).all(axis=1)
    of, means, celsius = list[FloatArray](), list[FloatArray](), list[float]()
    for load, start, stop in zip(changed, starts, stops, strict=True):
        end = min(stop, float(t[-1]))
        applied = there & (t >= start) & (t < stop)
        if np.count_nonzero(applied) < SEVERAL:
            continue
        settled_samples = (
            applied & _near(poses, applied) & (t >= start + min(settling(rig), HALF * max(end - start, 0.0)))
        )
        if np.count_nonzero(settled_samples) >= SEVERAL:
            of.append(load)
            means.append(np.median(poses[settled_samples], axis=0))
            celsius.append(math.nan if warm is None else float(warm[settled_samples].mean()))
    if not of:
        raise RecordingError(f'{name}: no load hung for as long as {SEVERAL} references')
    return Resting(np.array(of), np.array(means), None if warm is None else np.array(celsius))


def _near(poses: FloatArray, applied: BoolArray) -> BoolArray:
    """(n,): whether ``poses`` (n, 3) are about as near to the median of those that ``applied`` as most of them."""
    off = np.abs(poses - np.median(poses[applied], axis=0))
    return np.asarray((off <= CERTAIN_SD * 1.4826 * np.median(off[applied], axis=0)).all(axis=1))
