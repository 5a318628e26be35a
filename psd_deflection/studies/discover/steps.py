# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The steps of discover: search, weigh, name the alternatives, say where. Each gives the next problem.

An effect is named only if all of these hold: library-wide p <= 1e-4 (0.01 of a plant), a BIC better by more
than 10, a gain of more than two standard errors on held-out load cases, and parameters within their bounds.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from psd_deflection.studies.discover.problem import Machine, Problem, Progress, Step
from psd_deflection.studies.discover.search.comparison import EQUIVALENT, Comparison
from psd_deflection.studies.discover.search.fit import Fit, heldout_gain, heldout_tables, refit
from psd_deflection.studies.discover.search.predictive import predictive_of
from psd_deflection.studies.discover.search.search import Search, SearchResult
from psd_deflection.studies.discover.search.smooth import Remainder, remainder_of
from psd_deflection.studies.discover.search.trials import cancels, unphysical, wald_chi_square
from psd_deflection.studies.discover.search.weighing import (
    Alternative,
    NamedEffect,
    Unknown,
    coincidences,
    heldout_per_channel_of,
    no_noise,
    per_channel_of,
    sd_of,
    tied,
    unknown_of,
    unnamed_gap,
    waterfall_of,
)
from psd_deflection.studies.discover.thresholds import BIC_EQUIVALENT, BIC_GAIN, SIGNIFICANT
from psd_deflection.studies.loads.thresholds import DISTINCT_SD, MINOR


def solve(
    machine: Machine, steps: Sequence[Step], seed: int, progress: Progress, rng: np.random.Generator | None = None
) -> Problem:
    """Return the problem of ``machine`` after ``steps``. The same ``seed`` gives the same answer."""
    problem = Problem.of(machine, seed, progress, np.random.default_rng(seed) if rng is None else rng)
    for step in steps:
        problem = step(problem)
    return problem


def search(problem: Problem, begun: Fit | None = None) -> Problem:
    """Return the model that the search chooses, beside its alternatives; from the effects of ``begun`` on, if given."""
    start = problem.comparison
    search_used, result = problem.search.run(problem.null, begun)
    names = {a.effect.name for a in result.fit.effects}
    if names & start.first and names - start.setup:
        # A mistake that needs an effect beside it must be much better than effects alone, or the model of fewer.
        plain = search_used.workspace.replaced(first=frozenset())
        plain_search = Search(plain, problem.machine.screen, problem.progress)
        plain_search, plain_result = plain_search.run(refit(plain, ()))
        cost = plain_result.fit.chi2 + plain_search.penalty * plain_result.fit.parameters
        margin = BIC_GAIN if len(plain_result.fit.effects) <= len(result.fit.effects) else 0.0
        if cost < result.fit.chi2 + search_used.penalty * result.fit.parameters + margin:
            search_used, result = plain_search, plain_result
    search_used, result = _with_one_cause(problem, search_used, result)
    if not start.open_level:
        search_used = search_used.at(search_used.workspace.replaced(nuisance=result.fit.nuisance))
    return replace(problem, search=search_used, result=result, fit=result.fit, null=result.null)


def _with_one_cause(problem: Problem, search_used: Search, result: SearchResult) -> tuple[Search, SearchResult]:
    """Return the search and its result, with a wrong number of the rig file in place of effects that do the same."""
    first = problem.comparison.first
    if not first or len(result.fit.effects) < 2:
        return search_used, result
    asking = search_used
    if not search_used.workspace.first:
        asking = Search(search_used.workspace.replaced(first=first), problem.machine.screen, problem.progress)
    fit = asking.with_one_cause(result.fit)
    if fit is result.fit:
        return search_used, result
    p, delta_bic, delta_chi2 = asking.weigh(result.null, fit)
    fits = [asking.alternatives(result.null, fit, i, gain) for i, gain in enumerate(delta_chi2)]
    return asking, replace(result, fit=fit, p=p, delta_bic=delta_bic, delta_chi2=delta_chi2, alternatives=fits)


def weigh(problem: Problem) -> Problem:
    """Return the effects that hold, with where what they leave has structure."""
    problem.progress('weighing')
    problem = accepted(problem)
    for _ in range(2 if problem.comparison.open_level else 0):
        if problem.fit is problem.result.fit or not problem.fit.effects:
            break
        # Without what did not hold, another effect may be the better one.
        null, search_used = problem.result.null, problem.search
        fit, alternatives_of_effects = search_used.swap(null, problem.fit)
        p, delta_bic, delta_chi2 = search_used.weigh(null, fit)
        result = replace(
            problem.result,
            fit=fit,
            p=p,
            delta_bic=delta_bic,
            delta_chi2=delta_chi2,
            alternatives=alternatives_of_effects,
        )
        problem = accepted(replace(problem, result=result, fit=fit))
    problem = credible(problem)
    bare = problem.bare
    return problem if bare is problem.comparison else replace(problem, null=refit(bare, ()))


def accepted(problem: Problem) -> Problem:
    """Return the joint rule: without the effects that fail it, the weakest first, the rest fitted anew."""
    while True:
        heldout, fails = [], []
        ws, search_used, fit = problem.comparison, problem.search, problem.fit
        for i, without in enumerate(search_used.without_each(fit, problem.result.null)):
            gain = heldout_gain(ws, without, fit)
            heldout.append(gain)
            columns = fit.columns_of(i)
            chi2 = without.chi2 - fit.chi2
            bic = chi2 - search_used.penalty * len(columns)
            if (
                not gain.significant
                or unphysical(ws, fit, i)
                or cancels(ws, fit, i, problem.result.null)
                or search_used.library_p(_gain(ws, fit, i, chi2), len(columns)) > ws.p_accept
                or bic <= BIC_GAIN
                or _in_sds(ws, fit, i) < DISTINCT_SD
            ):
                fails.append((bic, i))
        problem = replace(problem, heldout=tuple(heldout))
        if not fails:
            return problem
        problem = without_effect(problem, min(fails)[1], 'fails the joint rule')


def _in_sds(ws: Comparison, fit: Fit, index: int) -> float:
    """Return the largest size of effect ``index``, in its own standard deviations; infinite if none is no number."""
    effect, sds = fit.effects[index], sd_of(ws, fit, index)
    sizes = [p for p in effect.effect.parameters if p.kind == 'amplitude' and p.name in sds]
    apart = [(abs(effect.values[p.name] - p.off(ws.physics)), sds[p.name]) for p in sizes]
    return max((math.inf if not a < math.inf else a / max(sd, 1e-300) for a, sd in apart), default=math.inf)


def _gain(ws: Comparison, fit: Fit, index: int, chi2: float) -> float:
    """What effect ``index`` explains: the ``chi2`` that is lost without it, or less if its size says less."""
    return chi2 if ws.open_level else min(chi2, wald_chi_square(ws, fit, index))


def credible(problem: Problem) -> Problem:
    """Without effects that explain less than the unknown remainder: they probably stand in for it."""
    while True:
        residual = problem.machine.look(problem.comparison, problem.fit, problem.result.null, problem.rng)
        problem = replace(problem, residual=residual)
        steps = problem.machine.chi_square_explained(problem.comparison)
        if not problem.fit.effects or not unknown_of(residual, 0.0, steps=steps):
            return problem
        closer = _of_another_shape(problem)
        if closer is not problem:
            problem = closer
            continue
        weakest = int(np.argmin(problem.result.delta_chi2))
        if problem.result.delta_chi2[weakest] >= residual.excess:
            return problem
        problem = without_effect(problem, weakest, 'explains less than what remains unknown')


def _of_another_shape(problem: Problem) -> Problem:
    """``problem`` with a better fit of its effects, if another shape explains the little that this one leaves."""
    ws, search_used, fit, result = problem.comparison, problem.search, problem.fit, problem.result
    limit = max(SIGNIFICANT * ws.floor(), MINOR * problem.gap_before)
    if ws.open_level or ws.gap(fit.difference) > limit:
        return problem
    better = search_used.of_another_shape(fit)
    if better is fit:
        return problem
    search_used.log('another shape: ' + ', '.join(a.label for a in better.effects))
    p, delta_bic, delta_chi2 = search_used.weigh(result.null, better)
    result = replace(result, fit=better, p=p, delta_bic=delta_bic, delta_chi2=delta_chi2)
    return accepted(replace(problem, fit=better, result=result))


def without_effect(problem: Problem, index: int, why: str) -> Problem:
    """``problem`` without one effect of its fit, the rest fitted and weighed anew; ``why`` goes into the trace."""
    search_used, null, fit = problem.search, problem.result.null, problem.fit
    search_used.trace.append(f'{fit.effects[index].label} {why}')
    rest = [a for j, a in enumerate(fit.effects) if j != index]
    remaining = refit(problem.comparison, rest, iterations=6) if rest else null
    p, delta_bic, delta_chi2 = search_used.weigh(null, remaining)
    result = replace(problem.result, p=p, delta_bic=delta_bic, delta_chi2=delta_chi2)
    heldout = tuple(h for j, h in enumerate(problem.heldout) if j != index)
    return replace(problem, result=result, fit=remaining, heldout=heldout)


def alternatives(problem: Problem) -> Problem:
    """The effects of the fit with their standard deviations and what explains the data as well in their place."""
    problem.progress('alternatives')
    result, fit = problem.result, problem.fit
    named = []
    for i in range(len(fit.effects)):
        # If the joint rule has removed effects, their alternatives are no longer comparable.
        as_found = fit is result.fit
        fits = (
            result.alternatives[i]
            if as_found
            else problem.search.alternatives(result.null, fit, i, result.delta_chi2[i])
        )
        named.append(_named(problem, i, fits))
    return replace(
        problem,
        named=tuple(named),
        alternative_fits=tuple(r.fit for e in named for r in e.fitted_alternatives),
        unsettled=tuple(dict.fromkeys(name for e in named for name in e.equivalent)),
    )


def _named(problem: Problem, index: int, fits: Sequence[Fit]) -> NamedEffect:
    ws, result, fit = problem.comparison, problem.result, problem.fit
    rows, equal, fitted_alternatives = [], [], []
    for f in fits:
        loss = f.chi2 - fit.chi2
        bic = loss + problem.search.penalty * (f.parameters - fit.parameters)
        rows.append((f.effects[-1].effect.name, loss, bic))
        if loss < EQUIVALENT and (f.parameters <= fit.parameters or bic < BIC_EQUIVALENT):
            equal.append(f)
        if (bic < BIC_GAIN or f in equal) and not unphysical(ws, f, len(f.effects) - 1):
            fitted_alternatives.append(Alternative(f.effects[-1], sd_of(ws, f, len(f.effects) - 1), bic, f))
    return NamedEffect(
        active=fit.effects[index],
        sd=sd_of(ws, fit, index),
        p=result.p[index],
        delta_bic=result.delta_bic[index],
        heldout=problem.heldout[index],
        equivalent=tuple(dict.fromkeys(f.effects[-1].effect.name for f in equal)),
        fitted_alternatives=tuple(sorted(fitted_alternatives, key=lambda r: r.delta_bic)),
        alternatives=tuple(rows),
        suggestion=problem.machine.suggest(ws, fit, equal) if equal else None,
    )


def where(problem: Problem) -> Problem:
    """Where the described model and the fit leave structure, and what of it remains unknown."""
    problem.progress('where')
    ws, null, fit, residual = problem.bare, problem.null, problem.fit, problem.residual
    before = residual if fit is null else problem.machine.look(ws, null, None, problem.rng)
    # Coarse steps cause noise that varies with the signal; compare what they explain with it.
    steps = problem.machine.chi_square_explained(ws)
    explained = max(null.chi2 - fit.chi2, 0.0) + steps
    gap_after = ws.gap(fit.difference)
    unknown = (
        unknown_of(residual, explained, gap_after, ws.floor(), ws.noise_limit(), steps, ws.worded)
        or unnamed_gap(ws, problem.gap_before, gap_after)
        or (() if fit.effects else no_noise(ws, residual, problem.gap_before, gap_after))
        or tied(coincidences(fit, ws.physics), fit, problem.result, before)
    )
    remainder = remainder_of(ws, fit, residual, problem.machine.regressors(ws, fit)) if unknown else None
    smooth = problem.machine.smooth(ws, fit)
    if smooth is not None and (remainder is None or smooth.heldout < remainder.heldout):
        remainder = Remainder.of(smooth)
        share = min((remainder.rms / problem.gap_before) ** 2, 1.0)
        unknown = (*unknown, remainder.unknown(ws, share))
    return replace(problem, before=before, unknown=unknown, remainder=remainder)


def predict(problem: Problem) -> Problem:
    """Return the model that predicts best beside the named effects; what it explains beyond them is unknown."""
    ws, fit, search_used = problem.comparison, problem.fit, problem.search
    within_noise = not ws.open_level and ws.gap(fit.difference) <= SIGNIFICANT * ws.floor()
    if within_noise and not problem.unknown and not problem.result.limits:
        return problem
    problem.progress('predicting')
    predictive = predictive_of(ws, fit, search_used.screen, problem.rng)
    problem = replace(problem, predictive=predictive)
    if predictive is None or not predictive.unexplained or problem.unknown:
        return problem
    before = max(problem.gap_before, 1e-300)
    rms = float(np.sqrt(max(predictive.unseen_named**2 - predictive.unseen**2, 0.0)))
    signature = f'many small terms together, {ws.worded(rms)} rms on unseen cases, none of which stands out'
    return replace(problem, unknown=(Unknown(signature, (), float(min((rms / before) ** 2, 1.0)), rms=rms),))


def fields_of(problem: Problem) -> dict[str, Any]:
    """The fields of :class:`~psd_deflection.studies.discover.conclusion.Conclusion` after the last step, by name."""
    ws, null, fit = problem.bare, problem.null, problem.fit
    after, held = ws.gap(fit.difference), heldout_tables(ws, fit)
    return {
        'verdict': 'unknown_effect' if problem.unknown else 'effects_found' if problem.named else 'nothing_missing',
        'effects': problem.named,
        'unknown': problem.unknown,
        'where': problem.before,
        'residual': problem.residual,
        'gap_before': problem.gap_before,
        'gap_after': after,
        'gap_floor': ws.floor(),
        'gap_heldout_before': problem.gap_before,
        'gap_heldout_after': ws.gap(held),
        'per_channel': per_channel_of(ws, null.difference, fit.difference),
        'heldout_per_channel': heldout_per_channel_of(ws, held),
        'waterfall': waterfall_of(ws, fit, problem.gap_before, after),
        'remainder': problem.remainder,
        'prediction': problem.predictive,
        'simulations': ws.simulations,
        'search': problem.result,
        'fit': fit,
        'workspace': ws,
        'seed': problem.seed,
        'nuisance': (),
    }
