# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What predicts, beside what is named: the mean over all subsets of the library's terms. The error on unseen cases is
nested: terms and sizes are chosen anew without the cases that judge them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import stdtr

from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.records import BoolArray, FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.screen import Candidate, Screen
from psd_deflection.studies.discover.search.subsets import averaged
from psd_deflection.studies.discover.search.trials import slot, unbound
from psd_deflection.studies.discover.thresholds import STEP

MOST_FOLDS = 11
"""Parts are joined to so many groups, each left out in turn."""
ELSEWHERE = 0.1
"""Relative rms by which the simulation may differ from the straight line to it, before another line is drawn."""
ROUNDS = 4
LOWERS = 0.05
"""Share by which the unseen error must fall at least before anything is said to remain."""
CHANCE = 0.01
"""One-sided p of Student's paired t over the unseen cases, up to which the fall is beyond chance: one that the named
effects predict badly proves nothing."""
NEGLIGIBLE = 0.003
"""A term that moves less than this share of what remains is left out of the list and of the model."""
MOST_VALUES = 4e7
"""Values of all signatures together: more would need more than 0.3 GB."""


@dataclass(frozen=True, slots=True)
class PredictingTerm:
    """``name``: effect with its choices, and its parameter if it has several. ``value`` in ``unit``; ``weight``: how
    likely it takes part, from 0 to 1.
    """

    name: str
    value: float
    unit: str
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class Predictive:
    """``effects``: the model that predicts best, nuisance first. ``terms``: beyond the named effects, the largest
    first. ``unseen``: the gap on cases for which terms and sizes were chosen without them; ``unseen_named``: that of
    the named effects, fitted or averaged without them. ``unexplained``: whether the difference is beyond chance.
    """

    effects: tuple[ActiveEffect, ...]
    terms: tuple[PredictingTerm, ...]
    unseen: float
    unseen_named: float
    unexplained: bool

    def tree(self) -> dict[str, Any] | None:
        """As result.json has it; None if nothing remains."""
        if not self.unexplained:
            return None
        terms = [{'name': t.name, 'value': t.value, 'unit': t.unit, 'weight': t.weight} for t in self.terms]
        return {'terms': terms, 'unseen': self.unseen, 'unseen_named': self.unseen_named, 'nested': True}

    def sentence(self, ws: Comparison) -> str:
        """What more there is, in words."""
        likely = [t for t in self.terms if t.weight >= 0.5]
        listed = likely or self.terms[:3]
        names = ', '.join(f'{t.name} {t.value:.3g} {t.unit}'.rstrip() for t in listed[:8])
        more = len(self.terms) - min(len(listed), 8)
        rest = f' and {more} smaller' if more > 0 else ''
        count = f'{len(self.terms)} small term{"" if len(self.terms) == 1 else "s"}'
        return (
            f'Beyond the named effects, {count} together lower the unseen error from {ws.worded(self.unseen_named)} to '
            f'{ws.worded(self.unseen)} ({names}{rest}); none of them is proven by itself.'
        )


@dataclass(frozen=True, slots=True)
class _Number:
    """A number of the model: parameter ``name`` of effect ``index``; ``off``: its value without effect."""

    index: int
    name: str
    off: float
    low: float
    high: float
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class _Library:
    """``effects``, of which the first ``fixed`` are the nuisance. ``places``: numbers that may move; the first
    ``always`` of them are in every model.
    """

    ws: Comparison
    effects: tuple[ActiveEffect, ...]
    fixed: int
    places: tuple[_Number, ...]
    always: int

    def at(self, x: FloatArray) -> list[ActiveEffect]:
        """Return the effects with the numbers ``x``; those that are off are left out."""
        values = [dict(a.values) for a in self.effects]
        on = [i < self.fixed for i in range(len(values))]
        for place, v in zip(self.places, x.tolist(), strict=True):
            values[place.index][place.name] = v
            on[place.index] = on[place.index] or v != place.off
        return [ActiveEffect(a.effect, v) for a, v, o in zip(self.effects, values, on, strict=True) if o]

    def residual(self, x: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """Whitened, and in the units of the channels."""
        return self.ws.residual([*self.ws.base, *self.at(x)])

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Whitened (D, p), per unit of each number."""
        nominal = self.ws.simulate([*self.ws.base, *self.at(x)])
        out = np.empty((sum(m.size for m in self.ws.measured), len(x)))
        for j, place in enumerate(self.places):
            h = STEP * place.scale if x[j] + STEP * place.scale <= place.high else -STEP * place.scale
            moved = x.copy()
            moved[j] += h
            table = self.ws.simulate([*self.ws.base, *self.at(moved)])
            out[:, j] = self.ws.whiten([(a - b) / h for a, b in zip(table, nominal, strict=True)])
        return out


def _library(ws: Comparison, fit: Fit, screen: Screen) -> tuple[_Library, FloatArray]:
    """What may take part, and the numbers of ``fit``."""
    effects, places, x = list(fit.coefficients_with_nuisance), list[_Number](), list[float]()
    fixed = len(fit.nuisance)

    def add(index: int, name: str) -> None:
        active = effects[index]
        p = active.effect.parameter(name)
        low, high = p.bounds(ws.physics, active.values)
        places.append(_Number(index, name, p.off(ws.physics), low, high, p.scale))
        x.append(active.values[name])

    named = [(i + fixed, name) for i, name in fit.free]
    straight = [
        i >= fixed and not effects[i].effect.finite and effects[i].effect.parameter(name).kind == 'amplitude'
        for i, name in named
    ]
    inside_bounds = [place not in fit.at_bound for place in fit.free]
    for (i, name), is_term, is_kept in zip(named, straight, inside_bounds, strict=True):
        if is_kept and not is_term:
            add(i, name)
    always = len(places)
    for (i, name), is_term in zip(named, straight, strict=True):
        if is_term:
            add(i, name)
    room = int(MOST_VALUES / max(len(fit.residual), 1)) - len(places)
    for candidate in _best_shapes(ws, fit, screen)[: max(room, 0)]:
        effects.append(ActiveEffect(candidate.effect, {**candidate.off, **_shape(candidate)}))
        for name in candidate.free:
            add(len(effects) - 1, name)
    return _Library(ws, tuple(effects), fixed, tuple(places), always), np.array(x)


def _shape(candidate: Candidate) -> dict[str, float]:
    """Its choices and shapes; its sizes stay off."""
    return {n: v for n, v in candidate.start.items() if n not in candidate.free}


def _best_shapes(ws: Comparison, fit: Fit, screen: Screen) -> list[Candidate]:
    """Of each further effect whose sizes count in proportion the candidate that explains most beside ``fit``."""
    taken = {slot(a.effect, a.values) for a in fit.coefficients_with_nuisance}
    best: dict[tuple[object, ...], Candidate] = {}
    for score in screen.score(fit.residual, unbound(fit)):
        c = score.candidate
        sized = all(c.effect.parameter(name).kind == 'amplitude' for name in c.free)
        place = slot(c.effect, c.start)
        if sized and not c.effect.finite and place not in taken and c.effect.name not in ws.first | ws.setup:
            best.setdefault(place, c)
    return list(best.values())


@dataclass(frozen=True, slots=True, eq=False)
class _Moments:
    """Products of all columns, of the folds together: always (a), terms (k), target (1)."""

    table: FloatArray
    always: int
    size: float

    def beside(self) -> tuple[FloatArray, FloatArray, float]:
        """Products of the terms (k, k), with the target (k,), and of the target, without what is always there."""
        a, t = self.always, self.table
        if a:
            t = t - t[:, :a] @ _solved(t[:a, :a], t[:a])
        return t[a:-1, a:-1], t[a:-1, -1], float(max(t[-1, -1], 1e-12 * self.table[-1, -1]))

    def without(self, held: BoolArray, sizes: FloatArray) -> '_Moments':
        """With the ``held`` columns (a + k,) taken off the target at their ``sizes``, and gone."""
        t = self.table.copy()
        given = np.append(np.where(held, -sizes, 0.0), 1.0)
        t[:, -1] = self.table @ given
        t[-1] = t[:, -1]
        t[-1, -1] = given @ self.table @ given
        gone = np.append(held, False)
        t[gone], t[:, gone] = 0.0, 0.0
        return _Moments(t, self.always, self.size)

    def with_always(self, sizes: FloatArray) -> FloatArray:
        """Sizes (a + k,) of all, if those of the terms are ``sizes``."""
        a, t = self.always, self.table
        return np.concatenate([_solved(t[:a, :a], t[:a, -1] - t[:a, a:-1] @ sizes), sizes])


def _solved(f: FloatArray, g: FloatArray) -> FloatArray:
    """F c = g, with a ridge so small that only what nothing shows is held by it."""
    scale = np.sqrt(np.maximum(np.diag(f), 1e-300))
    lower = f / np.outer(scale, scale) + 1e-9 * np.eye(len(f))
    return np.asarray((np.linalg.solve(lower, (g.T / scale).T).T / scale).T) if len(f) else g


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """The simulation in proportion around ``x``: ``columns`` (D, p), of unit rms; ``lengths`` (p,): by what they were
    divided; ``target`` (D,): what is measured beyond everything being off. ``fold`` (D,), from 0. ``named`` (p,): what
    the named model has. ``tables``: of each fold the products of all columns and the target.
    """

    library: _Library
    columns: FloatArray
    lengths: FloatArray
    target: FloatArray
    fold: npt.NDArray[np.int64]
    named: BoolArray
    size: float
    tables: tuple[FloatArray, ...]

    def moments(self, without: int = -1) -> _Moments:
        """Of all folds but one."""
        tables_used = [t for i, t in enumerate(self.tables) if i != without]
        share = float(np.mean(self.fold != without))
        return _Moments(np.sum(tables_used, axis=0), self.library.always, self.size * share)

    @property
    def bounds(self) -> FloatArray:
        """Least and greatest sizes (2, p), columns being of unit rms."""
        ends = [(p.low - p.off, p.high - p.off) for p in self.library.places]
        return np.asarray(np.array(ends).T * self.lengths)

    def solved(
        self, moments: _Moments, rng: np.random.Generator, bounds: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Sizes (p,) of everything, columns being of unit rms, and how likely each takes part.

        A size beyond its bounds is held there, and the others are averaged beside it.
        """
        low, high = self.bounds if bounds is None else bounds
        is_term = np.arange(len(low)) >= moments.always
        held, sizes, weights = np.zeros(len(low), dtype=bool), np.zeros(len(low)), np.zeros(len(low))
        while True:
            beside = moments.without(held, sizes)
            f, g, energy = beside.beside()
            of_terms, likely = averaged(f, g, energy, max(moments.size - moments.always, 2.0), rng)
            free = beside.with_always(of_terms)
            sizes = np.where(held, sizes, free)
            weights = np.where(held, weights, np.concatenate([np.ones(moments.always), likely]))
            outside = is_term & ~held & ((sizes < low) | (sizes > high))
            sizes = np.where(outside, np.clip(sizes, low, high), sizes)
            if not outside.any():
                return sizes, np.where(sizes == 0.0, 0.0, weights)
            held |= outside

    def refitted(self, moments: _Moments) -> FloatArray:
        """Sizes (p,) of the named model alone."""
        out, t = np.zeros(len(self.named)), moments.table
        out[self.named] = _solved(t[:-1, :-1][np.ix_(self.named, self.named)], t[:-1, -1][self.named])
        return out

    def shrunk(self, moments: _Moments, rng: np.random.Generator) -> FloatArray:
        """Sizes (p,) of the named model alone, averaged as those of all terms are."""
        at = np.append(np.flatnonzero(self.named), len(self.named))
        only = _Moments(moments.table[np.ix_(at, at)], moments.always, moments.size)
        out = np.zeros(len(self.named))
        out[self.named] = self.solved(only, rng, self.bounds[:, self.named])[0]
        return out


def _line(library: _Library, x: FloatArray, named: BoolArray) -> _Line:
    ws = library.ws
    residual, _ = library.residual(x)
    jacobian = library.jacobian(x)
    off = np.array([p.off for p in library.places])
    off[: library.always] = x[: library.always]
    target = residual + jacobian @ (x - off)
    size = ws.effective_size()
    lengths = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-150) / np.sqrt(size)
    folds = ws.folds()
    groups = (np.unique(folds, return_inverse=True)[1] % MOST_FOLDS)[ws.row_cases()]
    # The square of a whitened vector adds up to the number of values; that of a plant already to the independent ones.
    scale = 1.0 if ws.open_level else np.sqrt(size / max(ws.size, 1))
    columns = scale * jacobian / lengths
    tables = []
    for fold in range(int(groups.max()) + 1):
        part = np.column_stack((columns[groups == fold], scale * target[groups == fold]))
        tables.append(part.T @ part)
    return _Line(library, columns, lengths, scale * target, groups, named, size, tuple(tables))


def predictive_of(ws: Comparison, fit: Fit, screen: Screen, rng: np.random.Generator) -> Predictive | None:
    """Return the model that predicts best, with its error on unseen cases; None if there is nothing to choose from."""
    library, x = _library(ws, fit, screen)
    if len(library.places) == library.always or len(np.unique(ws.folds())) < 2:
        return None
    named = np.arange(len(x)) < len(x) - sum(p.index >= len(fit.coefficients_with_nuisance) for p in library.places)
    start = x
    line = _line(library, x, named)
    weights = np.zeros(len(x))
    for _ in range(ROUNDS):
        sizes, weights = line.solved(line.moments(), rng)
        x, straight = _reached(line, x, sizes)
        if straight:
            break
        line = _line(library, x, named)
    unseen, before, gained = _unseen(line, x, rng)
    better = unseen < before
    # By its own account the averaged model has so many terms more, and no more than the values can tell.
    further = float(weights[~named].sum())
    clear = by_chance(gained) <= CHANCE and 1.0 <= further < line.size - named.sum()
    noise = before <= (1.0 + LOWERS) * ws.floor()
    remains = clear and not noise and unseen < (1.0 - LOWERS) * before
    terms = _terms(line, x, weights) if better else ()
    chosen = x if better else start
    return Predictive(tuple(library.at(chosen)), terms, unseen, before, remains and bool(terms))


def by_chance(gained: FloatArray) -> float:
    """Return how likely cases (n,) that gain nothing on average gain ``gained`` or more, by Student's paired t."""
    error = float(np.std(gained, ddof=1) * np.sqrt(len(gained)))
    return float(stdtr(len(gained) - 1, -float(gained.sum()) / max(error, 1e-300)))


def _reached(line: _Line, x: FloatArray, sizes: FloatArray) -> tuple[FloatArray, bool]:
    """The numbers that ``sizes`` ask for, as far as the simulation follows, and whether it follows the whole way."""
    library, ws = line.library, line.library.ws
    off = np.array([p.off for p in library.places])
    off[: library.always] = x[: library.always]
    low, high = (np.array([getattr(p, n) for p in library.places]) for n in ('low', 'high'))
    wanted = off + sizes / line.lengths
    moved = np.linalg.norm(line.columns * sizes, axis=0)
    norm = float(np.linalg.norm(line.target - line.columns @ sizes))
    small = (moved < NEGLIGIBLE * max(norm, 1e-300)) & ~line.named
    wanted = np.clip(np.where(small, off, wanted), low, high)
    loss = ws.loss(library.residual(x)[0])
    for share in (1.0, 0.5, 0.25):
        at = np.where(small, off, x + share * (wanted - x))
        residual, _ = library.residual(at)
        if share == 1.0:
            expected = line.target - line.columns @ ((at - off) * line.lengths)
            apart = float(np.linalg.norm(_as_line(line, residual) - expected))
            if apart <= ELSEWHERE * max(float(np.linalg.norm(expected)), 1e-300):
                return at, True
        if np.isfinite(residual).all() and ws.loss(residual) < loss:
            return at, False
    return x, True


def _as_line(line: _Line, residual: FloatArray) -> FloatArray:
    """Return a whitened residual in the scale of the line."""
    ws = line.library.ws
    return residual if ws.open_level else residual * np.sqrt(line.size / max(ws.size, 1))


def _unseen(line: _Line, x: FloatArray, rng: np.random.Generator) -> tuple[float, float, FloatArray]:
    """Gap on unseen cases of the averaged and of the named model, and the drop of squared error on each case."""
    library, ws = line.library, line.library.ws
    moments = [line.moments(fold) for fold in range(len(line.tables))]

    def error(sizes: Callable[[_Moments], FloatArray]) -> FloatArray:
        out = np.empty_like(line.target)
        for fold, of_others in enumerate(moments):
            test = line.fold == fold
            out[test] = line.target[test] - line.columns[test] @ sizes(of_others)
        return out

    more = error(lambda of_others: line.solved(of_others, rng)[0])
    named_errors = error(line.refitted), error(lambda of_others: line.shrunk(of_others, rng))
    # A named number that the other cases hardly tell is wild on this one: that is no sign of further terms.
    named = min(named_errors, key=lambda white: float(white @ white))
    back = 1.0 if ws.open_level else np.sqrt(max(ws.size, 1) / line.size)
    now, difference = library.residual(x)

    def gap(white: FloatArray) -> float:
        change = ws.unwhitened(back * white - now)
        return ws.gap([d + c for d, c in zip(difference, change, strict=True)])

    gained = np.bincount(ws.row_cases(), named**2 - more**2)
    return gap(more), gap(named), np.asarray(gained)


def _terms(line: _Line, x: FloatArray, weights: FloatArray) -> tuple[PredictingTerm, ...]:
    """What the model has beyond the named effects, the largest first."""
    library, out = line.library, list[tuple[float, PredictingTerm]]()
    for j, place in enumerate(library.places):
        if line.named[j] or x[j] == place.off:
            continue
        active = library.effects[place.index]
        p = active.effect.parameter(place.name)
        several = sum(q.kind == 'amplitude' for q in active.effect.parameters) > 1
        name = f'{active.label} {place.name}' if several else active.label
        moved = float(np.linalg.norm(line.columns[:, j])) * abs(x[j] - place.off) * line.lengths[j]
        out.append((moved, PredictingTerm(name, float(x[j]), p.unit, float(weights[j]))))
    return tuple(t for _, t in sorted(out, key=lambda row: -row[0]))


def as_model(effects: Sequence[ActiveEffect]) -> Mapping[str, Mapping[str, float]]:
    """Values of the effects by name, as a plant's ``simulate`` takes them."""
    return {a.effect.name: dict(a.values) for a in effects}
