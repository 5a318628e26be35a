# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A law for what no effect explains: terms scored to first order, the best refitted in the simulation and chosen by
BIC. It is reported if it passes the rule for an effect and explains most of what is left."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_law

from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.laws import DOTS, FORMS, TARGETS, Law, LawTerm, effect_of, values_of, variables_of
from psd_deflection.records import FloatArray, channel_names
from psd_deflection.studies.discover.law_features import (
    LOADS,
    POSE,
    Response,
    Scored,
    known_fine,
    likelihood,
    most_jitter,
    responses,
    score,
    sought,
    switchings,
    terms,
    variance,
    with_better_level,
    with_better_times,
)
from psd_deflection.studies.discover.search.comparison import EQUIVALENT
from psd_deflection.studies.discover.search.fit import Fit, HeldOut, heldout_gain, heldout_gap, refit
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.thresholds import (
    BIC_GAIN,
    BUDGET,
    HALF,
    LIKELY,
    MANY_EFFECTS,
    P_CHANCE,
    ROUNDS,
    TRIED,
)
from psd_deflection.studies.loads.thresholds import APART_S, DISTINCT_SD, MANYFOLD, MINOR, SEVERAL


@dataclass(frozen=True, slots=True, eq=False)
class FoundLaw:
    """``fit``: the model with the law as its last effects: ``law``, then ``further`` on other quantities that belong to
    it. ``channels``: where it shows. ``equivalent``: laws in place of the first that this recording cannot tell from
    it. ``without``: the model without it. ``heldout_gap``: m, on unseen load cases.
    """

    law: Law
    further: tuple[Law, ...]
    fit: Fit
    without: Fit
    channels: tuple[str, ...]
    equivalent: tuple[Law, ...]
    p: float
    delta_bic: float
    heldout: HeldOut
    heldout_gap: float

    @property
    def laws(self) -> tuple[Law, ...]:
        """All of it."""
        return (self.law, *self.further)

    def adopted(self, name: str) -> Law:
        """Return all of it as one law of that name."""
        return dataclasses.replace(self.law, name=name, further=self.further)

    @property
    def beside(self) -> tuple[ActiveEffect, ...]:
        """The effects of the catalogue in the same model."""
        return self.fit.effects[: len(self.fit.effects) - len(self.laws)]


@dataclass(frozen=True, slots=True, eq=False)
class LawTrial:
    """Laws with the fit that has them; ``cost``: its chi-square with a penalty for each parameter."""

    laws: tuple[Law, ...]
    fit: Fit
    cost: float

    @property
    def beside(self) -> tuple[ActiveEffect, ...]:
        """The effects of the fit without the laws."""
        return self.fit.effects[: len(self.fit.effects) - len(self.laws)]

    @property
    def terms(self) -> int:
        """The number of terms of all laws."""
        return sum(len(law.terms) for law in self.laws)

    @property
    def variables(self) -> tuple[str, ...]:
        """The variables of all laws, each once."""
        return tuple(dict.fromkeys(v for law in self.laws for v in law.variables))


def law_on(target: str, *listed: LawTerm) -> Law:
    """Return the law on a quantity that has these terms."""
    return Law(f'law_{target}', TARGETS[target].stage, target, listed)


def term_covariance(fit: Fit) -> FloatArray:
    """(p, p) of the parameters of ``fit``; those that the recording does not determine get large values.

    A threshold below which only one level of a load lies is such a one.
    """
    lengths = np.maximum(np.linalg.norm(fit.jacobian, axis=0), 1e-60)
    unit = fit.jacobian / lengths
    values, vectors = np.linalg.eigh(unit.T @ unit)
    return np.asarray((vectors / np.maximum(values, 1e-9)) @ vectors.T / np.outer(lengths, lengths))


def fitted_law(law: Law, fit: Fit, covariance: FloatArray, index: int) -> Law:
    """Return the law with the values and standard deviations of effect ``index`` of ``fit``."""
    values = fit.effects[index].values
    sd = {fit.free[j][1]: math.sqrt(max(covariance[j, j], 0.0)) for j in fit.columns_of(index)}
    out = []
    for i, t in enumerate(law.terms, 1):
        deviations = {'coefficient': sd.get(f'c{i}', 0.0)}
        deviations.update({k: sd[f'{k}{i}'] for k in t.shapes if f'{k}{i}' in sd})
        shapes = {k: values[f'{k}{i}'] for k in t.shapes}
        sizes = {'coefficient': values[f'c{i}'], **shapes}
        # What the recording does not determine has no standard deviation.
        deviations = {
            k: v for k, v in deviations.items() if v < MANYFOLD**2 * abs(sizes[k]) and k not in FORMS[t.form].fixed
        }
        deviations.update({k: t.sd[k] for k in FORMS[t.form].fixed if k in t.sd})
        out.append(dataclasses.replace(t, coefficient=values[f'c{i}'], shapes=shapes, sd=deviations))
    return dataclasses.replace(law, terms=tuple(out))


class LawSearch:
    """The search beside one set of effects."""

    def __init__(self, ws: Workspace, start: Fit, penalty: float) -> None:
        self.ws, self.start, self.penalty = ws, start, penalty
        self.last = min(ws.simulations + BUDGET, max(ws.simulations, ROUNDS * BUDGET))
        self.responses = responses(ws, start)
        self.listed = list(terms(self.responses))
        if len(ws.observations) == 1:
            # In another recording the events have other times.
            self.listed += switchings(self.responses)
        self.tried = len(self.listed) * len(sought(ws.psds))

    def cost(self, laws: Sequence[Law], fit: Fit) -> float:
        """BIC; whatever was looked for counts, also what a refit does not improve."""
        more = sum(len(FORMS[t.form].fixed) + len(t.times) for law in laws for t in law.terms)
        return fit.chi2 + self.penalty * (fit.parameters + more)

    def trial(self, laws: Sequence[Law], beside: Sequence[ActiveEffect], iterations: int) -> LawTrial:
        """Return the laws refitted in the simulation."""
        fit = refit(self.ws, [*beside, *(ActiveEffect(effect_of(law), values_of(law)) for law in laws)], iterations)
        covariance = term_covariance(fit)
        better = tuple(fitted_law(law, fit, covariance, len(beside) + i) for i, law in enumerate(laws))
        # A shape at its bound means that the form is not the right one; one that is not fitted has no room.
        fixed = {
            (len(beside) + i, f'{name}{k}')
            for i, law in enumerate(laws)
            for k, t in enumerate(law.terms, 1)
            for name in FORMS[t.form].fixed
        }
        bound = any(i >= len(beside) and (i, name) not in fixed for i, name in fit.at_bound)
        return LawTrial(better, fit, math.inf if bound else self.cost(better, fit))

    def done(self, trial: LawTrial) -> bool:
        """Return whether no more than noise is left, or enough has been tried."""
        size = float(self.ws.size)
        return trial.fit.chi2 < size + 4.0 * math.sqrt(2.0 * size) or self.ws.simulations > self.last

    def first(self) -> list[LawTrial]:
        """Laws of one term, the best first."""
        scored = score(self.responses, self.listed)
        known: set[tuple[str, str, tuple[str, ...]]] = set()
        picked: list[Scored] = []
        for s in scored:
            key = (s.target, s.term.form, s.term.of)
            if key not in known and s.gain >= LIKELY * scored[0].gain and len(picked) < TRIED:
                known.add(key)
                picked.append(with_better_level(self.responses, s))
        quick = [self.trial([law_on(s.target, s.term)], self.start.effects, 3) for s in picked]
        quick.sort(key=lambda t: t.cost)
        full = [self.trial(t.laws, t.beside, 8) for t in quick[:ROUNDS]]
        return sorted([*full, *quick[ROUNDS:]], key=lambda t: t.cost)

    def grown(self, trial: LawTrial) -> LawTrial:
        """Further terms while BIC improves by enough; then terms that it does not miss go."""
        while trial.terms < MANY_EFFECTS and not self.done(trial):
            more = responses(self.ws, trial.fit)
            if trial.laws[0].terms[0].times and len(trial.laws) == 1:
                again = self._switched_again(trial, more)
                if again.cost < trial.cost - BIC_GAIN:
                    trial = again
                    continue
            scored = score(more, [t for t in self.listed if t.form != 'switched'])
            better = [with_better_level(more, s) for s in scored[:2]]
            tries = [self.trial(with_term(trial.laws, s), trial.beside, 4) for s in better]
            best = min(tries, key=lambda t: t.cost, default=trial)
            if best.cost > trial.cost - BIC_GAIN:
                break
            trial = best
        while trial.terms > 1:
            fewer = [self.trial(laws, trial.beside, 5) for laws in subsets_without_a_term(trial.laws)]
            best = min(fewer, key=lambda t: t.cost)
            if best.cost > trial.cost + BIC_GAIN:
                break
            trial = best
        return trial

    def _switched_again(self, trial: LawTrial, residuals: Sequence[Response]) -> LawTrial:
        """With the further times of switching that show once the law is in the model."""
        (law,), best = trial.laws, trial
        term = law.terms[0]
        for more in switchings(residuals, (law.acts_on.removeprefix('static_'),)):
            times = tuple(sorted({*term.times} ^ {*more.times}))
            if more.of == term.of and times:
                better = with_better_times(self.responses, law.acts_on, LawTerm(term.form, term.of, times=times))
                both = dataclasses.replace(term, times=better.times)
                now = dataclasses.replace(law, terms=(both, *law.terms[1:]))
                best = min(best, self.trial([now], trial.beside, 4), key=lambda t: t.cost)
        return best

    def lean(self, trial: LawTrial) -> LawTrial:
        """Without the effects that only stood in for the law."""
        while trial.beside:
            fewer = [self.trial(trial.laws, [a for a in trial.beside if a is not gone], 5) for gone in trial.beside]
            best = min(fewer, key=lambda t: t.cost)
            if best.cost > trial.cost + BIC_GAIN:
                break
            trial = best
        return trial

    def same_elsewhere(self, trial: LawTrial) -> list[LawTrial]:
        """Return the first law at the other stages that show alike: a beam for a dot, a load for a static pose."""
        law, further_laws = trial.laws[0], trial.laws[1:]
        moved: list[Law] = []
        if f'beam_{law.acts_on}' in TARGETS:
            moved.append(dataclasses.replace(law, acts_on=f'beam_{law.acts_on}', stage='optics'))
        if law.acts_on.startswith('static_'):
            row = TARGETS[law.acts_on].row
            p = self.ws.physics
            per = p.torque_compliance if row == 2 else p.force_compliance
            of_load = tuple(dataclasses.replace(t, coefficient=t.coefficient / per) for t in law.terms)
            moved.append(dataclasses.replace(law, acts_on=LOADS[row], stage='load', terms=of_load))
        out = [self.trial([m, *further_laws], trial.beside, 4) for m in moved]
        if law.acts_on in DOTS:
            # A voltage is a dot over a constant: by no recording can the two be distinguished.
            out.append(LawTrial((dataclasses.replace(law, stage='electronics'), *further_laws), trial.fit, trial.cost))
        return out


def with_term(laws: Sequence[Law], s: Scored) -> tuple[Law, ...]:
    """Return the laws and one more term, in the law on its target if there is one."""
    if any(law.acts_on == s.target for law in laws):
        return tuple(
            dataclasses.replace(law, terms=(*law.terms, s.term)) if law.acts_on == s.target else law for law in laws
        )
    return (*laws, law_on(s.target, s.term))


def subsets_without_a_term(laws: Sequence[Law]) -> list[tuple[Law, ...]]:
    """Return each way to leave out one term."""
    out = []
    for gone in (t for law in laws for t in law.terms):
        rest = [dataclasses.replace(law, terms=tuple(t for t in law.terms if t is not gone)) for law in laws]
        out.append(tuple(law for law in rest if law.terms))
    return out


def find_law(
    ws: Workspace, null: Fit, fit: Fit, penalty: float, excess: float, progress: Callable[[str], None]
) -> FoundLaw | None:
    """Return the law that explains what ``fit`` leaves, or None.

    ``null``: the rig file's own model, tried as well, because effects of the catalogue may stand in for the law.
    ``excess``: chi-square beyond noise that ``fit`` leaves; ``penalty``: of BIC, for each parameter.
    """
    progress('a law for what remains')
    found_law = _law_of_the_mean(ws, null, fit, penalty, excess)
    return found_law or find_jitter(ws, fit, penalty)


def _law_of_the_mean(ws: Workspace, null: Fit, fit: Fit, penalty: float, excess: float) -> FoundLaw | None:
    starts = [fit, null] if fit.effects else [null]
    trials: list[tuple[LawTrial, LawSearch]] = []
    for start in starts:
        seeker = LawSearch(ws, start, penalty)
        trials += [(t, seeker) for t in seeker.first()]
    trials = [(t, s) for t, s in trials if t.cost < math.inf]
    if not trials:
        return None
    trials.sort(key=lambda t: t[0].cost)
    # Where one law leaves nothing but noise, others get no further terms.
    followed: list[tuple[LawTrial, LawSearch]] = []
    for t, s in trials[:ROUNDS]:
        followed.append((t if s.done(t) else s.grown(t), s))
        if s.done(followed[-1][0]):
            break
    best, seeker = min(followed, key=lambda t: t[0].cost)
    best = seeker.lean(best)
    alternatives = [t for t, _ in (*followed, *trials)]
    best = simplest(best, alternatives)
    fit_with_law = best.fit
    without = refit(ws, best.beside, 6) if best.beside else null
    gain = without.chi2 - fit_with_law.chi2
    parameters = fit_with_law.parameters - without.parameters
    chosen = sum(len(t.times) for law in best.laws for t in law.terms)
    # Every term on every target might have been taken, and every block as a time of a switching.
    chances = best.terms * math.log(seeker.tried) + chosen * math.log(max(ws.size / (3.0 * ws.psds), 2.0))
    p = math.exp(chances + float(chi2_law.logsf(gain, max(parameters, 1))))
    bic = gain - (best.cost - fit_with_law.chi2 - penalty * without.parameters)
    held = heldout_gain(ws, without, fit_with_law)
    residual_gap = heldout_gap(ws, fit_with_law)
    # As of effects: no other case can speak for or against what one case alone shows.
    predicts = _predicts(ws, fit, heldout_gap(ws, fit_with_law, home=False))
    enough = predicts and fit.chi2 - fit_with_law.chi2 > HALF * excess
    enough &= not at_load_changes(ws, best.laws)
    enough &= best.cost < fit.chi2 + penalty * fit.parameters - BIC_GAIN
    if p > P_CHANCE or bic <= BIC_GAIN or not held.significant or not enough:
        return None
    return FoundLaw(
        best.laws[0],
        best.laws[1:],
        fit_with_law,
        without,
        dominant_channels(ws, best),
        tied_laws(best, [*alternatives, *seeker.same_elsewhere(best)]),
        p,
        bic,
        held,
        residual_gap,
    )


def _predicts(ws: Workspace, fit: Fit, residual_gap: float) -> bool:
    """Whether a law with ``residual_gap``, m, on unseen load cases closes half of the gap of ``fit``, as energies
    beyond noise.
    """
    floor = ws.floor()
    return residual_gap**2 - floor**2 <= (1.0 - HALF) * max(ws.gap(fit.difference) ** 2 - floor**2, 0.0)


def at_load_changes(ws: Workspace, laws: Sequence[Law]) -> bool:
    """Whether most of the times at which ``laws`` switch are those at which the loads change: the loads do it."""
    times = np.array([t for law in laws for term in law.terms for t in term.times])
    (o, *more) = ws.observations
    changes = np.flatnonzero(np.any(np.diff(o.loads, axis=0) != 0.0, axis=1)) * o.period
    if len(times) < SEVERAL or more or len(changes) == 0 or len(changes) > o.duration:
        return False
    at_change = np.abs(times[:, None] - changes).min(axis=1) < APART_S
    return bool(np.mean(at_change) > 0.5)


def find_jitter(ws: Workspace, fit: Fit, penalty: float) -> FoundLaw | None:
    """Return the channel and the variable that its noise grows with, or None: variance = a + b v^2."""
    known = {name: known_fine(ws, fit.effects, name) for name in variables_of(ws.psds)}
    folds = [ws.folds()[case] for case in ws.case]
    fold = np.concatenate(folds)
    best, tried = most_jitter(ws, fit, known)
    if best is None:
        return None
    gain, channel, name, slope, full = best
    c = channel_names(ws.psds).index(channel)
    squares = np.concatenate([part[c] for part in ws.split(fit.residual)]) ** 2
    v2 = np.concatenate(known[name]) ** 2 / full
    held = []
    for k in np.unique(fold):
        training, held_out = (fold != k) & (squares > 0.0), (fold == k) & (squares > 0.0)
        a, b = variance(squares[training], v2[training])
        flat = float(squares[training].mean())
        held.append(likelihood(squares[held_out], a + b * v2[held_out]) - likelihood(squares[held_out], flat))
    heldout = HeldOut(0.5 * float(sum(held)), math.sqrt(max(gain, 1.0)))
    p = tried * float(chi2_law.sf(gain, 1))
    if p > P_CHANCE or gain - penalty <= BIC_GAIN or not heldout.significant or slope <= 0.0:
        return None
    # Noise that grows with the motion explains no gap: what remains in means is a movement.
    if ws.gap(fit.difference) > DISTINCT_SD * ws.floor():
        return None
    scale = float(np.mean([n.innovation[c] * math.sqrt(s) for n, s in zip(ws.noise, ws.fine, strict=True)]))
    if not channel.startswith('sum'):
        scale *= float(ws.physics.sensitivity.ravel()[ws.channels.index(channel)])
    coefficient = math.sqrt(slope) * scale
    # The curvature of the likelihood of a single parameter, to first order.
    term = LawTerm('jitter', (name,), coefficient, sd={'coefficient': coefficient / math.sqrt(gain)})
    law = Law(f'law_{channel}', 'electronics', channel, (term,))
    # What this noise adds to block means is no gap any more.
    added = sum(float(np.sum((coefficient * v) ** 2)) for v in known[name]) / sum(len(v) for v in known[name])
    added /= float(len(ws.channels)) * ws.observations[0].rig.estimator.block_size
    added = 0.0 if channel.startswith('sum') else added
    more = ws.gap(fit.difference) ** 2 - ws.floor() ** 2
    if ws.gap(fit.difference) > (1.0 + MINOR) * ws.floor() and added < HALF * more:
        return None
    with_jitter = dataclasses.replace(fit, effects=(*fit.effects, ActiveEffect(effect_of(law), values_of(law))))
    alternatives = [dataclasses.replace(law, stage='psd')]
    return FoundLaw(
        law,
        (),
        with_jitter,
        fit,
        (channel,),
        tuple(alternatives),
        p,
        gain - penalty,
        heldout,
        math.sqrt(max(heldout_gap(ws, fit) ** 2 - added, 0.0)),
    )


def simplest(best: LawTrial, alternatives: Sequence[LawTrial]) -> LawTrial:
    """Of the laws beside the same effects that this recording cannot tell apart, the one with the fewest variables.

    A sensor's own dot goes before the pose, on which its dot depends.
    """
    beside = [a.effect.name for a in best.beside]
    tied = [
        t
        for t in (best, *alternatives)
        if t.fit.chi2 - best.fit.chi2 < EQUIVALENT
        and t.cost - best.cost < BIC_GAIN
        and [a.effect.name for a in t.beside] == beside
    ]

    def rank(t: LawTrial) -> tuple[int, int, int, float]:
        foreign = sum(v in POSE for law in t.laws if law.acts_on in DOTS for v in law.variables)
        return t.terms, len(t.variables), foreign, t.cost

    return min(tied, key=rank)


def tied_laws(best: LawTrial, alternatives: Sequence[LawTrial]) -> tuple[Law, ...]:
    """Return each other first law, by stage, target and variables, that the recording cannot exclude."""

    def key(law: Law) -> tuple[str, str, tuple[str, ...]]:
        return law.stage, law.acts_on, law.variables

    out = {key(best.laws[0]): best.laws[0]}
    for t in sorted(alternatives, key=lambda t: t.cost):
        if t.fit.chi2 - best.fit.chi2 < EQUIVALENT and t.cost - best.cost < EQUIVALENT:
            out.setdefault(key(t.laws[0]), t.laws[0])
    return tuple(out.values())[1:]


def dominant_channels(ws: Workspace, best: LawTrial) -> tuple[str, ...]:
    """Where the law shows: the channels with more than a twentieth of its energy."""
    _, alone = ws.residual([*ws.base, *best.fit.nuisance, *best.beside])
    moved = ws.whiten([a - b for a, b in zip(alone, best.fit.difference, strict=True)])
    energy: FloatArray = np.sum([np.sum(part**2, axis=1) for part in ws.split(moved)], axis=0)
    return tuple(c for c, e in zip(channel_names(ws.psds), energy, strict=True) if e > 0.05 * float(energy.sum()))
