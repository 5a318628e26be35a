# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every step of a search does: refit from some starts, and hold the results against each other."""

import copy
import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.stats import chi2 as chi2_law

from psd_deflection.model.simulation.declaration import ActiveEffect, Effect
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison, gain_beyond
from psd_deflection.studies.discover.search.fit import Fit, refit, unseen_gap
from psd_deflection.studies.discover.search.screen import Score, Screen, promising
from psd_deflection.studies.discover.thresholds import (
    BIC_GAIN,
    FEWEST_CASES,
    LEVELS,
    LIKELY,
    MANY_EFFECTS,
    ROUNDS,
    TRIALS,
)
from psd_deflection.studies.loads.thresholds import MANYFOLD, MINOR, PART


@dataclass(frozen=True, slots=True)
class Limit:
    """``limit``: what ended the search, in words. ``further``: what more of it would give, in words."""

    limit: str
    further: str

    def tree(self) -> dict[str, str]:
        """For JSON."""
        return {'limit': self.limit, 'further': self.further}


@dataclass(frozen=True, slots=True)
class Terms:
    """``names`` of effects; ``columns`` (D, p), whitened: what they and the parameters of a fit do, in proportion."""

    names: Sequence[str]
    columns: FloatArray


def further_terms(
    screen: Screen, fit: Fit, passes: Callable[[Score], bool], taken: frozenset[str], most: int = LEVELS
) -> Terms | None:
    """Return the terms of ``screen`` that pass one by one beside ``fit``, to first order; None if no term passes.

    No simulation is made. ``passes``: the rule for one more term; ``taken``: names of effects that are not asked.
    """
    columns = [fit.jacobian[:, j] for j, name in enumerate(fit.free) if name not in fit.at_bound]
    names: list[str] = []
    used: set[tuple[object, ...]] = set()
    while len(names) < most:
        known = np.column_stack(columns) if columns else None
        further = [
            s
            for s in screen.score(fit.residual, known)
            if s.candidate.variant not in used and s.candidate.effect.name not in taken and passes(s)
        ]
        if not further:
            break
        best = max(further, key=lambda s: s.gain)
        used.add(best.candidate.variant)
        names.append(best.candidate.effect.name)
        columns += screen.columns_of(best.candidate)
    return Terms(names, np.column_stack(columns)) if names else None


def words_of_terms(workspace: Comparison, fit: Fit, terms: Terms) -> str:
    """What ``terms`` beside ``fit`` would give on unseen load cases, in words."""
    gap = unseen_gap(workspace, fit, terms.columns)
    now = workspace.gap(fit.difference)
    listed = ', '.join(name if n == 1 else f'{n} × {name}' for name, n in Counter(terms.names).items())
    count = len(terms.names)
    many = f'{LEVELS} or more' if count == LEVELS else f'{count} more'
    return (
        f'{many} term{"" if count == 1 else "s"} ({listed}) would pass one by one, to first order; '
        'on unseen load cases the gap would be '
        f'{workspace.worded(gap)} instead of {workspace.worded(now)}'
    )


def key_of(active: ActiveEffect) -> tuple[object, ...]:
    """Effect and discrete choices."""
    return (active.effect.name, *active.choices)


def slot(effect: Effect, values: Mapping[str, float]) -> tuple[object, ...]:
    """Key of which a model has at most one: an effect, for each PSD."""
    return (effect.name, *(values[p.name] for p in effect.parameters if p.each))


def unphysical(workspace: Comparison, fit: Fit, index: int) -> bool:
    """Return whether effect ``index`` of ``fit`` has run into a bound: it fits only as something that it is not.

    An amplitude may end at the bound at which it is off, as long as another one is on.
    """
    effect = fit.effects[index].effect
    on = False
    for j in fit.columns_of(index):
        p = effect.parameter(fit.free[j][1])
        if fit.free[j] not in fit.at_bound:
            on = on or p.kind == 'amplitude'
        elif p.kind == 'shape' or (
            p.kind == 'amplitude' and fit.effects[index].values[p.name] != p.off(workspace.physics)
        ):
            return True
    return not on


def cancels(workspace: Comparison, fit: Fit, index: int, null: Fit) -> bool:
    """Return whether others take back most of what effect ``index`` does, ten times what ``null`` leaves: such sizes
    are absurd; together they stand in for what the library lacks.
    """
    effect, values = fit.effects[index].effect, fit.effects[index].values
    if workspace.open_level or effect.finite:
        return False
    sizes = [(j, effect.parameter(fit.free[j][1])) for j in fit.columns_of(index)]
    does = [fit.jacobian[:, j] * (values[p.name] - p.off(workspace.physics)) for j, p in sizes if p.kind == 'amplitude']
    return bool(np.sum(np.sum(does, axis=0) ** 2) > MANYFOLD**2 * null.chi2)


def wald_chi_square(workspace: Comparison, fit: Fit, index: int) -> float:
    """Chi-square by which the size of effect ``index`` of ``fit`` is another than none, by its own covariance.

    Infinite if the size of none is no number. What is free beside it may take its place; a refit
    without it, in which that stays as it is, says too much for it then.
    """
    effect, columns = fit.effects[index].effect, fit.columns_of(index)
    sizes = [j for j in columns if effect.parameter(fit.free[j][1]).kind in ('amplitude', 'coupled')]
    names = [fit.free[j][1] for j in sizes]
    off = np.array([effect.parameter(n).off(workspace.physics) for n in names])
    apart = np.array([fit.effects[index].values[n] for n in names]) - off
    if not np.isfinite(apart).all():
        return math.inf
    return float(apart @ np.linalg.pinv(fit.covariance()[np.ix_(sizes, sizes)], hermitian=True) @ apart)


def effect_count(fit: Fit) -> str:
    """How many effects ``fit`` has, in words."""
    count = len(fit.effects)
    return f'{count} effect{"" if count == 1 else "s"}'


def is_far_off(fit: Fit) -> bool:
    """Return whether ``fit`` leaves so much that small signatures beside it would mislead."""
    return fit.chi2 > MANYFOLD * fit.residual.size


def unbound(fit: Fit) -> FloatArray:
    """Return the Jacobian's columns (D, k) of the parameters that are free to move."""
    keep = [j for j, name in enumerate(fit.free) if name not in fit.at_bound]
    return fit.jacobian[:, keep]


def _shapes(workspace: Comparison, active: ActiveEffect) -> list[dict[str, float]]:
    """Shapes of ``active`` over their whole ranges; none if it has no shape."""
    shapes = [p for p in active.effect.parameters if p.kind == 'shape']
    grids = []
    for p in shapes:
        low, high = p.bounds(workspace.physics, active.values)
        between = np.geomspace if low > 0.0 else np.linspace
        each = round(LEVELS ** (1.0 / len(shapes)))
        grids.append([(p.name, float(v)) for v in between(low, high, each + 2)[1:-1]])
    return [dict(shape) for shape in itertools.product(*grids)] if grids else []


class Trials:
    """Refits over one comparison, and the rules by which one passes.

    ``screen`` gives the signatures beside a fit; ``progress`` takes each step in words.
    """

    def __init__(
        self,
        workspace: Comparison,
        screen: Callable[[Comparison, Fit | None], Screen],
        progress: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.workspace = workspace
        self._make_screen = screen
        self._progress = progress
        begun = workspace.simulations
        self._screen: Screen | None = screen(workspace, None)
        self._screened: Fit | None = None
        self._signatures = workspace.simulations - begun
        self._begun = begun
        self.penalty = float(np.log(workspace.effective_size()))
        self.trace: list[str] = []
        self.dropped: dict[int, tuple[Fit, list[Fit]]] = {}

    @property
    def screen(self) -> Screen:
        """All signatures side by side; made again if another search took them over."""
        if self._screen is None:
            self._screen = self._make_screen(self.workspace, self._screened)
        return self._screen

    @property
    def spent(self) -> int:
        """Forward simulations of this search."""
        return self.workspace.simulations - self._begun

    def count_anew(self) -> None:
        """Count only simulations from now on, and those of its signatures: not what another search has cost."""
        self._begun = self.workspace.simulations - self._signatures

    def budget_of(self, fit: Fit) -> int:
        """Forward simulations that a model of this many effects may cost."""
        return round(self.workspace.budget * min(max(1, len(fit.effects)), self.workspace.most_budgets))

    def without_each(self, fit: Fit, null: Fit) -> list[Fit]:
        """``fit`` refitted without each of its effects in turn; ``null``: the fit of no effect."""
        cached = self.dropped.get(id(fit))
        if cached is None:
            fits = []
            for i in range(len(fit.effects)):
                rest = [a for j, a in enumerate(fit.effects) if j != i]
                fits.append(refit(self.workspace, rest, iterations=6) if rest else null)
            # Keep the fit itself too, so that no other object gets its id.
            cached = self.dropped[id(fit)] = (fit, fits)
        return cached[1]

    def log(self, text: str) -> None:
        """Keep a step of the search, with the simulations so far, and tell it."""
        self.trace.append(f'{text} [{self.workspace.simulations}]')
        self._progress(text)

    def bic(self, fit: Fit) -> float:
        """Bayesian information criterion of ``fit``, up to a constant."""
        return fit.chi2 + self.penalty * fit.parameters

    def screen_beside(self, fit: Fit) -> Screen:
        """Return the signatures beside ``fit``."""
        return self._make_screen(self.workspace, fit)

    def screen_anew(self, fit: Fit) -> None:
        """Take the signatures beside ``fit`` from now on."""
        # Two screens at once would be too much of a long recording.
        self._screen, self._screened = None, fit
        self._screen = self.screen_beside(fit)

    def best_of(self, starts: Sequence[Sequence[ActiveEffect]], keep: int, iterations: int) -> Fit | None:
        """Refit each start a little, the best few in full."""
        fits = [refit(self.workspace, s, iterations=3) for s in starts]
        fits.sort(key=self.bic)
        full = [refit(self.workspace, f.effects, iterations=iterations) for f in fits[:keep]]
        best = min(full, key=self.bic, default=None)
        return best if best is None else self._elsewhere(best, iterations)

    def _elsewhere(self, fit: Fit, iterations: int) -> Fit:
        """``fit``, or a better one from elsewhere: a link that rings on cannot be reached from one that does not."""
        ws = self.workspace
        if not is_far_off(fit):
            return fit
        starts = [
            [ActiveEffect(a.effect, {**a.values, p.name: value}) if a is moved else a for a in fit.effects]
            for moved in fit.effects
            for p in moved.effect.parameters
            for value in p.starts
        ]
        losses = [ws.loss(ws.residual([*ws.base, *fit.nuisance, *start])[0]) for start in starts]
        if not losses or min(losses) >= fit.chi2:
            return fit
        restarted = refit(ws, starts[int(np.argmin(losses))], iterations, fit.nuisance)
        return min(fit, restarted, key=self.bic)

    def of_another_shape(self, fit: Fit) -> Fit:
        """``fit``, or a better one with the shapes of an effect elsewhere: its frequency may be in a side valley."""
        ws, best = self.workspace, fit
        for i, moved in enumerate(fit.effects):
            starts = [
                [*fit.effects[:i], ActiveEffect(moved.effect, {**moved.values, **shape}), *fit.effects[i + 1 :]]
                for shape in _shapes(ws, moved)
            ]
            losses = [ws.loss(ws.residual([*ws.base, *fit.nuisance, *start])[0]) for start in starts]
            for k in np.argsort(losses)[:ROUNDS].tolist():
                best = min(best, refit(ws, starts[k], 12, fit.nuisance), key=self.bic)
        return best if self.bic(best) < self.bic(fit) - BIC_GAIN else fit

    def passes(self, smaller: Fit, larger: Fit, null: Fit) -> bool:
        """Return whether ``larger`` is better than ``smaller`` by more than BIC and the simulation's own error ask."""
        gain = smaller.chi2 - larger.chi2
        if not self.workspace.open_level:
            explained = null.residual - smaller.residual
            gain = min(gain, gain_beyond(self.workspace, smaller.residual, larger.residual, explained))
        more = self.penalty * (larger.parameters - smaller.parameters)
        return gain - more > BIC_GAIN

    def is_substitute(self, smaller: Fit, larger: Fit) -> bool:
        """Return whether what ``larger`` adds only stands in for something that the library lacks."""
        size = self.workspace.size
        if not smaller.effects or self.workspace.open_level or larger.chi2 <= (1.0 + MINOR) * size:
            return False
        small_gain = larger.chi2 - size > (1.0 - PART) * (smaller.chi2 - size)
        return small_gain and not (len(smaller.effects) >= MANY_EFFECTS and self._library_explains(smaller))

    def _library_explains(self, fit: Fit) -> bool:
        """Whether some more effects beside ``fit`` would leave next to nothing on unseen load cases, to first order."""
        terms = further_terms(self.screen, fit, self.may_pass, self.workspace.first, FEWEST_CASES)
        if terms is None:
            return False
        return unseen_gap(self.workspace, fit, terms.columns) < (1.0 + MINOR) * self.workspace.floor()

    def library_p(self, gain: float, dof: int) -> float:
        """p of a gain in chi-square, over the whole library (Sidak)."""
        count = max(1, len(self.screen.candidates))
        local = float(chi2_law.sf(gain, max(dof, 1)))
        return float(-np.expm1(count * np.log1p(-min(local, 1.0 - 1e-16))))

    def renoise(self, fit: Fit) -> Fit:
        """Estimate the noise again, now that most of the discrepancy is explained; refit if it differs."""
        renoised = self.workspace.renoised([*self.workspace.base, *fit.coefficients_with_nuisance])
        if renoised is self.workspace:
            return fit
        self.workspace = renoised
        self.dropped.clear()
        if self.workspace.open_level:
            self.penalty = float(np.log(self.workspace.effective_size()))
        fit = refit(self.workspace, fit.effects, iterations=6)
        self.screen_anew(fit)
        return fit

    def refit(self, null: Fit, fit: Fit) -> tuple[Fit, Fit]:
        """Both fits again, with free loads and times as ``fit`` asks for: else a small effect stands in for these."""
        refitted = self.workspace.refitted_beside(fit.difference, fit.coefficients_with_nuisance)
        if refitted is self.workspace:
            return null, fit
        better = refit(refitted, fit.effects, iterations=6)
        if refitted.gap(better.difference) > self.workspace.gap(fit.difference):
            return null, fit
        self.workspace = refitted
        self.dropped.clear()
        return refit(refitted, ()), better

    def at(self, workspace: Comparison) -> Self:
        """Return the same search over another comparison of the same recordings."""
        out = copy.copy(self)
        out.workspace = workspace
        return out

    def may_pass(self, score: Score) -> bool:
        """Return whether one more effect would pass, to first order."""
        return score.p <= self.workspace.p_accept and score.gain - self.penalty * score.dof > BIC_GAIN

    def _may_stand_out(self, current: Fit, score: Score) -> bool:
        """Return whether an effect passes at the level that it leaves, to first order: at the level before, chi-square
        falls by no more than the number of values, which is little of a short table.
        """
        if not self.workspace.open_level:
            return False
        moved = np.stack(self.screen.columns_of(score.candidate), axis=1) @ score.coefficients
        gain = current.chi2 - self.workspace.loss(current.residual - moved)
        return self.library_p(gain, score.dof) <= self.workspace.p_accept

    def further(self, current: Fit, scores: Sequence[Score]) -> Fit | None:
        """``current`` with the best further effect."""
        # From the second effect on, the residual is smaller and the first guess better.
        tried = promising(scores, self.penalty, LIKELY, TRIALS if not current.effects else 4)
        least = min((s.p for s in scores), default=1.0)
        if least > self.workspace.p_accept and not any(self._may_stand_out(current, s) for s in tried):
            return None
        starts = [[*current.effects, s.candidate.from_coefficients(s.coefficients)] for s in tried]
        return self.best_of(starts, 2, 6) if current.effects else self.best_of(starts, 4, 12)
