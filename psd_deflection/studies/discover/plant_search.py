# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The same search on any machine that can simulate itself, :func:`discover_in`: the level of what remains is a
parameter of its likelihood (N log RSS for each channel), and N counts correlation times."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri, stdtrit
from scipy.stats import chi2 as chi2_law

from psd_deflection.base.charts import TimeAxis
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.studies.discover.conclusion import Conclusion
from psd_deflection.studies.discover.noise import NoiseModel
from psd_deflection.studies.discover.plants import Model, Plant, check_plant, measured_tables, table_of
from psd_deflection.studies.discover.problem import Machine, Progress
from psd_deflection.studies.discover.report import sections
from psd_deflection.studies.discover.search.comparison import Comparison, SimulationCount
from psd_deflection.studies.discover.search.fit import Fit, heldout_tables, refit
from psd_deflection.studies.discover.search.localise import Cell, Localisation, dependences
from psd_deflection.studies.discover.search.predictive import as_model
from psd_deflection.studies.discover.search.screen import Screen, candidates, signatures_beside
from psd_deflection.studies.discover.search.smooth import Smooth, Table, smooth_of
from psd_deflection.studies.discover.search.weighing import sd_of
from psd_deflection.studies.discover.steps import alternatives, fields_of, predict, search, solve, weigh, where
from psd_deflection.studies.discover.thresholds import LEAST_LEVEL, P_CHANCE, PLANT_BUDGET, SIGNIFICANT
from psd_deflection.studies.loads.thresholds import PART, SAME
from psd_deflection.studies.study import PageSection


def _exact(plant: Plant, measured: Sequence[FloatArray], nuisance: Sequence[ActiveEffect]) -> npt.NDArray[np.bool_]:
    """Channels (c,) that never change and are exactly as simulated, if others are not: no measurement."""
    tables = np.concatenate(list(measured), axis=1)
    there = np.isfinite(tables)
    low = np.where(there, tables, np.inf).min(axis=1, initial=np.inf)
    high = np.where(there, tables, -np.inf).max(axis=1, initial=-np.inf)
    constant = there.any(axis=1) & (low == high)
    if not constant.any() or constant[there.any(axis=1)].all():
        return np.zeros(len(constant), dtype=bool)
    for m, s in zip(measured, plant.simulate_effects(nuisance), strict=False):
        if np.shape(m) == np.shape(s):
            constant &= np.all(~np.isfinite(m) | (m == s), axis=1)
    return np.asarray(constant)


class PlantComparison(Comparison):
    """A plant's cases, measured and simulated. Raises ConfigError if its tables do not fit each other."""

    open_level = True
    budget = PLANT_BUDGET
    most_budgets = math.inf
    # Its values are few, and one machine is asked once.
    p_accept = P_CHANCE

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.physics = plant.physics
        self.tally = SimulationCount()
        self.base = ()
        self.nuisance = tuple(ActiveEffect(e, e.off_values(plant.physics, next(e.variants()))) for e in plant.nuisance)
        self.measured = measured_tables(plant)
        check_plant(plant)
        exact = _exact(plant, self.measured, self.nuisance)
        # Readings that are the simulation's to the last digit are no measurement: nothing can be held against them.
        self.measured = [np.where(exact[:, None], np.nan, m) for m in self.measured]
        self.exact = tuple(name for name, e in zip(plant.channels, exact.tolist(), strict=True) if e)
        self.there = [np.isfinite(m) for m in self.measured]
        self.total = np.sum([t.sum(axis=1) for t in self.there], axis=0)
        for name, count in zip(plant.channels, self.total.tolist(), strict=True):
            if count < 2 and name not in self.exact and self.total.max() < 2:
                raise ConfigError(f'measured: {name} has {count} values in all: must be at least 2')
        self.case: list[IntArray] = []
        for part in plant.parts():
            self.case.append(part + (int(self.case[-1].max()) + 1 if self.case else 0))
        self.known = np.array(plant.noise or (0.0,) * len(plant.channels))
        self.shares = len(set(plant.units)) > 1 and not plant.levers
        self.levers = np.array(plant.levers or (1.0,) * len(plant.channels))
        self.full = np.ones(len(plant.channels))
        self.level = np.ones(len(plant.channels))
        self.independent = np.ones(len(plant.channels))
        self.level, self.independent = self._noise_beside(self.nuisance)
        self.correlated = self._alike(self.independent)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the cases."""
        return self.plant.cases

    @property
    def channels(self) -> tuple[str, ...]:
        """Of the plant."""
        return self.plant.channels

    @property
    def periods(self) -> list[float]:
        """s between columns; 1 if every column is a reading by itself."""
        return [self.plant.period or 1.0] * len(self.measured)

    @property
    def size(self) -> int:
        """Values that were measured."""
        return int(self.total.sum())

    @property
    def scale(self) -> FloatArray:
        """(channels,): by what a residual is divided. The squares of N independent values then add up to N."""
        return np.asarray(self.level * np.sqrt(np.maximum(self.total, 1) / self.independent))

    def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
        """The plant's own simulation. Raises ConfigError if it does not fit what was measured or is not finite."""
        self.tally.count += 1
        simulated = self.plant.simulate_effects(effects)
        if len(simulated) != len(self.measured):
            raise ConfigError(f'simulate: {len(simulated)} tables for {len(self.measured)} cases')
        out = []
        for name, rows, m, there in zip(self.plant.cases, simulated, self.measured, self.there, strict=True):
            table = table_of(rows, f'simulate, {name}')
            if table.shape != m.shape:
                raise ConfigError(f'simulate, {name}: has the shape {table.shape}: must be that of measured, {m.shape}')
            if not np.isfinite(table[there]).all():
                model = {a.effect.name: dict(a.values) for a in effects}
                raise ConfigError(f'simulate, {name}: not finite with {model}: narrow the bounds of these parameters')
            out.append(table)
        return out

    def whiten(self, tables: Sequence[FloatArray]) -> FloatArray:
        """Return one vector; the squares of a residual add up to the number of independent values."""
        scale = self.scale[:, None]
        parts = [np.where(t, x / scale, 0.0).ravel() for x, t in zip(tables, self.there, strict=True)]
        return np.concatenate(parts)

    def _noise_beside(self, effects: Sequence[ActiveEffect]) -> tuple[FloatArray, FloatArray]:
        """Level (channels,) and number of independent values (channels,) of what remains with ``effects``."""
        difference = [m - s for m, s in zip(self.measured, self.simulate(effects), strict=True)]
        squares = np.sum([np.where(t, d**2, 0.0).sum(axis=1) for d, t in zip(difference, self.there, strict=True)], 0)
        level = np.sqrt(squares / np.maximum(self.total, 1))
        # What is left of an exact simulation is rounding: no level is below that.
        tables = np.concatenate([np.nan_to_num(m) for m in self.measured], axis=1)
        size = np.abs(tables).max(axis=1, initial=0.0)
        tiny = math.sqrt(np.finfo(np.float64).tiny)
        level = np.maximum(np.maximum(level, self.known), np.maximum(LEAST_LEVEL * size, tiny))
        independent = np.array([self._independent(difference, c) for c in range(len(self.channels))])
        return level, independent

    def renoised(self, effects: Sequence[ActiveEffect]) -> Self:
        """With level and independent values of what remains with ``effects``; this one if they are the same."""
        level, independent = self._noise_beside(effects)
        # Relative alone: a level in metres may be far below the 1e-8 that allclose lets pass.
        if all(
            np.allclose(a, b, rtol=SAME, atol=0.0) for a, b in ((level, self.level), (independent, self.independent))
        ):
            return self
        return self.replaced(level=level, independent=independent, correlated=self._alike(independent))

    def _alike(self, independent: FloatArray) -> bool:
        """Return whether what remains is alike from one value to the next, and no noise is stated."""
        return not self.plant.noise and float(independent.sum()) < PART * float(self.total.sum())

    def _independent(self, difference: Sequence[FloatArray], channel: int) -> float:
        """Values over the integrated correlation time, which ends at its first zero."""
        if self.plant.period <= 0.0:
            return max(float(self.total[channel]), 1.0)
        count = 0.0
        for d, there in zip(difference, self.there, strict=True):
            valid = there[channel]
            if not valid.any():
                continue
            x = np.where(valid, d[channel] - d[channel][valid].mean(), 0.0)
            n = len(x)
            autocorrelation = np.fft.irfft(np.abs(np.fft.rfft(x, 2 * n)) ** 2, 2 * n)[:n]
            correlation = autocorrelation / max(float(autocorrelation[0]), 1e-300)
            negative = np.flatnonzero(correlation < 0.0)
            stop = int(negative[0]) if len(negative) else n
            count += float(valid.sum()) / (1.0 + 2.0 * float(correlation[1:stop].sum()))
        return max(count, 2.0)

    def sd(self, jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
        """(p,): with them, 1.96 sd are the 95 % interval of Student's t, because few values tell a channel's level.

        The degrees of freedom of a parameter that several channels tell of are those of Welch (1947).
        """
        rows = np.concatenate([np.repeat(np.arange(len(m)), m.shape[1]) for m in self.measured])
        propagated = jacobian @ covariance
        fitted = np.bincount(rows, (propagated * jacobian).sum(axis=1), len(self.channels))
        freedom = np.maximum(self.independent - fitted, 1.0)
        by_channel = np.zeros((len(self.channels), len(covariance)))
        np.add.at(by_channel, rows, propagated**2)
        open_level = self.level > self.known
        by_channel *= np.where(open_level, self.independent / freedom, 1.0)[:, None]
        variance = by_channel.sum(axis=0)
        share = by_channel / np.maximum(variance, 1e-300)
        unsure = (share**2 * np.where(open_level, 1.0 / freedom, 0.0)[:, None]).sum(axis=0)
        return np.asarray(np.sqrt(variance) * stdtrit(1.0 / np.maximum(unsure, 1e-9), 0.975) / ndtri(0.975))

    def effective_size(self) -> float:
        """Independent values of all channels."""
        return float(self.independent.sum())

    def _loss(self, squares: FloatArray) -> FloatArray:
        """Of mean squares relative to the level (channels, …): with their own level, not below the noise."""
        least = (self.known / self.level).reshape(-1, *[1] * (squares.ndim - 1)) ** 2
        level = np.maximum(np.maximum(squares, least), 1e-30)
        return np.asarray(np.log(level) + squares / level)

    def loss(self, residual: FloatArray) -> float:
        """Twice the negative log-likelihood, with the level of each channel as what remains shows it."""
        squares = np.sum([np.sum(part**2, axis=1) for part in self.split(residual)], axis=0)
        return float(np.sum(self.independent * self._loss(squares / self.independent)))

    def pieces(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Log-likelihood gained on each fold at a level of its own, so that a bad case does not rule the others."""
        cases = self.row_cases()
        rows = np.concatenate([np.repeat(np.arange(len(m)), m.shape[1]) for m in self.measured])
        there = np.concatenate([t.ravel() for t in self.there])
        folds = int(cases.max()) + 1
        count = np.zeros((len(self.channels), folds))
        np.add.at(count, (rows[there], cases[there]), 1.0)
        gained = np.zeros_like(count)
        for sign, vector in ((0.5, a), (-0.5, b)):
            squares = np.zeros_like(count)
            np.add.at(squares, (rows, cases), vector**2)
            squares *= self.total[:, None] / self.independent[:, None] / np.maximum(count, 1.0)
            gained += sign * self._loss(squares)
        return np.asarray((gained * count * (self.independent / np.maximum(self.total, 1))[:, None]).sum(axis=0))

    def unwhitened(self, white: FloatArray) -> list[FloatArray]:
        """Return a vector in the units of the channels."""
        return [part * self.scale[:, None] for part in self.split(white)]

    def folds(self) -> IntArray:
        """Every case is one."""
        return np.arange(max(int(c.max()) for c in self.case) + 1)

    def gap_per_channel(self, residual: Sequence[FloatArray]) -> FloatArray:
        """rms of each channel, in its unit."""
        squares = [np.where(t, d, 0.0) ** 2 for d, t in zip(residual, self.there, strict=True)]
        return np.asarray(np.sqrt(np.sum([s.sum(axis=1) for s in squares], axis=0) / np.maximum(self.total, 1)))

    def _joined(self, gaps: FloatArray) -> float:
        if self.shares:
            return float(np.sqrt(np.mean((gaps / self.full)[self.total > 0] ** 2)))
        return float(np.sqrt(np.sum(self.total * (self.levers * gaps) ** 2) / self.total.sum()))

    def gap(self, residual: Sequence[FloatArray]) -> float:
        """rms over all channels; if their units differ and nobody says what they count, each relative to its gap
        before, which is then 1.
        """
        return self._joined(self.gap_per_channel(residual))

    def floor(self) -> float:
        """Return the gap from the plant's noise; NaN if that is not known."""
        return self._joined(self.known) if self.plant.noise else float('nan')

    @property
    def unit(self) -> str:
        """That of the channels if they have one, or of the first."""
        return 'share of the gap before' if self.shares else self.plant.units[0]

    @property
    def display_scale(self) -> tuple[float, str]:
        """The unit of the channels if they have one, else shares."""
        return (100.0, '% of the gap before') if self.shares else (1.0, self.plant.units[0])

    @property
    def display_units(self) -> tuple[str, ...]:
        """Those of the channels."""
        return self.plant.units

    def displayed(self, tables: Sequence[FloatArray]) -> list[FloatArray]:
        """As they are."""
        return [np.where(t, x, np.nan) for x, t in zip(tables, self.there, strict=True)]

    def along(self) -> tuple[str | TimeAxis, list[FloatArray]]:
        """Time, cases one after another, or number of the reading."""
        period = self.plant.period
        ends = np.cumsum([0, *(m.shape[1] for m in self.measured)])
        along = [(a + np.arange(m.shape[1])) * (period or 1.0) for a, m in zip(ends[:-1], self.measured, strict=True)]
        return TimeAxis('(cases one after another)', ()) if period > 0.0 else 'number of the reading', along

    def against(self) -> dict[str, list[FloatArray]]:
        """Return the inputs, and what was measured."""
        out = {name: [np.asarray(v) for v in values] for name, values in self.plant.inputs().items()}
        for c, (channel, unit) in enumerate(zip(self.channels, self.plant.units, strict=True)):
            out[f'{channel} / {unit}' if unit else channel] = [m[c] for m in self.measured]
        return out

    def provenance(self) -> list[dict[str, object]]:
        """Of each case: how much was measured."""
        return [
            {'name': name, 'values': int(t.sum()), 'lost': int(t.size - t.sum())}
            for name, t in zip(self.names, self.there, strict=True)
        ]

    def begun(self, null: Fit) -> Self:
        """With what the fit without any effect leaves as the gap before."""
        gap_before = np.maximum(self.gap_per_channel(null.difference), 1e-300)
        return self.replaced(full=gap_before).renoised([*self.base, *null.coefficients_with_nuisance])


@dataclass(frozen=True, eq=False, repr=False)
class PlantDiscovery(Conclusion):
    """The answer for a plant. If the units of its channels differ, the gaps are shares of the gap before;
    ``per_channel`` always has the units of the channels. ``gap_floor`` is NaN if the plant states no noise.
    """

    workspace: PlantComparison

    def search_in_simulation(self, seed: int) -> Callable[[], PlantDiscovery]:
        """Return the same search in tables that the found model simulates; ``seed``: of their noise."""
        return partial(discover_in, simulated_plant(self, seed), seed=self.seed)

    def sections(self) -> Iterable[PageSection]:
        """Return the gap step by step, what is missing, what is unknown, before and after, how it was found."""
        return sections(self)

    def files(self) -> dict[str, str]:
        """Return the page, the JSON, and what the plant itself writes of the effects."""
        return {**self.workspace.plant.files([e.active for e in self.effects]), **super().files()}

    @property
    def predictive(self) -> Model:
        """Effect to values of the model that predicts best: named effects and nuisance, and what helps beyond them."""
        return as_model(self.predicting)

    def predict(self, plant: Plant | str | Path) -> list[FloatArray]:
        """What the model that predicts best says of ``plant``, of each case (channels, n): the same machine, perhaps in
        cases that the search has not seen. After a search in a CSV table: another table.
        """
        if not isinstance(plant, Plant):
            plant = self.workspace.plant.like(plant)
        return [np.asarray(rows, dtype=np.float64) for rows in plant.simulate_effects(self.predicting)]


def simulated_plant(answer: PlantDiscovery, seed: int) -> Plant:
    """Return the plant with what its found model would have measured: noise as stated, else as what remains."""
    rng, ws, fit = np.random.default_rng(seed), answer.workspace, answer.fit
    freedom = np.maximum(ws.independent - len(fit.free) / len(ws.channels), 1.0)
    level = np.where(ws.known > 0.0, ws.known, ws.gap_per_channel(fit.difference) * np.sqrt(ws.independent / freedom))
    apart = np.maximum(ws.total, 1) / ws.independent if ws.plant.period > 0.0 else np.ones(len(level))
    memory = (np.maximum(apart - 1.0, 0.0) / (apart + 1.0))[:, None]
    noise = NoiseModel(level, 0.0 * memory, level, level, 0.0, (), None, memory)
    simulated = ws.simulate([*ws.base, *fit.coefficients_with_nuisance])
    tables = [
        # A channel that the model simulates to the last digit is no measurement.
        np.where(there, s + noise.draw(s.shape[1], ws.plant.period, rng).T, np.where(ws.total[:, None], np.nan, given))
        for given, s, there in zip(ws.plant.measured(), simulated, ws.there, strict=True)
    ]
    plant = copy.copy(ws.plant)
    vars(plant)['measured'] = partial(list, tables)
    return plant


def _powers(name: str, values: Sequence[FloatArray]) -> dict[str, Sequence[FloatArray]]:
    return {name: values, f'{name}^2': [v**2 for v in values], f'{name}^3': [v**3 for v in values]}


def regressors(ws: PlantComparison, fit: Fit) -> Table:
    """Of each channel: time, the inputs, its own reading and rate."""
    simulated = [m - d for m, d in zip(ws.measured, fit.difference, strict=True)]
    shared: dict[str, Sequence[FloatArray]] = {'constant': [np.ones(m.shape[1]) for m in ws.measured]}
    if ws.plant.period > 0.0:
        time = [np.linspace(-1.0, 1.0, m.shape[1]) for m in ws.measured]
        shared.update({'time': time, 'time^2': [t**2 for t in time]})
    for name, values in ws.plant.inputs().items():
        shared.update(_powers(name, [np.asarray(v, dtype=np.float64) for v in values]))
    out = []
    for c, channel in enumerate(ws.channels):
        simulated_values = [np.nan_to_num(s[c]) for s in simulated]
        named = {**shared, **_powers(channel, simulated_values), f'|{channel}|': [np.abs(x) for x in simulated_values]}
        if ws.plant.period > 0.0 and min(len(x) for x in simulated_values) > 1:
            rate = [np.gradient(x) for x in simulated_values]
            named.update({f'rate of {channel}': rate, f'sign of rate of {channel}': [np.sign(r) for r in rate]})
        out.append((channel, named))
    return out


def localise_cases(ws: PlantComparison, fit: Fit, known: FloatArray | None) -> Localisation:
    """What ``fit`` leaves by case and channel, and what it follows. Only what it follows makes it an unknown effect: a
    case may be worse than others because it moves more.
    """
    depends = dependences(ws, regressors(ws, fit), fit.residual, known)
    cells = []
    shown = np.zeros((len(ws.names), len(ws.channels), 1))
    tried = shown.size
    for i, part in enumerate(ws.split(fit.residual)):
        for c, channel in enumerate(ws.channels):
            count = int(ws.there[i][c].sum())
            if not count:
                continue
            dof = ws.independent[c] * count / ws.total[c]
            energy = float(np.sum(part[c] ** 2))
            z = (np.cbrt(energy / dof) - (1.0 - 2.0 / (9.0 * dof))) / np.sqrt(2.0 / (9.0 * dof))
            p = float(-np.expm1(tried * np.log1p(-min(float(chi2_law.sf(energy, dof)), 1.0 - 1e-16))))
            shown[i, c, 0] = z
            names = tuple(d.regressor for d in depends if d.channel == channel and d.p < P_CHANCE)[:2]
            period = ws.plant.period
            end = part.shape[1] * period if period > 0.0 else 0.0
            band = (0.0, 0.5 / period if period > 0.0 else 0.0)
            cells.append(Cell(channel, i, (0.0, end), band, names, float(z), p, energy - dof))
    cells.sort(key=lambda cell: -cell.statistic)
    first = depends[0] if depends else None
    spans = tuple((i, 0.0, m.shape[1] * ws.plant.period) for i, m in enumerate(ws.measured))
    excess, p = (0.0, 1.0) if first is None else (first.gain, first.p)
    return Localisation(tuple(cells), tuple(depends), excess, p, shown, spans)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedPlant(Machine):
    """A plant as the steps ask for it. ``start``: its comparison; ``nuisance``: as fitted without any effect."""

    plant: Plant
    start: PlantComparison
    nuisance: tuple[ActiveEffect, ...]

    @classmethod
    def of(cls, plant: Plant) -> SimulatedPlant:
        """``plant`` as it is described. Raises ConfigError if it contradicts itself."""
        ws = PlantComparison(plant)
        null = refit(ws, (), iterations=12)
        return cls(plant=plant, start=ws.begun(null), nuisance=null.nuisance)

    def compared(self) -> PlantComparison:
        """Measured against simulated."""
        return self.start

    def screen(self, comparison: Comparison, fit: Fit | None) -> Screen:
        """Return the plant's library, always beside what the model has already: a rough machine is far from linear."""
        beside = refit(comparison, (), nuisance=self.nuisance) if fit is None else fit
        listed = candidates(self.plant.library, self.plant.physics, {})
        return Screen(comparison, signatures_beside(comparison, listed, beside))

    def look(self, comparison: Comparison, fit: Fit, null: Fit | None, rng: np.random.Generator) -> Localisation:
        """By case and channel, and what it follows."""
        return localise_cases(_of_plant(comparison), fit, fit.jacobian if fit.free else None)

    def regressors(self, comparison: Comparison, fit: Fit) -> Table:
        """Time, the plant's inputs, and the channel's own reading and rate."""
        return regressors(_of_plant(comparison), fit)

    def smooth(self, comparison: Comparison, fit: Fit) -> Smooth | None:
        """Of the plant's variables, if more than its noise remains."""
        if comparison.gap(fit.difference) <= SIGNIFICANT * comparison.floor():
            return None
        return smooth_of(comparison, fit, self.plant.variables())


def _of_plant(comparison: Comparison) -> PlantComparison:
    if not isinstance(comparison, PlantComparison):
        raise TypeError(f'{type(comparison).__name__}: not that of a plant')
    return comparison


def discover_in(plant: Plant, *, seed: int = 0, progress: Progress = lambda _: None) -> PlantDiscovery:
    """Name the effects that the simulation of ``plant`` lacks to explain what was measured.

    The search, the rules and the answer are those of :func:`psd_deflection.discover`; the whole cases are left out in
    turn. The same ``seed`` gives the same answer. Raises ConfigError if the plant contradicts itself.
    """
    rng = np.random.default_rng(seed)
    progress('simulating the plant as it is described')
    machine = SimulatedPlant.of(plant)
    problem = solve(machine, (search, weigh, alternatives, where, predict), seed, progress, rng)
    ws, fit = problem.comparison, problem.fit
    return PlantDiscovery(
        **fields_of(problem)
        | {
            'gap_heldout_before': ws.gap(heldout_tables(ws, problem.null)),
            'nuisance': tuple((a, sd_of(ws, fit, i - len(fit.nuisance))) for i, a in enumerate(fit.nuisance)),
        }
    )
