# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compare, localise, name, add, show: :func:`discover` runs all steps for the rig with its recordings.

The default answer is "nothing missing". A discrepancy that no effect explains is described as unknown.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.solvers import solver_from_rig
from psd_deflection.rig.config import Rig
from psd_deflection.studies.check.shared_findings import noise_findings, step_findings
from psd_deflection.studies.discover.free_loads import searched
from psd_deflection.studies.discover.laws.laws import FoundLaw, find_law
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.problem import Problem, Progress
from psd_deflection.studies.discover.recorded_rig import RecordedRig, rig_of, value_grid_gain, workspace_of
from psd_deflection.studies.discover.result import Discovery
from psd_deflection.studies.discover.search import proposals as propose
from psd_deflection.studies.discover.search.coincidence import coincidences
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.hold_out import HeldOut
from psd_deflection.studies.discover.search.signatures import SignatureBank
from psd_deflection.studies.discover.search.weighing import SIGNIFICANT, NamedEffect, unknown_of
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup.applied import wrong_load_findings
from psd_deflection.studies.discover.setup.hidden import RIG_NUMBERS, SETUP
from psd_deflection.studies.discover.setup.setup import finding_of_effect, noise_of
from psd_deflection.studies.discover.steps import alternatives, fields_of, predict, solve, where, without_effect
from psd_deflection.studies.loads.plate_motion import dots_of


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
        law=problem.law if problem.unknown else None,
        alternative_fits=problem.alternative_fits,
        unsettled=problem.unsettled,
        moves=pose_change(workspace_of(problem.bare), problem.fit) if problem.named else (0.0, 0.0, 0.0),
        rig=known,
    )


def law(problem: Problem) -> Problem:
    """Return a law for what remains, and the fit without the effects that only stood in for it."""
    ws, fit = workspace_of(problem.comparison), problem.fit
    # Coarse steps cause noise that varies with the signal, which is no law.
    if rig_of(problem).recorded.value_grid is not None:
        return problem
    much = ws.gap(fit.difference) > SIGNIFICANT * ws.floor()
    if not (unknown_of(problem.residual, 1.0) or much or coincidences(fit, ws.physics)):
        return problem
    found_law = find_law(
        ws, problem.null, fit, problem.search.penalty, problem.residual.excess, problem.rng, problem.progress
    )
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
        problem,
        named=tuple(named),
        setup=tuple(setup),
        values=values,
        stated_gap=machine.recorded.stated_gap,
    )


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
    gain = value_grid_gain(workspace, value_grid)
    sd = min(s.sd for o in workspace.observations if (s := propose.coarse_step(o)) is not None)
    return NamedEffect(
        active=value_grid,
        sd={value_grid.effect.value_grid: sd},
        p=0.0,
        delta_bic=2.0 * gain,
        heldout=HeldOut(gain, float(np.sqrt(2.0 * gain))),
        equivalent=(),
        fitted_alternatives=(),
        alternatives=(),
        suggestion=None,
    )
