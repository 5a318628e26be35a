"""Chooses the effects: add greedily, add pairs, drop, swap, with a full refit each time.

The search scores every candidate on the residual (this takes milliseconds), refits the few most
promising, and keeps the best by BIC if it passes. If a residual remains after the first effect, it
also tries the best pairs of the linear screen. At the end it drops effects that are no longer
significant.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_law

from psd_deflection.model.simulation.declaration import ActiveEffect, Effect
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, refit
from psd_deflection.studies.discover.search.hold_out import unseen_gap
from psd_deflection.studies.discover.search.limits import Limit, beyond, further_terms
from psd_deflection.studies.discover.search.screen import Score, Screen, promising
from psd_deflection.studies.discover.search.trust import gain_beyond

BIC_ACCEPT = 10.0
"""Smallest improvement of BIC by an accepted effect."""
FAR = 10.0
"""Chi-square per value from which on what remains is screened with signatures beside the effects found so far."""
LIKELY = 0.3
"""A mistake of the set-up is tried if it explains, to first order, this share of what the best candidate explains."""
NEARLY_ALL = 0.01
"""A mistake of the set-up is taken before any effect if it alone leaves less than this share of the chi-square beyond
noise."""
OTHER_RATES = (-0.2, -0.1, -0.04, 0.04, 0.1, 0.25)
LATE = 'load_delay'
RINGING = ('bending_frequency', 'torsion_frequency')
"""Mistakes about the natural frequencies, which may be wrong both."""
OTHER_FREQUENCIES, RINGS = (-0.1, -0.05, -0.02, 0.02, 0.05, 0.1), 0.005
"""They are tried from these errors, too, if they explain this share of what the best candidate explains."""
FARTHEST_ERROR, HALVED = -0.7, -0.5
"""A linear step to an error of a sensitivity below the first starts at the second instead (readings twice as large)."""
STANDS_IN = 0.2
"""An effect beside others explains this share of what they leave at least, in chi-square beyond noise."""
MANY, FEW_TERMS = 4, 8
"""Unless so many effects were found, and so few more terms would leave next to nothing on load cases not seen."""
NEAR = 0.1
"""Unless it leaves less than this share of the noise itself."""
MOST_CLOSED = 0.5
"""After a swap that leaves less than this share of chi-square beyond noise, effects are added once more."""
ROUNDS = 3
"""How often effects are added: again only if the noise beside those found is another than before."""
TRIALS = 7
PAIRS = 5
PAIRS_OPEN = 15
"""Pairs that are refitted: more of them if the model of the machine is rough and its signatures are not small."""
SWAP_REACH = 0.6
"""An alternative is refitted only if it explains this fraction of what the named effect explains."""


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


def key_of(active: ActiveEffect) -> tuple[object, ...]:
    """Effect and discrete choices."""
    return (active.effect.name, *active.choices)


def slot(effect: Effect, values: Mapping[str, float]) -> tuple[object, ...]:
    """Key of which a model has at most one: an effect, for each PSD."""
    return (effect.name, *(values[p.name] for p in effect.parameters if p.each))


def unphysical(workspace: Comparison, fit: Fit, index: int) -> bool:
    """Whether effect ``index`` of ``fit`` has run into a bound: it fits only as something that it is not.

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


def counted(fit: Fit) -> str:
    """How many effects ``fit`` has, in words."""
    count = len(fit.effects)
    return f'{count} effect{"" if count == 1 else "s"}'


def far(fit: Fit) -> bool:
    """Whether ``fit`` leaves so much that small signatures beside it would mislead."""
    return fit.chi2 > FAR * fit.residual.size


def _is_a_mass(fit: Fit) -> bool:
    """Whether a lower frequency of the bending is all: a mass at the tip does the same, and the catalogue has it."""
    ringing = [a for a in fit.effects if a.effect.name in RINGING]
    return len(ringing) == 1 and ringing[0].effect.name == RINGING[0] and ringing[0].values['error'] < 0.0


def unbound(fit: Fit) -> FloatArray:
    """The Jacobian's columns (D, k) of the parameters that are free to move."""
    keep = [j for j, name in enumerate(fit.free) if name not in fit.at_bound]
    return fit.jacobian[:, keep]


class Search:
    """One search over one comparison, which :meth:`run` gives with the noise that it estimated last.

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
        self._begun = workspace.simulations
        self.screen = screen(workspace, None)
        self.penalty = float(np.log(workspace.effective_size()))
        self.trace: list[str] = []
        self.dropped: dict[int, tuple[Fit, list[Fit]]] = {}
        self._stopped = ''

    @property
    def spent(self) -> int:
        """Forward simulations of this search."""
        return self.workspace.simulations - self._begun

    def _budget(self, fit: Fit) -> int:
        """Forward simulations that a model of this many effects may cost."""
        return round(self.workspace.budget * min(max(1, len(fit.effects)), self.workspace.most_budgets))

    def without_each(self, fit: Fit, null: Fit) -> list[Fit]:
        """``fit`` refitted without each of its effects in turn; ``null``: the fit of no effect."""
        kept = self.dropped.get(id(fit))
        if kept is None:
            fits = []
            for i in range(len(fit.effects)):
                rest = [a for j, a in enumerate(fit.effects) if j != i]
                fits.append(refit(self.workspace, rest, iterations=6) if rest else null)
            # Keep the fit itself too, so that no other object gets its id.
            kept = self.dropped[id(fit)] = (fit, fits)
        return kept[1]

    def _say(self, text: str) -> None:
        self.trace.append(f'{text} [{self.workspace.simulations}]')
        self._progress(text)

    def _bic(self, fit: Fit) -> float:
        return fit.chi2 + self.penalty * fit.parameters

    def _best_of(self, starts: Sequence[Sequence[ActiveEffect]], keep: int, iterations: int) -> Fit | None:
        """Refit each start a little, the best few in full."""
        fits = [refit(self.workspace, s, iterations=3) for s in starts]
        fits.sort(key=self._bic)
        full = [refit(self.workspace, f.effects, iterations=iterations) for f in fits[:keep]]
        return min(full, key=self._bic, default=None)

    def passes(self, smaller: Fit, larger: Fit, null: Fit) -> bool:
        """Whether ``larger`` is better than ``smaller`` by more than BIC and the simulation's own error ask."""
        gain = smaller.chi2 - larger.chi2
        if not self.workspace.open_level:
            explained = null.residual - smaller.residual
            gain = min(gain, gain_beyond(self.workspace, smaller.residual, larger.residual, explained))
        more = self.penalty * (larger.parameters - smaller.parameters)
        return gain - more > BIC_ACCEPT

    def _stands_in(self, smaller: Fit, larger: Fit) -> bool:
        """Whether what ``larger`` adds only stands in for something that the library lacks."""
        size = self.workspace.size
        if not smaller.effects or self.workspace.open_level or larger.chi2 <= (1.0 + NEAR) * size:
            return False
        little = larger.chi2 - size > (1.0 - STANDS_IN) * (smaller.chi2 - size)
        return little and not (len(smaller.effects) >= MANY and self._library_explains(smaller))

    def _library_explains(self, fit: Fit) -> bool:
        """Whether some more effects beside ``fit`` would leave next to nothing on unseen load cases, to first order."""
        terms = further_terms(self.screen, fit, self._may_pass, self.workspace.first, FEW_TERMS)
        if terms is None:
            return False
        return unseen_gap(self.workspace, fit, terms.columns) < (1.0 + NEAR) * self.workspace.floor()

    def library_p(self, gain: float, dof: int) -> float:
        """p of a gain in chi-square, over the whole library (Sidak)."""
        count = max(1, len(self.screen.candidates))
        local = float(chi2_law.sf(gain, max(dof, 1)))
        return float(-np.expm1(count * np.log1p(-min(local, 1.0 - 1e-16))))

    def renoise(self, fit: Fit) -> Fit:
        """Estimate the noise again, now that most of the discrepancy is explained; refit if it differs."""
        renoised = self.workspace.renoised([*self.workspace.base, *fit.whole])
        if renoised is self.workspace:
            return fit
        self.workspace = renoised
        self.dropped.clear()
        if self.workspace.open_level:
            self.penalty = float(np.log(self.workspace.effective_size()))
        fit = refit(self.workspace, fit.effects, iterations=6)
        self.screen = self._make_screen(self.workspace, fit)
        return fit

    def settle(self, null: Fit, fit: Fit) -> tuple[Fit, Fit]:
        """Both fits again, with free loads and times as ``fit`` asks for: else a small effect stands in for these."""
        settled = self.workspace.settled_beside(fit.difference, fit.whole)
        if settled is self.workspace:
            return null, fit
        better = refit(settled, fit.effects, iterations=6)
        if settled.gap(better.difference) > self.workspace.gap(fit.difference):
            return null, fit
        self.workspace = settled
        self.dropped.clear()
        return refit(settled, ()), better

    def at(self, workspace: Comparison) -> Search:
        """The same search over another comparison of the same recordings."""
        out = copy.copy(self)
        out.workspace = workspace
        return out

    def run(self, null: Fit, begun: Fit | None = None) -> tuple[Search, SearchResult]:
        """The search after it ran, and what it found: perhaps that nothing is missing. ``null``: the fit of no effect;
        ``begun``: that of the effects to begin with.

        This one stays as it is.
        """
        out = copy.copy(self)
        out.trace, out.dropped = [], {}
        return out, out.searched(null, begun)

    def searched(self, null: Fit, begun: Fit | None = None) -> SearchResult:
        """What :meth:`run` gives beside itself; it changes this search."""
        scores = self.screen.score(null.residual, unbound(null))
        first_scores = scores
        null, grown = self._settled(null, self.mistake(null, scores) if begun is None else begun)
        current, others = self.swap(null, grown)
        if self._much_closer(grown, current):
            # Beside the wrong effect nothing held that holds beside the right one; what that cost is not counted.
            self._begun = self.workspace.simulations
            self.screen = self._make_screen(self.workspace, current)
            null, more = self._settled(null, current)
            if len(more.effects) > len(current.effects):
                current, others = self.swap(null, more)
        p, delta_bic, delta_chi2 = self.weigh(null, current)
        limits = self._limits(current)
        return SearchResult(null, current, p, delta_bic, delta_chi2, first_scores, others, self.trace, limits)

    def _settled(self, null: Fit, current: Fit) -> tuple[Fit, Fit]:
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

    def _much_closer(self, before: Fit, current: Fit) -> bool:
        """Whether a swap closed most of what was open, and left something."""
        size = self.workspace.size
        left = current.chi2 - size
        return left < MOST_CLOSED * (before.chi2 - size) and left > NEAR * size

    def _limits(self, current: Fit) -> tuple[Limit, ...]:
        """The limit that kept further effects out, with what lies beyond it."""
        little = current.chi2 <= (1.0 + NEAR) * self.workspace.size and not self.workspace.open_level
        if not self._stopped or little:
            return ()

        terms = further_terms(self.screen, current, self._may_pass, self.workspace.first)
        return (Limit(self._stopped, beyond(self.workspace, current, terms)),) if terms is not None else ()

    def _may_pass(self, score: Score) -> bool:
        """Whether one more effect would pass, to first order."""
        return score.p <= self.workspace.p_accept and score.gain - self.penalty * score.dof > BIC_ACCEPT

    def _grown(self, null: Fit, current: Fit) -> tuple[Fit, Fit]:
        """The fit of no effect, and ``current`` with all that passes added."""
        renoised = bool(current.effects)
        while True:
            self._stopped = ''
            if self.spent >= self._budget(current):
                self._stopped = f'{self._budget(current)} simulations for {counted(current)}'
                break
            better = self._added(null, current)
            if better is None:
                break
            null, current = self.settle(null, better)
            if not renoised or self.workspace.open_level:
                renoised = True
                current = self.renoise(current)
                null = refit(self.workspace, ())
            if (far(current) or self.workspace.open_level) and self.spent < self._budget(current):
                self.screen = self._make_screen(self.workspace, current)
            if len(current.effects) == 2 and self.spent < self._budget(current):
                current = self._try_pairs(null, current)
        return null, current

    def _added(self, null: Fit, current: Fit) -> Fit | None:
        """``current`` with the effect that passes best, or a better pair; None if nothing passes."""
        ws = self.workspace
        taken = {slot(a.effect, a.values) for a in current.effects}
        scores = [
            s
            for s in self.screen.score(current.residual, unbound(current))
            if slot(s.candidate.effect, s.candidate.start) not in taken and s.candidate.effect.name not in ws.first
        ]
        better = self._further(current, scores)
        passes = better is not None and self.passes(current, better, null)
        if better is not None and passes:
            if not self._stands_in(current, better):
                self._say('adding ' + better.effects[-1].label)
                return better
            self._stopped = (
                f'{better.effects[-1].effect.name} beside {counted(current)} explains less than '
                f'{STANDS_IN:.0%} of what remains: it may only stand in for what the library lacks'
            )
        # Of two causes of a rough machine neither may help alone, and a wrong first effect hides a pair.
        if len(current.effects) >= 2 or not (ws.open_level or passes):
            return None
        better = self._try_pairs(null, current)
        holds = better is not current and self.passes(current, better, null)
        return better if holds and not self._stands_in(current, better) else None

    def _further(self, current: Fit, scores: Sequence[Score]) -> Fit | None:
        """``current`` with the best further effect."""
        if not scores or min(s.p for s in scores) > self.workspace.p_accept:
            return None
        # From the second effect on, the residual is smaller and the first guess better.
        tried = promising(scores, self.penalty, 0.3, TRIALS if not current.effects else 4)
        starts = [[*current.effects, s.candidate.from_coefficients(s.coefficients)] for s in tried]
        return self._best_of(starts, 2, 6) if current.effects else self._best_of(starts, 4, 12)

    def mistake(self, null: Fit, scores: Sequence[Score]) -> Fit:
        """One of the mistakes that touch every channel if it explains nearly all by itself, else ``null``.

        Late loads may be taken with one effect, if they explain nearly all together: each would hide the other.
        """
        if not scores or min(s.p for s in scores) > self.workspace.p_accept:
            return null
        found = self._best_of(self._mistaken(null, scores), 2, 12)
        if not self._nearly_all(null, found):
            found = self._late_beside_an_effect(null, scores)
        if found is None or not self._nearly_all(null, found) or _is_a_mass(found):
            return null
        self._say('the set-up: ' + ', '.join(a.label for a in found.effects))
        return found

    def _nearly_all(self, null: Fit, found: Fit | None) -> bool:
        """Whether ``found`` passes and leaves next to nothing."""
        size = self.workspace.size
        if found is None or not self.passes(null, found, null):
            return False
        return found.chi2 - size <= NEARLY_ALL * (null.chi2 - size)

    def _late_beside_an_effect(self, null: Fit, scores: Sequence[Score]) -> Fit | None:
        """Late loads with the best effect beside them."""
        late = [s for s in scores if s.candidate.effect.name == LATE and s.p <= self.workspace.p_accept]
        alone = self._best_of([[s.candidate.from_coefficients(s.coefficients)] for s in late], 1, 6)
        if alone is None or not self.passes(null, alone, null):
            return None
        both = self._beside_late(alone, self.screen)
        if far(alone) and not self._nearly_all(null, both) and alone.chi2 < MOST_CLOSED * null.chi2:
            # Late loads hide the spectral lines of a small effect, and change its signature.
            both = self._beside_late(alone, self._make_screen(self.workspace, alone))
        return both if both is not None and self.passes(alone, both, null) else None

    def _beside_late(self, alone: Fit, screen: Screen) -> Fit | None:
        """The late loads of ``alone`` with the best effect of ``screen`` beside them."""
        scores = screen.score(alone.residual, unbound(alone))
        return self._further(alone, [s for s in scores if s.candidate.effect.name not in self.workspace.first])

    def _mistaken(self, null: Fit, scores: Sequence[Score]) -> list[list[ActiveEffect]]:
        """The starts of :meth:`mistake`."""
        best = max((s.gain for s in scores), default=0.0)
        starts: list[list[ActiveEffect]] = []
        for s in scores:
            if s.candidate.effect.name not in self.workspace.first:
                continue
            start, name = s.candidate.from_coefficients(s.coefficients), s.candidate.effect.name
            if name == 'sensitivity' and start.values['error'] < FARTHEST_ERROR:
                start = ActiveEffect(start.effect, {'error': HALVED})
            if s.gain > LIKELY * best:
                starts.append([start])
            if name == 'sample_rate' and far(null):
                # A linear step does not reach another frequency of the ringing.
                starts += [[ActiveEffect(start.effect, {'error': v})] for v in OTHER_RATES]
        return starts + self._other_frequencies(null, [s for s in scores if s.gain > RINGS * best])

    def _other_frequencies(self, null: Fit, scores: Sequence[Score]) -> list[list[ActiveEffect]]:
        """Starts: either natural frequency is wrong, or both are."""
        near = []
        for s in scores:
            if s.candidate.effect.name in RINGING and s.candidate.effect.name in self.workspace.first:
                near.append(self._frequency(null, s))
        return [*([a] for a in near), *([near] if len(near) > 1 else [])]

    def _frequency(self, beside: Fit, score: Score) -> ActiveEffect:
        """The best start for another natural frequency: from far away a linear step does not reach it."""
        ws, start = self.workspace, score.candidate.from_coefficients(score.coefficients)
        others = OTHER_FREQUENCIES if far(beside) else ()
        return min(
            [start, *(ActiveEffect(start.effect, {'error': v}) for v in others)],
            key=lambda a: ws.loss(ws.residual([*ws.base, *beside.whole, a])[0]),
        )

    def swap(self, null: Fit, current: Fit) -> tuple[Fit, list[list[Fit]]]:
        """Try to replace each effect by its alternatives and keep the better model; at most two rounds."""
        others: list[list[Fit]] = []
        for swaps in range(3):
            others = []
            _, _, gains = self.weigh(null, current)
            best = current
            for i in range(len(current.effects)):
                fits = self.alternatives(null, current, i, gains[i])
                others.append(fits)
                best = min([best, *fits], key=self._bic)
            spent = self.spent > 1.5 * self._budget(current)
            if swaps == 2 or spent or self._bic(best) > self._bic(current) - 2.0:
                break
            self._say('swapping to ' + ', '.join(a.label for a in best.effects))
            current = refit(self.workspace, best.effects, iterations=8)
            current = self._drop(null, current)
        return current, others

    def _try_pairs(self, null: Fit, current: Fit) -> Fit:
        pairs = self.screen.pairs(
            null.residual, self.penalty, PAIRS_OPEN if self.workspace.open_level else PAIRS, unbound(null)
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
        best = self._best_of(starts, 2, 8)
        if best is not None and self._bic(best) < self._bic(current) - 2.0:
            self._say('a better pair: ' + ', '.join(a.label for a in best.effects))
            return best
        return current

    def _drop(self, null: Fit, current: Fit) -> Fit:
        while len(current.effects) > 1:
            best = min(self.without_each(current, null), key=self._bic)
            if self.passes(best, current, null):
                break
            self._say('dropping to ' + ', '.join(a.label for a in best.effects))
            current = best
        return current

    def weigh(self, null: Fit, current: Fit) -> tuple[list[float], list[float], list[float]]:
        """For each effect of ``current``: p over the library, loss in BIC and in chi-square if it were dropped."""
        p, delta_bic, delta_chi2 = [], [], []
        for i, without in enumerate(self.without_each(current, null)):
            gain = without.chi2 - current.chi2
            delta_chi2.append(gain)
            delta_bic.append(self._bic(without) - self._bic(current))
            p.append(self.library_p(gain, len(current.columns_of(i))))
        return p, delta_bic, delta_chi2

    def _in_its_place(self, current: Fit, index: int, without: Fit, gain: float) -> list[Score]:
        """The candidates in place of effect ``index``, the best eight: an exact confounder scores as high as it.

        If the search was already expensive, the case is complicated: two only.
        """
        named, rest = current.effects[index], [a for j, a in enumerate(current.effects) if j != index]
        taken = {named.effect.name, *(a.effect.name for a in rest)}
        if any(a.effect.name not in self.workspace.setup for a in rest):
            taken |= self.workspace.first
        # Screening is linear: a candidate that falls short by little needs a full refit.
        bar = min(SWAP_REACH * gain, gain - 60.0) if gain > 100.0 else 0.5 * gain
        if self.workspace.open_level:
            # A rough machine is far from linear.
            bar = 0.0
        best: dict[str, Score] = {}
        for s in self.screen.score(without.residual, unbound(without)):
            name = s.candidate.effect.name
            least = RINGS * gain if name in RINGING and far(without) else bar
            if name not in taken and s.gain >= least:
                best.setdefault(name, s)
        return sorted(best.values(), key=lambda s: -s.gain)[: 8 if self.spent < self._budget(current) else 2]

    def alternatives(self, null: Fit, current: Fit, index: int, gain: float) -> list[Fit]:
        """Refits with effect ``index`` swapped for each plausible alternative, best first.

        ``gain``: what the named effect explains, in chi-square; ``null``: the fit of no effect.
        """
        if self.spent > 2 * self._budget(current):
            return []
        rest = [a for j, a in enumerate(current.effects) if j != index]
        without = self.without_each(current, null)[index]
        ranked = self._in_its_place(current, index, without, gain)
        fits = []
        for s in ranked:
            ringing = s.candidate.effect.name in RINGING
            other = self._frequency(without, s) if ringing else s.candidate.from_coefficients(s.coefficients)
            quick = refit(self.workspace, [*rest, other], iterations=10 if self.workspace.open_level else 3)
            if quick.chi2 - current.chi2 < max(60.0, 0.2 * gain) and self.spent < 2 * self._budget(current):
                quick = refit(self.workspace, quick.effects, iterations=8)
            fits.append(quick)
        fits.sort(key=lambda f: f.chi2)
        return fits
