# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Chooses the effects by BIC: adds the best of the linear screen, adds pairs, drops, swaps, with a full refit each
time."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, refit
from psd_deflection.studies.discover.search.screen import Score, Screen
from psd_deflection.studies.discover.search.trials import (
    Limit,
    Trials,
    effect_count,
    further_terms,
    is_far_off,
    key_of,
    slot,
    unbound,
    wald_chi_square,
    words_of_terms,
)
from psd_deflection.studies.discover.thresholds import BIC_GAIN, HALF, LIKELY, OTHER_ERRORS, PAIRS, ROUNDS, SURE
from psd_deflection.studies.loads.thresholds import EXACT, MINOR, PART

LATE = 'load_delay'
RINGING = ('bending_frequency', 'torsion_frequency')
"""Mistakes about the natural frequencies, which may be wrong both."""


def mistake(trials: Trials, null: Fit, scores: Sequence[Score]) -> Fit:
    """Return one of the mistakes that touch every channel if it explains nearly all by itself, else ``null``.

    Late loads may be taken with one effect, if they explain nearly all together: each would hide the other.
    """
    if not scores or min(s.p for s in scores) > trials.workspace.p_accept:
        return null
    best = trials.best_of(_mistaken(trials, null, scores), 2, 12)
    if not _nearly_all(trials, null, best):
        best = _delays_beside_an_effect(trials, null, scores)
    if best is None or not _nearly_all(trials, null, best) or _is_a_mass(best):
        return null
    trials.log('the set-up: ' + ', '.join(a.label for a in best.effects))
    return best


def _nearly_all(trials: Trials, null: Fit, fit: Fit | None) -> bool:
    """Return whether ``fit`` passes and leaves next to nothing."""
    size = trials.workspace.size
    if fit is None or not trials.passes(null, fit, null):
        return False
    return fit.chi2 - size <= EXACT * (null.chi2 - size)


def _delays_beside_an_effect(trials: Trials, null: Fit, scores: Sequence[Score]) -> Fit | None:
    """Late loads with the best effect beside them."""
    delays = [s for s in scores if s.candidate.effect.name == LATE and s.p <= trials.workspace.p_accept]
    alone = trials.best_of([[s.candidate.from_coefficients(s.coefficients)] for s in delays], 1, 6)
    if alone is None or not trials.passes(null, alone, null):
        return None
    both = _effect_beside_delays(trials, alone, trials.screen)
    if is_far_off(alone) and not _nearly_all(trials, null, both) and alone.chi2 < HALF * null.chi2:
        # Late loads hide the spectral lines of a small effect, and change its signature.
        both = _effect_beside_delays(trials, alone, trials.screen_beside(alone))
    return both if both is not None and trials.passes(alone, both, null) else None


def _effect_beside_delays(trials: Trials, alone: Fit, screen: Screen) -> Fit | None:
    """Return the late loads of ``alone`` with the best effect of ``screen`` beside them."""
    scores = screen.score(alone.residual, unbound(alone))
    return trials.further(alone, [s for s in scores if s.candidate.effect.name not in trials.workspace.first])


def _mistaken(trials: Trials, null: Fit, scores: Sequence[Score]) -> list[list[ActiveEffect]]:
    """Return the starts of :meth:`mistake`."""
    best = max((s.gain for s in scores), default=0.0)
    starts: list[list[ActiveEffect]] = []
    for s in scores:
        if s.candidate.effect.name not in trials.workspace.first:
            continue
        start, name = s.candidate.from_coefficients(s.coefficients), s.candidate.effect.name
        if name == 'sensitivity':
            # A linear step goes too far when readings are twice as large.
            start = ActiveEffect(start.effect, {'error': max(start.values['error'], -HALF)})
        if s.gain > LIKELY * best:
            starts.append([start])
        if name == 'sample_rate' and is_far_off(null):
            # A linear step does not reach another frequency of the ringing.
            starts += [[ActiveEffect(start.effect, {'error': v})] for v in OTHER_ERRORS]
    return starts + _frequency_starts(trials, null, [s for s in scores if s.gain > EXACT * best])


def _frequency_starts(trials: Trials, null: Fit, scores: Sequence[Score]) -> list[list[ActiveEffect]]:
    """Starts: either natural frequency is wrong, or both are."""
    frequencies = []
    for s in scores:
        if s.candidate.effect.name in RINGING and s.candidate.effect.name in trials.workspace.first:
            frequencies.append(frequency(trials.workspace, null, s))
    return [*([a] for a in frequencies), *([frequencies] if len(frequencies) > 1 else [])]


def frequency(ws: Comparison, beside: Fit, score: Score) -> ActiveEffect:
    """Return the best start for another natural frequency: from far away a linear step does not reach it."""
    start = score.candidate.from_coefficients(score.coefficients)
    starts = OTHER_ERRORS if is_far_off(beside) else ()
    return min(
        [start, *(ActiveEffect(start.effect, {'error': v}) for v in starts)],
        key=lambda a: ws.loss(ws.residual([*ws.base, *beside.coefficients_with_nuisance, a])[0]),
    )


def _is_a_mass(fit: Fit) -> bool:
    """Whether a lower frequency of the bending is all: a mass at the tip does the same, and the catalogue has it."""
    ringing = [a for a in fit.effects if a.effect.name in RINGING]
    return len(ringing) == 1 and ringing[0].effect.name == RINGING[0] and ringing[0].values['error'] < 0.0


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """``fit``: the model chosen. ``null``: the rig file's own. ``p``: library-wide, per effect.
    ``delta_bic``: loss of BIC if each effect were dropped. ``alternatives``: for each effect of
    ``fit``, refits with another in its place. ``limits``: what ended the search before the evidence did.
    """

    null: Fit
    fit: Fit
    p: Sequence[float] = ()
    delta_bic: Sequence[float] = ()
    delta_chi2: Sequence[float] = ()
    first_scores: Sequence[Score] = ()
    alternatives: Sequence[Sequence[Fit]] = ()
    trace: Sequence[str] = ()
    limits: Sequence[Limit] = ()


class Search(Trials):
    """One search over one comparison, which :meth:`run` gives with the noise that it estimated last."""

    _stopped = ''
    _beside: tuple[str, ...] = ()
    """Labels of the effects beside which the signatures are, as far as known."""

    def run(self, null: Fit, begun: Fit | None = None) -> tuple[Search, SearchResult]:
        """The search after it ran, and what it found: perhaps that nothing is missing. ``null``: the fit of no effect;
        ``begun``: that of the effects to begin with.

        This one stays as it is, but for the signatures, which it would have to make again.
        """
        out = copy.copy(self)
        self._screen = None
        out.trace, out.dropped = [], {}
        out.count_anew()
        return out, out.searched(null, begun)

    def searched(self, null: Fit, begun: Fit | None = None) -> SearchResult:
        """What :meth:`run` gives beside itself; it changes this search."""
        scores = self.screen.score(null.residual, unbound(null))
        first_scores = scores
        null, grown = self._refitted(null, mistake(self, null, scores) if begun is None else begun)
        grown = self._without_weak(grown)
        current, alternatives = self.swap(null, grown)
        if self._much_closer(grown, current):
            # Beside the wrong effect nothing held that holds beside the right one; what that cost is not counted.
            self._begun = self.workspace.simulations
            self._screen_anew(current)
            null, more = self._refitted(null, current)
            more = self._without_weak(more)
            if len(more.effects) > len(current.effects):
                current, alternatives = self.swap(null, more)
        p, delta_bic, delta_chi2 = self.weigh(null, current)
        limits = self._limits(current)
        return SearchResult(null, current, p, delta_bic, delta_chi2, first_scores, alternatives, self.trace, limits)

    def _refitted(self, null: Fit, current: Fit) -> tuple[Fit, Fit]:
        """The fit of no effect, and ``current`` with all that passes, beside the noise that is estimated then."""
        for _ in range(ROUNDS):
            null, current = self._grown(null, current)
            current = self._drop(null, current)
            if not current.effects:
                break
            calmer = self.renoise(current)
            null = refit(self.workspace, ())
            if calmer is current:
                break
            # Noise that was estimated beside a large discrepancy may have hidden what is small.
            current = calmer
        return null, current

    def _without_weak(self, current: Fit) -> Fit:
        """``current`` without effects that explain less than what remains, the weakest first: stand-ins for that.

        What is put in their places is much work for nothing, and the right one may show beside the others alone.
        """
        while len(current.effects) > 1 and not self.workspace.open_level:
            excess = current.chi2 - self.workspace.size
            sizes = [wald_chi_square(self.workspace, current, i) for i in range(len(current.effects))]
            weakest = int(np.argmin(sizes))
            if excess <= MINOR * self.workspace.size or sizes[weakest] >= excess:
                break
            self.log(f'{current.effects[weakest].label} explains less than what remains')
            rest = [a for i, a in enumerate(current.effects) if i != weakest]
            current = refit(self.workspace, rest, iterations=6)
        return current

    def _much_closer(self, before: Fit, current: Fit) -> bool:
        """Return whether a swap closed most of what was open, and left something."""
        size = self.workspace.size
        excess = current.chi2 - size
        return excess < HALF * (before.chi2 - size) and excess > MINOR * size

    def _limits(self, current: Fit) -> tuple[Limit, ...]:
        """Return the limit that kept further effects out, with what lies beyond it."""
        within_noise = current.chi2 <= (1.0 + MINOR) * self.workspace.size and not self.workspace.open_level
        if not self._stopped or within_noise:
            return ()

        terms = further_terms(self.screen, current, self.may_pass, self.workspace.first)
        return (Limit(self._stopped, words_of_terms(self.workspace, current, terms)),) if terms is not None else ()

    def _grown(self, null: Fit, current: Fit) -> tuple[Fit, Fit]:
        """Return the fit of no effect, and ``current`` with all that passes added."""
        renoised = bool(current.effects)
        while True:
            self._stopped = ''
            if self.spent >= self.budget_of(current):
                self._stopped = f'{self.budget_of(current)} simulations for {effect_count(current)}'
                break
            better = self._added(null, current)
            if better is None and self._looks_closer(current):
                better = self._added(null, current)
            if better is None:
                break
            null, current = self.refit(null, better)
            if not renoised or self.workspace.open_level:
                renoised = True
                current = self.renoise(current)
                null = refit(self.workspace, ())
            if (is_far_off(current) or self.workspace.open_level) and self.spent < self.budget_of(current):
                self._screen_anew(current)
            if len(current.effects) == 2 and self.spent < self.budget_of(current):
                current = self._try_pairs(null, current)
        return null, current

    def _screen_anew(self, current: Fit) -> None:
        """With the signatures beside ``current``."""
        self._beside = tuple(a.label for a in current.effects)
        self.screen_anew(current)

    def _looks_closer(self, current: Fit) -> bool:
        """Whether the signatures are new: those beside ``current``, if it leaves something that no other explains."""
        known = self._beside == tuple(a.label for a in current.effects)
        within_noise = current.chi2 <= (1.0 + MINOR) * self.workspace.size
        if known or within_noise or self.spent >= self.budget_of(current):
            return False
        self._screen_anew(current)
        return True

    def _added(self, null: Fit, current: Fit) -> Fit | None:
        """``current`` with the effect that passes best, or a better pair; None if nothing passes."""
        ws = self.workspace
        taken = {slot(a.effect, a.values) for a in current.effects}
        screened = self.screen.score(current.residual, unbound(current))
        scores = [
            s
            for s in screened
            if slot(s.candidate.effect, s.candidate.start) not in taken and s.candidate.effect.name not in ws.first
        ]
        chosen = self._chosen_anew(current, screened, max((s.gain for s in scores), default=0.0))
        if chosen is not None:
            return chosen
        better = self.further(current, scores)
        passes = better is not None and self.passes(current, better, null)
        if better is not None and passes:
            if not self.is_substitute(current, better):
                self.log('adding ' + better.effects[-1].label)
                return better
            self._stopped = (
                f'{better.effects[-1].effect.name} beside {effect_count(current)} explains less than '
                f'{PART:.0%} of what remains: it may only stand in for what the library lacks'
            )
        # Of two causes of a rough machine neither may help alone, and a wrong first effect hides a pair.
        if len(current.effects) >= 2 or not (ws.open_level or passes):
            return None
        better = self._try_pairs(null, current)
        holds = better is not current and self.passes(current, better, null)
        return better if holds and not self.is_substitute(current, better) else None

    def _chosen_anew(self, current: Fit, screened: Sequence[Score], least: float) -> Fit | None:
        """``current`` with another choice of one of its effects, another axis of the clamp, if that is the better one.

        ``screened``: what each candidate explains beside it; ``least``: the best of an effect that is not there yet.
        """
        if self.workspace.open_level or current.chi2 <= (1.0 + MINOR) * self.workspace.size:
            return None
        known, best = {key_of(a) for a in current.effects}, current
        other_choices = [s for s in screened if s.gain >= HALF * least and s.candidate.variant not in known]
        for i, active in enumerate(current.effects):
            place = slot(active.effect, active.values)
            mine = [
                s for s in other_choices if self.may_pass(s) and slot(s.candidate.effect, s.candidate.start) == place
            ]
            for chosen in {s.candidate.variant: s.candidate for s in mine}.values():
                choices = {p.name: chosen.start[p.name] for p in active.effect.parameters if p.kind == 'choice'}
                moved = ActiveEffect(active.effect, {**active.values, **choices})
                rest = [*current.effects[:i], *current.effects[i + 1 :]]
                best = min(best, refit(self.workspace, [*rest, moved], iterations=8), key=self.bic)
        if self.bic(best) > self.bic(current) - BIC_GAIN:
            return None
        self.log(f'choosing {best.effects[-1].label}')
        return best

    def swap(self, null: Fit, current: Fit) -> tuple[Fit, list[list[Fit]]]:
        """Try to replace each effect by its alternatives and keep the better model; at most two rounds."""
        alternatives: list[list[Fit]] = []
        for swaps in range(3):
            alternatives = []
            _, _, gains = self.weigh(null, current)
            best = current
            for i in range(len(current.effects)):
                fits = self.alternatives(null, current, i, gains[i])
                alternatives.append(fits)
                best = min([best, *fits], key=self.bic)
            spent = self.spent > 1.5 * self.budget_of(current)
            if swaps == 2 or spent or self.bic(best) > self.bic(current) - 2.0:
                break
            self.log('swapping to ' + ', '.join(a.label for a in best.effects))
            current = refit(self.workspace, best.effects, iterations=8)
            current = self._drop(null, current)
        return current, alternatives

    def with_one_cause(self, current: Fit) -> Fit:
        """Return ``current``, or a better model with one wrong number of the rig file for effects that do the same.

        A length that is wrong changes the stiffness in bending and in torsion as 3 : 1, so beside a third effect the
        search finds two where one number is wrong.
        """
        best, jacobian = current, unbound(current)
        if len(current.effects) < 2 or self.workspace.open_level:
            return current
        keep = [j for j, name in enumerate(current.free) if name not in current.at_bound]
        for candidate in self.screen.candidates:
            if candidate.effect.name not in self.workspace.first:
                continue
            (column,) = self.screen.columns_of(candidate)
            share = np.linalg.lstsq(jacobian, column, rcond=1e-9)[0]
            size = float(np.linalg.norm(column))
            if np.linalg.norm(column - jacobian @ share) > MINOR * size:
                continue
            parts = np.linalg.norm(jacobian, axis=0) * np.abs(share)
            same = {current.free[j][0] for j, part in zip(keep, parts, strict=True) if part > MINOR * size}
            if any(current.effects[i].effect.name in self.workspace.setup for i in same):
                continue
            start = candidate.from_coefficients(np.array([0.0]))
            # All of them, or all but what is there besides.
            for gone in (same, *({i} for i in same)):
                rest = [a for i, a in enumerate(current.effects) if i not in gone]
                best = min(best, refit(self.workspace, [*rest, start], iterations=12), key=self.bic)
        if self.bic(best) > self.bic(current) - 0.5 * BIC_GAIN:
            return current
        self.log('one cause: ' + ', '.join(a.label for a in best.effects))
        return best

    def _try_pairs(self, null: Fit, current: Fit) -> Fit:
        pairs = self.screen.pairs(
            null.residual, self.penalty, 3 * PAIRS if self.workspace.open_level else PAIRS, unbound(null)
        )
        starts = []
        for a, b, _ in pairs:
            same = slot(a.candidate.effect, a.candidate.start) == slot(b.candidate.effect, b.candidate.start)
            mistaken = {a.candidate.effect.name, b.candidate.effect.name} & self.workspace.first
            if (
                not same
                and not mistaken
                and {a.candidate.variant, b.candidate.variant} != {key_of(e) for e in current.effects}
            ):
                starts.append(
                    [a.candidate.from_coefficients(a.coefficients), b.candidate.from_coefficients(b.coefficients)]
                )
        best = self.best_of(starts, 2, 8)
        if best is not None and self.bic(best) < self.bic(current) - 2.0:
            self.log('a better pair: ' + ', '.join(a.label for a in best.effects))
            return best
        return current

    def _drop(self, null: Fit, current: Fit) -> Fit:
        while len(current.effects) > 1:
            best = min(self.without_each(current, null), key=self.bic)
            if self.passes(best, current, null):
                break
            self.log('dropping to ' + ', '.join(a.label for a in best.effects))
            current = best
        return current

    def weigh(self, null: Fit, current: Fit) -> tuple[list[float], list[float], list[float]]:
        """For each effect of ``current``: p over the library, loss in BIC and in chi-square if it were dropped."""
        p, delta_bic, delta_chi2 = [], [], []
        for i, without in enumerate(self.without_each(current, null)):
            gain = without.chi2 - current.chi2
            delta_chi2.append(gain)
            delta_bic.append(self.bic(without) - self.bic(current))
            p.append(self.library_p(gain, len(current.columns_of(i))))
        return p, delta_bic, delta_chi2

    def _in_its_place(self, current: Fit, index: int, without: Fit, gain: float) -> list[Score]:
        """Return the candidates in place of effect ``index``, the best eight: an exact confounder scores as high as it.

        If the search was already expensive, the case is complicated: two only.
        """
        named, rest = current.effects[index], [a for j, a in enumerate(current.effects) if j != index]
        taken = {named.effect.name, *(a.effect.name for a in rest)}
        if any(a.effect.name not in self.workspace.setup for a in rest):
            taken |= self.workspace.first
        # Screening is linear: a candidate that falls short by little needs a full refit.
        bar = min(HALF * gain, gain - SURE) if gain > 100.0 else 0.5 * gain
        if self.workspace.open_level:
            # A rough machine is far from linear.
            bar = 0.0
        best: dict[str, Score] = {}
        for s in self.screen.score(without.residual, unbound(without)):
            name = s.candidate.effect.name
            least = EXACT * gain if name in RINGING and is_far_off(without) else bar
            if name not in taken and s.gain >= least:
                best.setdefault(name, s)
        return sorted(best.values(), key=lambda s: -s.gain)[: 8 if self.spent < self.budget_of(current) else 2]

    def alternatives(self, null: Fit, current: Fit, index: int, gain: float) -> list[Fit]:
        """Refits with effect ``index`` swapped for each plausible alternative, best first.

        ``gain``: what the named effect explains, in chi-square; ``null``: the fit of no effect.
        """
        rest = [a for j, a in enumerate(current.effects) if j != index]
        without = self.without_each(current, null)[index]
        ranked = self._in_its_place(current, index, without, gain)
        fits = []
        for s in ranked:
            ringing = s.candidate.effect.name in RINGING
            alternative = (
                frequency(self.workspace, without, s) if ringing else s.candidate.from_coefficients(s.coefficients)
            )
            quick = refit(self.workspace, [*rest, alternative], iterations=10 if self.workspace.open_level else 3)
            if quick.chi2 - current.chi2 < max(SURE, PART * gain) and self.spent < 2 * self.budget_of(current):
                quick = refit(self.workspace, quick.effects, iterations=8)
            fits.append(quick)
        fits.sort(key=lambda f: f.chi2)
        return fits
