# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The search with its verdict: beside the loads as annotated, or beside free ones if they were noted wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.studies.discover import recorded as recordings_ready
from psd_deflection.studies.discover.problem import Problem
from psd_deflection.studies.discover.recorded_rig import proposals_of, rig_of, workspace_of
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, refit
from psd_deflection.studies.discover.search.free import LoadDirection
from psd_deflection.studies.discover.search.signatures import (
    SignatureBank,
)
from psd_deflection.studies.discover.search.weighing import SIGNIFICANT
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup.applied import directions, levels, ringing_on, times, unseen
from psd_deflection.studies.discover.setup.redundant import fourth_reading
from psd_deflection.studies.discover.steps import search, solve, weigh
from psd_deflection.studies.loads.plateaus import all_free, may_be_rounded, rounded

FREE_FROM = 10.0
"""A gap of so many floors, beside what the search has found, is held against loads that were noted wrong."""
CLOSED = 0.2
"""Free loads are the answer if they and the effects beside them leave less than this share of it."""
TURNS, MOST_SETTLED, SETTLED, AT_FLOOR = 2, 4, 0.95, 1.05
"""Free loads are settled in so many turns, then sizes beside them, so often at most: until a gap of this share of that
before is left, or of this many floors.
"""
FOLLOWED = 4
"""So many known effects are asked, to first order, whether they make the gap."""
FOLLOWS = 0.1
"""Known effects of a few per cent are linear to this share of the gap: if they leave more, it follows none of them."""


def effective_loads(problem: Problem) -> Problem:
    """With the free loads as the chosen model says."""
    ws, fit = workspace_of(problem.comparison), problem.fit
    if not ws.free_loads:
        return problem
    ws, fit = _in_turns(ws, fit)
    null = refit(ws, ())
    fit = fit if fit.effects else null
    search = problem.search.at(ws)
    search.dropped = {}
    p, delta_bic, delta_chi2 = search.weigh(null, fit)
    alternatives = [search.alternatives(null, fit, i, delta_chi2[i]) for i in range(len(fit.effects))]
    result = replace(
        problem.result, null=null, fit=fit, p=p, delta_bic=delta_bic, delta_chi2=delta_chi2, alternatives=alternatives
    )
    return replace(problem, search=search, result=result, fit=fit, null=null)


def _in_turns(ws: Workspace, fit: Fit) -> tuple[Workspace, Fit]:
    """Return the free loads as ``fit`` asks for, and the sizes of its effects beside them, in turns."""
    gap = ws.gap(fit.difference)
    for _ in range(MOST_SETTLED):
        # Loads and times are found to first order: at the sizes as they are, then the sizes beside them.
        next_ws, better = _refitted(ws, fit)
        if fit.effects:
            next_ws, better = _refitted(next_ws, refit(next_ws, fit.effects, 6))
        previous_gap, gap = gap, next_ws.gap(better.difference)
        if gap > previous_gap:
            break
        ws, fit = next_ws, better
        if gap > SETTLED * previous_gap or gap < AT_FLOOR * ws.floor():
            break
    return ws, fit


def _refitted(ws: Workspace, fit: Fit) -> tuple[Workspace, Fit]:
    """Return the free loads as ``fit`` asks for, and what it leaves then: never more than before."""
    for _ in range(TURNS):
        next_ws = ws.refitted_beside(fit.difference, fit.coefficients_with_nuisance)
        next_ws = ws.refitted(fit.difference) if next_ws is ws else next_ws
        residual, difference = next_ws.residual([*next_ws.base, *fit.coefficients_with_nuisance])
        if next_ws.gap(difference) > ws.gap(fit.difference):
            # Beside an effect that is far from linear a step may lead away.
            break
        ws, fit = next_ws, replace(fit, residual=residual, difference=difference, chi2=next_ws.loss(residual))
    return ws, fit


def refitted(problem: Problem) -> Problem:
    """With the free loads as the effects ask for that hold, if not all that were searched do."""
    ws = workspace_of(problem.comparison)
    if not ws.free_loads or problem.fit is problem.result.fit:
        return problem
    ws, fit = _refitted(ws, problem.fit)
    null = refit(ws, ())
    return replace(problem, search=problem.search.at(ws), fit=fit if fit.effects else null, null=null)


SEARCH = (search, effective_loads, weigh, refitted)
"""The search with its verdict, of the loads as they are."""


def searched(problem: Problem) -> Problem:
    """The search with its verdict: with the loads as annotated, or free if they were noted wrong. If much remains, with
    the ringing free that outlasts what is left out.
    """
    problem = _searched(problem)
    ws, effects = workspace_of(problem.comparison), problem.result.fit.effects
    if ws.gap(problem.fit.difference) < SIGNIFICANT * ws.floor():
        return problem
    ringing = [d for i, o in enumerate(ws.observations) for d in ringing_on(o, i, [*ws.base, *effects])]
    if not ringing:
        return problem
    problem.progress('how the link rang on after what is left out')
    # What rings on is all that is seen of loads that were hung in what is left out.
    observable = [d for d in ws.directions if not unseen(ws, d)]
    free = ws.with_free((*observable, *ringing), effects)
    begun = refit(free, effects, 12)
    # Else the noise beside it would be that of a link that does not ring as it did.
    free, begun = _in_turns(free, begun)
    alternative = replace(problem, search=problem.search.at(free), fit=begun, null=refit(free, ()))
    for step in (partial(search, begun=begun), *SEARCH[1:]):
        alternative = step(alternative)
    return alternative if alternative.comparison.gap(alternative.fit.difference) < SIGNIFICANT * ws.floor() else problem


def _searched(problem: Problem) -> Problem:
    machine = rig_of(problem)
    if machine.recorded.fourth is not None and machine.recorded.fourth.acquits and _follows_nothing(problem):
        # No detector is at fault, and nothing that is known: the loads are asked before the search spends on stand-ins.
        with_free = _with_all_loads_free(problem)
        if (
            with_free is not None
            and with_free.comparison.gap(with_free.fit.difference) < SIGNIFICANT * with_free.comparison.floor()
        ):
            return _as_annotated(problem, with_free)
    asked = _with_all_loads_free(problem, maybe_rounded=True) if _rounded_beside_effect(problem) else None
    if asked is not None and _rounded(asked):
        return _as_annotated(problem, asked)
    for step in SEARCH:
        problem = step(problem)
    with_free = _with_all_loads_free(problem, had=asked)
    before = problem.comparison.gap(problem.fit.difference)
    if with_free is not None and with_free.comparison.gap(with_free.fit.difference) < CLOSED * before:
        return _as_annotated(problem, with_free)
    # A detector at fault may move the dots by more than rounded loads move the plate.
    with_free = _with_all_loads_free(problem, maybe_rounded=True) if with_free is None and asked is None else None
    return _as_annotated(problem, with_free) if with_free is not None and _rounded(with_free) else problem


def _as_annotated(problem: Problem, with_free: Problem) -> Problem:
    """``with_free``; or the search as annotated, from the effects that were found beside free loads, if these leave no
    more.
    """
    ws, effects = problem.comparison, with_free.fit.effects
    begun = refit(ws, effects, 12) if effects else problem.null
    numbers = sum(isinstance(d, LoadDirection) for d in workspace_of(with_free.comparison).directions)
    if begun.chi2 - with_free.fit.chi2 > problem.search.penalty * numbers:
        return with_free
    problem.progress('as annotated')
    for step in (partial(search, begun=begun), *SEARCH[1:]):
        problem = step(problem)
    return problem


def _follows_nothing(problem: Problem) -> bool:
    """Return whether some effects leave a good part of the gap, to first order: no simulation is made."""
    ws, fit = problem.comparison, problem.fit
    gap = ws.gap(fit.difference)
    if gap < FREE_FROM * ws.floor():
        return False
    columns = [fit.jacobian[:, j] for j in range(len(fit.free))]
    for _ in range(FOLLOWED):
        known = np.column_stack(columns) if columns else None
        best = max(problem.search.screen.score(fit.residual, known), key=lambda s: s.gain, default=None)
        if best is None:
            break
        columns += problem.search.screen.columns_of(best.candidate)
    return not columns or _residual_gap(ws, fit, columns) > max(FOLLOWS * gap, FREE_FROM * ws.floor())


def _residual_gap(ws: Comparison, fit: Fit, columns: Sequence[FloatArray]) -> float:
    """Return the gap that ``columns`` (D,), whitened, leave of ``fit``, to first order."""
    moved = np.column_stack(columns)
    residual = fit.residual - moved @ np.linalg.lstsq(moved, fit.residual, rcond=1e-9)[0]
    return ws.gap([d + c for d, c in zip(fit.difference, ws.unwhitened(residual - fit.residual), strict=True)])


def _rounded_beside_effect(problem: Problem) -> bool:
    """Whether one effect leaves little of the gap beside loads that may be rounded, and much alone, to first order."""
    ws, fit = workspace_of(problem.comparison), problem.fit
    gap = ws.gap(fit.difference)
    if gap < FREE_FROM * ws.floor():
        return False
    implied = []
    for i, (o, difference) in enumerate(zip(ws.observations, fit.difference, strict=True)):
        asked = levels(ws, i, difference, times(o, i))
        if not may_be_rounded(asked):
            return False
        implied += [p for p in asked.plateaus if np.any(p.annotated != 0.0)]
    free = ws.with_free((*ws.directions, *directions(ws, implied))).free
    loads = [] if free is None else [*free.rows]
    alone, beside = (_residual_gap(ws, fit, [*known, *_best_beside(problem, known)]) for known in ([], loads))
    return beside < FOLLOWS * gap and beside < CLOSED * alone


def _best_beside(problem: Problem, columns: Sequence[FloatArray]) -> list[FloatArray]:
    """Return the signatures of the effect that explains most beside ``columns`` (D,), whitened."""
    screen, known = problem.search.screen, np.column_stack(columns) if columns else None
    return screen.columns_of(max(screen.score(problem.fit.residual, known), key=lambda s: s.gain).candidate)


def _rounded(problem: Problem) -> bool:
    """Whether the loads of ``problem``, which were free, leave next to nothing and are the annotated ones before they
    were rounded.
    """
    ws, free = workspace_of(problem.comparison), rig_of(problem).recorded.wrong
    if ws.gap(problem.fit.difference) >= SIGNIFICANT * ws.floor():
        return False
    observations = ws.observations
    free_of_recording = [[p for p in free if p.recording == i] for i in range(len(observations))]
    return all(
        rounded(
            *(np.array(of).reshape(-1, 3) for of in ([p.annotated for p in listed], [p.of(o.loads) for p in listed]))
        )
        for o, listed in zip(observations, free_of_recording, strict=True)
    )


def _with_all_loads_free(
    problem: Problem, *, maybe_rounded: bool = False, had: Problem | None = None
) -> Problem | None:
    """If much remains: the search beside free loads, what hung with every load that was noted free.

    None if little remains, or if no loads, constant between changes, would leave next to nothing. ``maybe_rounded``:
    of loads in whole steps whatever other loads would leave. ``had``: this search, if it was made before.
    """
    machine, ws = rig_of(problem), workspace_of(problem.comparison)
    if ws.gap(problem.fit.difference) < FREE_FROM * ws.floor():
        return None
    wrong, observations = [], []
    for i, (o, difference) in enumerate(zip(ws.observations, problem.fit.difference, strict=True)):
        annotated = {p.first: p.annotated for p in machine.recorded.wrong if p.recording == i}
        listed = [replace(p, annotated=annotated.get(p.first, p.annotated)) for p in times(o, i)]
        asked = levels(ws, i, difference, listed)
        if not (may_be_rounded(asked) if maybe_rounded else all_free(asked, o.loads)):
            return None
        # A person knows when nothing hangs.
        implied_of_loads = [
            (p, more) for p, more in zip(asked.plateaus, asked.more, strict=True) if np.any(p.annotated != 0.0)
        ]
        loads = o.loads.copy()
        for p, more in implied_of_loads:
            loads[p.first : p.last] += more
        wrong += [p for p, _ in implied_of_loads]
        observations.append(dataclasses.replace(o, loads=loads, digest=o.digest or o.hashed()))
    if had is not None:
        return had
    problem.progress('what hung instead of what was noted')
    recorded = replace(machine.recorded, observations=tuple(observations), wrong=tuple(wrong))
    recorded = replace(recorded, stated_gap=recorded.stated_gap or problem.gap_before)
    with_free = recordings_ready.with_free(recorded, recordings_ready.beside(ws, observations, recorded.known))
    recorded = replace(recorded, fourth=fourth_reading(with_free, with_free.residual(with_free.base)[0]))
    with_free_loads = replace(
        machine, recorded=recorded, workspace=with_free, bank=SignatureBank(), proposals=proposals_of(with_free)
    )
    return solve(with_free_loads, SEARCH, problem.seed, problem.progress, problem.rng)
