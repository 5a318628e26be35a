# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compare, localise, name, add, show: :func:`discover` runs all steps for the rig with its recordings.

The default answer is "nothing missing". A discrepancy that no effect explains is described as unknown.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.solvers import solver_from_rig
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.check.shared_findings import noise_findings, step_findings
from psd_deflection.studies.discover import recorded as recordings_ready
from psd_deflection.studies.discover.applied import directions, levels, ringing_on, times, unseen, wrong_load_findings
from psd_deflection.studies.discover.hidden import RIG_NUMBERS, SETUP, Free, LoadDirection
from psd_deflection.studies.discover.laws import FoundLaw, find_law
from psd_deflection.studies.discover.problem import Problem, Progress
from psd_deflection.studies.discover.recorded import Recorded
from psd_deflection.studies.discover.recorded_rig import (
    RecordedRig,
    proposals_of,
    rig_of,
    value_grid_gain,
    workspace_of,
)
from psd_deflection.studies.discover.redundant import fourth_reading
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.discover.search import proposals as propose
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, HeldOut, refit
from psd_deflection.studies.discover.search.screen import SignatureBank
from psd_deflection.studies.discover.search.weighing import NamedEffect, coincidences, unknown_of
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import finding_of_effect, noise_of
from psd_deflection.studies.discover.steps import (
    alternatives,
    fields_of,
    predict,
    search,
    solve,
    weigh,
    where,
    without_effect,
)
from psd_deflection.studies.discover.thresholds import MANY_EFFECTS, ROUNDS, SIGNIFICANT
from psd_deflection.studies.loads.alignment import SKEW
from psd_deflection.studies.loads.holds import all_free, may_be_rounded, rounded
from psd_deflection.studies.loads.plate_motion import dots_of
from psd_deflection.studies.loads.thresholds import MANYFOLD, MINOR, PART, SLIGHT


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
    for _ in range(MANY_EFFECTS):
        # Loads and times are found to first order: at the sizes as they are, then the sizes beside them.
        next_ws, better = _refitted(ws, fit)
        if fit.effects:
            next_ws, better = _refitted(next_ws, refit(next_ws, fit.effects, 6))
        previous_gap, gap = gap, next_ws.gap(better.difference)
        if gap > previous_gap:
            break
        ws, fit = next_ws, better
        if gap > (1.0 - SLIGHT) * previous_gap or gap < (1.0 + SLIGHT) * ws.floor():
            break
    return ws, fit


def _refitted(ws: Workspace, fit: Fit) -> tuple[Workspace, Fit]:
    """Return the free loads as ``fit`` asks for, and what it leaves then: never more than before."""
    for _ in range(ROUNDS):
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
    if with_free is not None and with_free.comparison.gap(with_free.fit.difference) < PART * before:
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
    if gap < MANYFOLD * ws.floor():
        return False
    columns = [fit.jacobian[:, j] for j in range(len(fit.free))]
    for _ in range(MANY_EFFECTS):
        known = np.column_stack(columns) if columns else None
        best = max(problem.search.screen.score(fit.residual, known), key=lambda s: s.gain, default=None)
        if best is None:
            break
        columns += problem.search.screen.columns_of(best.candidate)
    return not columns or _residual_gap(ws, fit, columns) > max(MINOR * gap, MANYFOLD * ws.floor())


def _residual_gap(ws: Comparison, fit: Fit, columns: Sequence[FloatArray], free: Free | None = None) -> float:
    """Return the gap that ``columns`` (D,), whitened, and what is ``free`` leave of ``fit``, to first order."""
    start, *beside = (v if free is None else free.beside(v) for v in (fit.residual, *columns))
    moved = np.column_stack(beside)
    residual = start - moved @ np.linalg.lstsq(moved, start, rcond=1e-9)[0]
    return ws.gap([d + c for d, c in zip(fit.difference, ws.unwhitened(residual - fit.residual), strict=True)])


def _rounded_beside_effect(problem: Problem) -> bool:
    """Whether one effect leaves little of the gap beside loads that may be rounded, and much alone, to first order."""
    ws, fit = workspace_of(problem.comparison), problem.fit
    gap = ws.gap(fit.difference)
    if gap < MANYFOLD * ws.floor():
        return False
    implied = []
    for i, (o, difference) in enumerate(zip(ws.observations, fit.difference, strict=True)):
        asked = levels(ws, i, difference, times(o, i))
        if not may_be_rounded(asked):
            return False
        implied += [p for p in asked.holds if np.any(p.annotated != 0.0)]
    alone = _residual_gap(ws, fit, _best_beside(problem, None))
    # Nothing leaves less than the noise does.
    if PART * alone <= ws.floor():
        return False
    free = ws.with_free((*ws.directions, *directions(ws, implied))).free
    beside = _residual_gap(ws, fit, _best_beside(problem, free), free)
    return beside < MINOR * gap and beside < PART * alone


def _best_beside(problem: Problem, free: Free | None) -> list[FloatArray]:
    """Return the signatures of the effect that explains most beside what is ``free``, whitened."""
    screen = problem.search.screen
    return screen.columns_of(max(screen.score(problem.fit.residual, free), key=lambda s: s.gain).candidate)


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
    if ws.gap(problem.fit.difference) < MANYFOLD * ws.floor():
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
            (p, more) for p, more in zip(asked.holds, asked.more, strict=True) if np.any(p.annotated != 0.0)
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


def discover(
    recordings: Sequence[Observation],
    rig: Rig | None = None,
    *,
    seed: int = 0,
    without: Sequence[str] = (),
    bank: SignatureBank | None = None,
    progress: Progress = lambda _: None,
) -> Discovery:
    """Name the effects that the simulation of ``rig`` lacks to explain ``recordings``.

    Each recording carries its rig with its own overrides; ``rig`` is the common one (that of the
    first by default), whose effects count as known. ``without``: effects to leave out of the
    library. ``bank``: signatures of the same design from an earlier call. Raises ConfigError if the
    rig's effects are malformed, RecordingError if the recordings are not of as many PSDs as the rig has.
    """
    known = recordings[0].rig if rig is None else rig
    machine = RecordedRig.of(recordings, known, without, bank, progress)
    problem = solve(machine, (searched, law, alternatives, set_up, where, predict, noise_level), seed, progress)
    return Discovery(
        **fields_of(problem),
        setup=problem.setup,
        values=problem.values,
        known=machine.recorded.stated,
        late=tuple(late.words(machine.recorded.observations[0].name) for late in machine.recorded.late),
        law=problem.law if problem.unknown else None,
        alternative_fits=problem.alternative_fits,
        unsettled=problem.unsettled,
        moves=pose_change(workspace_of(problem.bare), problem.fit) if problem.named else (0.0, 0.0, 0.0),
        rig=known,
        recordings=tuple(recordings),
        search_again=partial(discover, rig=known, seed=seed, without=without),
    )


def law(problem: Problem) -> Problem:
    """Return a law for what remains, and the fit without the effects that only stood in for it."""
    ws, fit = workspace_of(problem.comparison), problem.fit
    # Coarse steps cause noise that varies with the signal, which is no law.
    if rig_of(problem).recorded.value_grid is not None:
        return problem
    large_gap = ws.gap(fit.difference) > SIGNIFICANT * ws.floor()
    if not (unknown_of(problem.residual, 1.0) or large_gap or coincidences(fit, ws.physics)):
        return problem
    found_law = find_law(ws, problem.null, fit, problem.search.penalty, problem.residual.excess, problem.progress)
    if found_law is None:
        return problem
    problem = _beside(replace(problem, law=found_law), found_law)
    return replace(problem, residual=problem.machine.look(ws, problem.fit, problem.result.null, problem.rng))


def _beside(problem: Problem, found_law: FoundLaw) -> Problem:
    known = {(a.effect.name, a.choices) for a in found_law.beside}
    for i in reversed(range(len(problem.fit.effects))):
        active = problem.fit.effects[i]
        if (active.effect.name, active.choices) not in known:
            problem = without_effect(problem, i, 'only stood in for the law')
    return problem


def set_up(problem: Problem) -> Problem:
    """What is wrong with the set-up, beside the named effects that are physics; and the coarse steps."""
    machine, ws = rig_of(problem), workspace_of(problem.comparison)
    setup = [*machine.recorded.delayed_loads(ws), *machine.recorded.findings]
    values = dict(machine.recorded.values)
    for i, effect in enumerate(problem.named):
        if effect.active.effect.name in SETUP:
            more, lines = finding_of_effect(ws, problem.fit, i, effect.delta_bic)
            setup += [dataclasses.replace(f, equivalent=effect.equivalent) for f in more]
            values |= lines
    setup += wrong_load_findings(ws, machine.recorded.wrong)
    named = [n for n in problem.named if n.name not in SETUP or n.name in RIG_NUMBERS]
    named = _clocks(machine.recorded, named)
    if machine.recorded.value_grid is not None and not machine.recorded.value_grid_stated:
        value_grid = machine.recorded.value_grid
        named.append(_named_value_grid(ws, value_grid))
        step = float(value_grid.values[value_grid.effect.value_grid])
        # The effect stands for the line: with both, the steps would be counted twice.
        steps = np.full(3 * ws.psds, step)
        finer = not value_grid.effect.steps_sums(value_grid.values)
        if finer:
            steps[2::3] = 0.0
        setup += step_findings(ws.observations[0].rig, steps, finer=finer)[0]
    return replace(
        problem, named=tuple(named), setup=tuple(setup), values=values, stated_gap=machine.recorded.stated_gap
    )


def _clocks(recorded: Recorded, named: Sequence[NamedEffect]) -> list[NamedEffect]:
    """Return ``named``, which the search found beside readings moved by whole samples, with the PSDs that are late."""
    beside = {n.active.values['psd']: n for n in named if n.name == SKEW}
    period = recorded.observations[0].period
    effects = []
    for late in recorded.late:
        more = beside.pop(late.psd, None)
        delay = late.seconds if more is None else late.rows * period + more.active.values['delay']
        active = ActiveEffect(catalogue()[SKEW], {'psd': float(late.psd), 'delay': delay})
        sd = {'delay': late.sd} if more is None else more.sd
        effects.append(_named_by_readings(active, sd, 0.5 * late.evidence))
    return [*effects, *(n for n in named if n.name != SKEW or n.active.values['psd'] in beside)]


def noise_level(problem: Problem) -> Problem:
    """Return whether the noise is the rig file's. What is unknown may move faster than noise can be distinguished from
    it.
    """
    if problem.unknown or rig_of(problem).recorded.value_grid is not None:
        return problem
    ws = workspace_of(problem.comparison)
    more, _ = noise_findings(ws.observations[0].rig, noise_of(ws))
    return replace(problem, setup=(*problem.setup, *more))


def pose_change(ws: Workspace, fit: Fit) -> tuple[float, float, float]:
    """By how much at most the effects of ``fit`` that the daemon corrects for move estimates: dX m, dY m, theta rad.

    An effect on the load or the link moves the tip, and an estimate says rightly where it is.
    """
    moving = [a for a in fit.effects if a.effect.corrected != 'reading' or a.effect.name in SETUP]
    if len(moving) == len(fit.effects):
        return (0.0, 0.0, 0.0)
    tables = ws.simulate([*ws.base, *fit.effects]), ws.simulate([*ws.base, *moving])
    most = np.zeros(3)
    # In fine means: an estimate is of a moment, and the mean of a block in which the link swings is of none.
    for o, count, *volts in zip(ws.observations, ws.count, *tables, strict=True):
        dots, nominal = (dots_of(o.rig, v) for v in volts)
        solver = solver_from_rig(o.rig.estimator.solver, o.rig)
        there = (count[ws.rows] > 0.0).all(axis=0)
        variances = dot_noise_variances(o.rig) / o.rig.estimator.block_size
        poses = [solver.solve_many(d[:, there].T, variances).pose for d in (dots, nominal)]
        change = np.abs(poses[0] - poses[1])
        if np.isfinite(change).any():
            most = np.fmax(most, np.nanmax(change, axis=0))
    return (float(most[0]), float(most[1]), float(most[2]))


def _named_value_grid(workspace: Workspace, value_grid: ActiveEffect) -> NamedEffect:
    """Return the named effect of coarse steps, which the readings themselves show."""
    sd = min(s.sd for o in workspace.observations if (s := propose.coarse_step(o)) is not None)
    return _named_by_readings(value_grid, {value_grid.effect.value_grid: sd}, value_grid_gain(workspace, value_grid))


def _named_by_readings(active: ActiveEffect, sd: Mapping[str, float], gain: float) -> NamedEffect:
    """Return an effect that the readings show without any search, by a log-likelihood of ``gain``."""
    return NamedEffect(
        active=active,
        sd=sd,
        p=0.0,
        delta_bic=2.0 * gain,
        heldout=HeldOut(gain, float(np.sqrt(2.0 * gain))),
        equivalent=(),
        fitted_alternatives=(),
        alternatives=(),
        suggestion=None,
    )
