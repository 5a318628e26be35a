"""Compare, localise, name, add, show: :func:`discover` runs all steps for the rig with its recordings.

The default answer is "nothing missing". A discrepancy that no effect explains is described as unknown.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.simulation.catalogue import effects_for, effects_of_rig
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.solvers import solver_from_rig
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.check.judges import noise_findings, step_findings
from psd_deflection.studies.discover import recorded as recordings_ready
from psd_deflection.studies.discover.laws.laws import FoundLaw, find_law
from psd_deflection.studies.discover.observation import Observation, check_same_psds
from psd_deflection.studies.discover.planning import Suggestion, suggest
from psd_deflection.studies.discover.problem import Machine, Problem, Progress
from psd_deflection.studies.discover.recorded import Recorded
from psd_deflection.studies.discover.result import Discovery
from psd_deflection.studies.discover.search import proposals as propose
from psd_deflection.studies.discover.search.coincidence import coincidences
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, refit
from psd_deflection.studies.discover.search.free import LoadDirection
from psd_deflection.studies.discover.search.hold_out import HeldOut
from psd_deflection.studies.discover.search.localise import Localisation, localise, regressors
from psd_deflection.studies.discover.search.remainder import Table
from psd_deflection.studies.discover.search.screen import Screen
from psd_deflection.studies.discover.search.signatures import (
    Candidate,
    Columns,
    SignatureBank,
    candidates,
    signatures_beside,
)
from psd_deflection.studies.discover.search.trials import FAR, far
from psd_deflection.studies.discover.search.weighing import UNSAID, NamedEffect, unknown_of
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup.hidden import FIRST, RIG_NUMBERS, SETUP, mistakes
from psd_deflection.studies.discover.setup.hung import directions, levels, ringing_on, times, told, unseen
from psd_deflection.studies.discover.setup.redundant import PART, STAGES, excess, fourth_reading, visible
from psd_deflection.studies.discover.setup.setup import likely_jumps, noise_of, said
from psd_deflection.studies.discover.steps import alternatives, fields_of, search, solve, weigh, where, without_one
from psd_deflection.studies.loads.plate_motion import dots_of
from psd_deflection.studies.loads.plateaus import all_free, may_be_rounded, rounded

FREED_FROM = 10.0
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
    problem = solve(machine, (searched, law, alternatives, set_up, where, noise_level), seed, progress)
    return Discovery(
        **fields_of(problem),
        setup=problem.setup,
        values=problem.values,
        known=machine.recorded.stated,
        law=problem.law if problem.unknown else None,
        rivals=problem.rivals,
        unsettled=problem.unsettled,
        moves=pose_change(workspace_of(problem.bare), problem.fit) if problem.named else (0.0, 0.0, 0.0),
        rig=known,
    )


@dataclass(frozen=True, slots=True, eq=False)
class RecordedRig(Machine):
    """The rig with its recordings. ``workspace``: these against its simulation. ``proposals``: starting values that the
    residual shows, by name. ``bank``: signatures beside nothing.
    """

    recorded: Recorded
    workspace: Workspace
    proposals: Mapping[str, Sequence[float]]
    bank: SignatureBank

    @classmethod
    def of(
        cls,
        recordings: Sequence[Observation],
        rig: Rig,
        without: Sequence[str],
        bank: SignatureBank | None,
        progress: Progress,
    ) -> RecordedRig:
        """The recordings made ready. ``bank``: see :func:`discover`."""
        check_same_psds(recordings, rig)
        progress('checking the recording')
        recorded = Recorded(tuple(recordings), rig, tuple(effects_of_rig(rig)), tuple(without))
        for step in recordings_ready.STEPS:
            recorded = step(recorded)
        progress('simulating the rig as it is described')
        recorded, workspace = recordings_ready.compared(recorded)
        # Signatures that are kept are those of recordings as they were, from rest.
        changed = recorded.mistaken or bool(workspace.nuisance) or any(d > 0.0 for d in recorded.delays)
        kept = SignatureBank() if bank is None or changed else bank
        kept.nominal(workspace)
        found = _proposals(workspace)
        if recorded.lattice is not None:
            workspace = workspace.replaced(base=(*workspace.base, recorded.lattice))
        return cls(recorded=recorded, workspace=workspace, proposals=found, bank=kept)

    def compared(self) -> Workspace:
        """The recordings against the simulation."""
        return self.workspace

    def bare(self, comparison: Comparison) -> Comparison:
        """Without the coarse steps."""
        if self.recorded.lattice is None:
            return comparison
        return comparison.replaced(base=tuple(a for a in comparison.base if a is not self.recorded.lattice))

    def seen(self, comparison: Comparison) -> float:
        """Chi-square that the coarse steps explain."""
        lattice = self.recorded.lattice
        return 0.0 if lattice is None else 2.0 * lattice_gain(workspace_of(comparison), lattice)

    def screen(self, comparison: Comparison, fit: Fit | None) -> Screen:
        """The catalogue's effects and the mistakes of the set-up, beside ``fit`` if that leaves much."""
        ws = workspace_of(comparison)
        residual = ws.residual([*ws.base, *ws.nuisance])[0] if fit is None else fit.residual
        more = mistakes(len(ws.observations), self.recorded.delays, likely_jumps(ws, residual), ws.psds)
        more = [e for e in more if e.name not in FIRST or e.name in ws.first]
        library = [e for e in effects_for(ws.psds) if e.name not in self.recorded.without and not e.lattice]
        values = self.proposals
        if fit is not None and fit.effects:
            # A large effect hides the spectral lines of a small one.
            beside = _proposals(ws, fit.effects)
            values = {name: [*seen, *(v for v in beside[name] if v not in seen)] for name, seen in values.items()}
        listed = candidates([*library, *more], self.recorded.physics, values)
        if fit is None or not far(fit):
            found = [(c, self.bank.get(c, ws)) for c in listed]
        else:
            # A large effect changes the signatures of the others.
            found = signatures_beside(ws, listed, fit)
        return Screen(ws, self._not_acquitted(ws, found, residual, fit))

    def _not_acquitted(
        self, ws: Workspace, found: list[tuple[Candidate, Columns]], residual: FloatArray, fit: Fit | None
    ) -> list[tuple[Candidate, Columns]]:
        """Without detectors and beams that would show in the fourth reading if they made much of ``residual`` (D,)."""
        reading = self.recorded.fourth if fit is None else fourth_reading(ws, residual)
        beyond, throughout = excess(ws, residual)
        if reading is None or not reading.acquits or throughout < FAR - 1.0:
            return found
        least = 2.0 * reading.allowed / (PART * beyond)
        # Mistakes of the set-up touch every channel; those of a detector are steps that the readings themselves show.
        return [
            (c, columns)
            for c, columns in found
            if c.effect.stage not in STAGES or c.effect.name in SETUP or visible(ws, columns) < least
        ]

    def look(self, comparison: Comparison, fit: Fit, null: Fit | None, rng: np.random.Generator) -> Localisation:
        """By load case, channel and frequency band, and what it follows."""
        ws = workspace_of(comparison)
        if null is None or not fit.free:
            return localise(ws, fit.residual, None, rng)
        return localise(ws, fit.residual, fit.jacobian, rng, explained=null.residual - fit.residual)

    def regressors(self, comparison: Comparison, fit: Fit) -> Table:
        """Time, loads and temperature, and the dots of the channel's own PSD."""
        return regressors(workspace_of(comparison))

    def suggest(self, comparison: Comparison, fit: Fit, equal: Sequence[Fit]) -> Suggestion | None:
        """The recording that tells them apart."""
        return suggest(workspace_of(comparison), fit, equal[: 3 if comparison.simulations < comparison.budget else 1])


def workspace_of(comparison: Comparison) -> Workspace:
    """``comparison``, which is that of the rig."""
    if not isinstance(comparison, Workspace):
        raise TypeError(f'{type(comparison).__name__}: not the rig with its recordings')
    return comparison


def rig_of(problem: Problem) -> RecordedRig:
    """The machine of ``problem``, which is the rig."""
    if not isinstance(problem.machine, RecordedRig):
        raise TypeError(f'{type(problem.machine).__name__}: not the rig with its recordings')
    return problem.machine


def hung(problem: Problem) -> Problem:
    """With the free loads as the chosen model says."""
    ws, fit = workspace_of(problem.comparison), problem.fit
    if not ws.free_loads:
        return problem
    ws, fit = _in_turns(ws, fit)
    null = refit(ws, ())
    fit = fit if fit.effects else null
    found = problem.search.at(ws)
    found.dropped = {}
    p, delta_bic, delta_chi2 = found.weigh(null, fit)
    others = [found.alternatives(null, fit, i, delta_chi2[i]) for i in range(len(fit.effects))]
    result = replace(
        problem.result, null=null, fit=fit, p=p, delta_bic=delta_bic, delta_chi2=delta_chi2, alternatives=others
    )
    return replace(problem, search=found, result=result, fit=fit, null=null)


def _in_turns(ws: Workspace, fit: Fit) -> tuple[Workspace, Fit]:
    """The free loads as ``fit`` asks for, and the sizes of its effects beside them, in turns."""
    gap = ws.gap(fit.difference)
    for _ in range(MOST_SETTLED):
        # Loads and times are found to first order: at the sizes as they are, then the sizes beside them.
        turned, better = _settled(ws, fit)
        if fit.effects:
            turned, better = _settled(turned, refit(turned, fit.effects, 6))
        left, gap = gap, turned.gap(better.difference)
        if gap > left:
            break
        ws, fit = turned, better
        if gap > SETTLED * left or gap < AT_FLOOR * ws.floor():
            break
    return ws, fit


def _settled(ws: Workspace, fit: Fit) -> tuple[Workspace, Fit]:
    """The free loads as ``fit`` asks for, and what it leaves then: never more than before."""
    for _ in range(TURNS):
        turned = ws.settled_beside(fit.difference, fit.whole)
        turned = ws.settled(fit.difference) if turned is ws else turned
        residual, difference = turned.residual([*turned.base, *fit.whole])
        if turned.gap(difference) > ws.gap(fit.difference):
            # Beside an effect that is far from linear a step may lead away.
            break
        ws, fit = turned, replace(fit, residual=residual, difference=difference, chi2=turned.loss(residual))
    return ws, fit


def settled(problem: Problem) -> Problem:
    """With the free loads as the effects ask for that hold, if not all that were searched do."""
    ws = workspace_of(problem.comparison)
    if not ws.free_loads or problem.fit is problem.result.fit:
        return problem
    ws, fit = _settled(ws, problem.fit)
    null = refit(ws, ())
    return replace(problem, search=problem.search.at(ws), fit=fit if fit.effects else null, null=null)


SEARCH = (search, hung, weigh, settled)
"""The search with its verdict, of the loads as they are."""


def searched(problem: Problem) -> Problem:
    """The search with its verdict: with the loads as noted, or free if they were noted wrong. If much remains, with the
    ringing free that outlasts what is left out.
    """
    problem = _searched(problem)
    ws, effects = workspace_of(problem.comparison), problem.result.fit.effects
    if ws.gap(problem.fit.difference) < UNSAID * ws.floor():
        return problem
    ringing = [d for i, o in enumerate(ws.observations) for d in ringing_on(o, i, [*ws.base, *effects])]
    if not ringing:
        return problem
    problem.progress('how the link rang on after what is left out')
    # What rings on is all that is seen of loads that were hung in what is left out.
    seen = [d for d in ws.directions if not unseen(ws, d)]
    free = ws.freed((*seen, *ringing), effects)
    begun = refit(free, effects, 12)
    # Else the noise beside it would be that of a link that does not ring as it did.
    free, begun = _in_turns(free, begun)
    other = replace(problem, search=problem.search.at(free), fit=begun, null=refit(free, ()))
    for step in (partial(search, begun=begun), *SEARCH[1:]):
        other = step(other)
    return other if other.comparison.gap(other.fit.difference) < UNSAID * ws.floor() else problem


def _searched(problem: Problem) -> Problem:
    machine = rig_of(problem)
    if machine.recorded.fourth is not None and machine.recorded.fourth.acquits and _follows_nothing(problem):
        # No detector is at fault, and nothing that is known: the loads are asked before the search spends on stand-ins.
        freed = _freed(problem)
        if freed is not None and freed.comparison.gap(freed.fit.difference) < UNSAID * freed.comparison.floor():
            return _as_noted(problem, freed)
    asked = _freed(problem, maybe_rounded=True) if _rounded_beside_one(problem) else None
    if asked is not None and _rounded(asked):
        return _as_noted(problem, asked)
    for step in SEARCH:
        problem = step(problem)
    freed = _freed(problem, had=asked)
    before = problem.comparison.gap(problem.fit.difference)
    if freed is not None and freed.comparison.gap(freed.fit.difference) < CLOSED * before:
        return _as_noted(problem, freed)
    # A detector at fault may move the dots by more than rounded loads move the plate.
    freed = _freed(problem, maybe_rounded=True) if freed is None and asked is None else None
    return _as_noted(problem, freed) if freed is not None and _rounded(freed) else problem


def _as_noted(problem: Problem, freed: Problem) -> Problem:
    """``freed``; or the search as noted, from the effects that were found beside free loads, if these leave no more."""
    ws, effects = problem.comparison, freed.fit.effects
    begun = refit(ws, effects, 12) if effects else problem.null
    numbers = sum(isinstance(d, LoadDirection) for d in workspace_of(freed.comparison).directions)
    if begun.chi2 - freed.fit.chi2 > problem.search.penalty * numbers:
        return freed
    problem.progress('as noted')
    for step in (partial(search, begun=begun), *SEARCH[1:]):
        problem = step(problem)
    return problem


def _follows_nothing(problem: Problem) -> bool:
    """Whether some effects leave a good part of the gap, to first order: no simulation is made."""
    ws, fit = problem.comparison, problem.fit
    gap = ws.gap(fit.difference)
    if gap < FREED_FROM * ws.floor():
        return False
    columns = [fit.jacobian[:, j] for j in range(len(fit.free))]
    for _ in range(FOLLOWED):
        known = np.column_stack(columns) if columns else None
        best = max(problem.search.screen.score(fit.residual, known), key=lambda s: s.gain, default=None)
        if best is None:
            break
        columns += problem.search.screen.columns_of(best.candidate)
    return not columns or _left(ws, fit, columns) > max(FOLLOWS * gap, FREED_FROM * ws.floor())


def _left(ws: Comparison, fit: Fit, columns: Sequence[FloatArray]) -> float:
    """The gap that ``columns`` (D,), whitened, leave of ``fit``, to first order."""
    moved = np.column_stack(columns)
    left = fit.residual - moved @ np.linalg.lstsq(moved, fit.residual, rcond=1e-9)[0]
    return ws.gap([d + c for d, c in zip(fit.difference, ws.unwhitened(left - fit.residual), strict=True)])


def _rounded_beside_one(problem: Problem) -> bool:
    """Whether one effect leaves little of the gap beside loads that may be rounded, and much alone, to first order."""
    ws, fit = workspace_of(problem.comparison), problem.fit
    gap = ws.gap(fit.difference)
    if gap < FREED_FROM * ws.floor():
        return False
    hung = []
    for i, (o, difference) in enumerate(zip(ws.observations, fit.difference, strict=True)):
        asked = levels(ws, i, difference, times(o, i))
        if not may_be_rounded(asked):
            return False
        hung += [p for p in asked.plateaus if np.any(p.noted != 0.0)]
    free = ws.freed((*ws.directions, *directions(ws, hung))).free
    loads = [] if free is None else [*free.rows]
    alone, beside = (_left(ws, fit, [*known, *_best_beside(problem, known)]) for known in ([], loads))
    return beside < FOLLOWS * gap and beside < CLOSED * alone


def _best_beside(problem: Problem, columns: Sequence[FloatArray]) -> list[FloatArray]:
    """The signatures of the effect that explains most beside ``columns`` (D,), whitened."""
    screen, known = problem.search.screen, np.column_stack(columns) if columns else None
    return screen.columns_of(max(screen.score(problem.fit.residual, known), key=lambda s: s.gain).candidate)


def _rounded(problem: Problem) -> bool:
    """Whether the loads of ``problem``, which were free, leave next to nothing and are the noted ones before they were
    rounded.
    """
    ws, free = workspace_of(problem.comparison), rig_of(problem).recorded.wrong
    if ws.gap(problem.fit.difference) >= UNSAID * ws.floor():
        return False
    observations = ws.observations
    own = [[p for p in free if p.recording == i] for i in range(len(observations))]
    return all(
        rounded(*(np.array(of).reshape(-1, 3) for of in ([p.noted for p in listed], [p.of(o.loads) for p in listed])))
        for o, listed in zip(observations, own, strict=True)
    )


def _freed(problem: Problem, *, maybe_rounded: bool = False, had: Problem | None = None) -> Problem | None:
    """If much remains: the search beside free loads, what hung with every load that was noted free.

    None if little remains, or if no loads, constant between changes, would leave next to nothing. ``maybe_rounded``:
    of loads in whole steps whatever other loads would leave. ``had``: this search, if it was made before.
    """
    machine, ws = rig_of(problem), workspace_of(problem.comparison)
    if ws.gap(problem.fit.difference) < FREED_FROM * ws.floor():
        return None
    wrong, observations = [], []
    for i, (o, difference) in enumerate(zip(ws.observations, problem.fit.difference, strict=True)):
        noted = {p.first: p.noted for p in machine.recorded.wrong if p.recording == i}
        listed = [replace(p, noted=noted.get(p.first, p.noted)) for p in times(o, i)]
        asked = levels(ws, i, difference, listed)
        if not (may_be_rounded(asked) if maybe_rounded else all_free(asked, o.loads)):
            return None
        # A person knows when nothing hangs.
        own = [(p, more) for p, more in zip(asked.plateaus, asked.more, strict=True) if np.any(p.noted != 0.0)]
        loads = o.loads.copy()
        for p, more in own:
            loads[p.first : p.last] += more
        wrong += [p for p, _ in own]
        observations.append(dataclasses.replace(o, loads=loads, digest=o.digest or o.hashed()))
    if had is not None:
        return had
    problem.progress('what hung instead of what was noted')
    recorded = replace(machine.recorded, observations=tuple(observations), wrong=tuple(wrong))
    recorded = replace(recorded, stated_gap=recorded.stated_gap or problem.gap_before)
    freed = recordings_ready.freed(recorded, recordings_ready.beside(ws, observations, recorded.known))
    recorded = replace(recorded, fourth=fourth_reading(freed, freed.residual(freed.base)[0]))
    other = replace(machine, recorded=recorded, workspace=freed, bank=SignatureBank(), proposals=_proposals(freed))
    return solve(other, SEARCH, problem.seed, problem.progress, problem.rng)


def law(problem: Problem) -> Problem:
    """A law for what remains, and the fit without the effects that only stood in for it."""
    ws, fit = workspace_of(problem.comparison), problem.fit
    # Coarse steps cause noise that varies with the signal, which is no law.
    if rig_of(problem).recorded.lattice is not None:
        return problem
    much = ws.gap(fit.difference) > UNSAID * ws.floor()
    if not (unknown_of(problem.left, 1.0) or much or coincidences(fit, ws.physics)):
        return problem
    found = find_law(ws, problem.null, fit, problem.search.penalty, problem.left.excess, problem.rng, problem.progress)
    if found is None:
        return problem
    problem = _beside(replace(problem, law=found), found)
    return replace(problem, left=problem.machine.look(ws, problem.fit, problem.result.null, problem.rng))


def _beside(problem: Problem, found: FoundLaw) -> Problem:
    kept = {(a.effect.name, a.choices) for a in found.beside}
    for i in reversed(range(len(problem.fit.effects))):
        active = problem.fit.effects[i]
        if (active.effect.name, active.choices) not in kept:
            problem = without_one(problem, i, 'only stood in for the law')
    return problem


def set_up(problem: Problem) -> Problem:
    """What is wrong with the set-up, beside the named effects that are physics; and the coarse steps."""
    machine, ws = rig_of(problem), workspace_of(problem.comparison)
    setup = [*machine.recorded.late_loads(ws), *machine.recorded.findings]
    values = dict(machine.recorded.values)
    for i, effect in enumerate(problem.named):
        if effect.active.effect.name in SETUP:
            more, lines = said(ws, problem.fit, i, effect.delta_bic)
            setup += [dataclasses.replace(f, equivalent=effect.equivalent) for f in more]
            values |= lines
    setup += told(ws, machine.recorded.wrong)
    named = [n for n in problem.named if n.name not in SETUP or n.name in RIG_NUMBERS]
    if machine.recorded.lattice is not None and not machine.recorded.lattice_stated:
        lattice = machine.recorded.lattice
        named.append(_named_lattice(ws, lattice))
        step = float(lattice.values[lattice.effect.lattice])
        # The effect stands for the line: with both, the steps would be counted twice.
        steps = np.full(3 * ws.psds, step)
        finer = not lattice.effect.steps_sums(lattice.values)
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
    """Whether the noise is the rig file's. What is unknown may move faster than noise can be told from it."""
    if problem.unknown or rig_of(problem).recorded.lattice is not None:
        return problem
    ws = workspace_of(problem.comparison)
    more, _ = noise_findings(ws.observations[0].rig, noise_of(ws))
    return replace(problem, setup=(*problem.setup, *more))


def _proposals(workspace: Workspace, effects: Sequence[ActiveEffect] = ()) -> dict[str, list[float]]:
    raw = workspace.raw_residual([*workspace.base, *effects])
    observations = workspace.observations
    noise = float(observations[0].rig.noises.max())
    sigmas, periods = [n.sigma for n in workspace.noise], [o.period for o in observations]
    peaks = propose.spectral_peaks(raw, sigmas, periods)
    return {
        'spectral': peaks,
        'line': propose.persistent(peaks, raw, sigmas, periods),
        'highest': propose.highest_voltages(observations, True, noise),
        'highest_dots': propose.highest_voltages(observations, False, noise),
    }


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


def lattice_gain(workspace: Workspace, lattice: ActiveEffect) -> float:
    """Log-likelihood of all readings lying on the lattice: by chance each does so with probability LSB/step."""
    lsb = workspace.observations[0].rig.converter.volts_per_count
    return workspace.size * workspace.fine[0] * float(np.log(max(lattice.values[lattice.effect.lattice] / lsb, 1.0)))


def _named_lattice(workspace: Workspace, lattice: ActiveEffect) -> NamedEffect:
    """The named effect of coarse steps, which the readings themselves show."""
    gain = lattice_gain(workspace, lattice)
    sd = min(s.sd for o in workspace.observations if (s := propose.coarse_step(o)) is not None)
    return NamedEffect(
        active=lattice,
        sd={lattice.effect.lattice: sd},
        p=0.0,
        delta_bic=2.0 * gain,
        heldout=HeldOut(gain, float(np.sqrt(2.0 * gain))),
        equivalent=(),
        rivals=(),
        alternatives=(),
        suggestion=None,
    )
