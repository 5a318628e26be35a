"""Compare, localise, name, add, show: :func:`discover` runs all steps for the rig.

The default answer is "nothing missing". A discrepancy that no effect explains is described as unknown.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.simulation.catalogue import catalogue, effects_of_rig
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.solvers import solver_from_rig
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover.laws.laws import FoundLaw, find_law
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.planning import suggest
from psd_deflection.studies.discover.result import Discovery
from psd_deflection.studies.discover.search import proposals as propose
from psd_deflection.studies.discover.search.coincidence import coincidences
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, refit
from psd_deflection.studies.discover.search.hold_out import HeldOut, heldout_tables
from psd_deflection.studies.discover.search.localise import Localisation, localise
from psd_deflection.studies.discover.search.screen import Screen
from psd_deflection.studies.discover.search.search import BIC_ACCEPT, Search, SearchResult, far
from psd_deflection.studies.discover.search.signatures import SignatureBank, candidates, signatures_beside
from psd_deflection.studies.discover.search.weighing import (
    UNSAID,
    NamedEffect,
    accept,
    credible,
    heldout_per_channel_of,
    named_effects,
    per_channel_of,
    tied,
    unknown_of,
    unsaid,
    waterfall_of,
    without_one,
)
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup.cleaning import clean, time_loads
from psd_deflection.studies.discover.setup.hidden import FIRST, SETUP, beginning, mistakes
from psd_deflection.studies.discover.setup.setup import likely_delays, likely_jumps, noise_finding, said, wire


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


def discover(
    recordings: Sequence[Observation],
    rig: Rig | None = None,
    *,
    seed: int = 0,
    without: Sequence[str] = (),
    bank: SignatureBank | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Discovery:
    """Name the effects that the simulation of ``rig`` lacks to explain ``recordings``.

    Each recording carries its rig with its own overrides; ``rig`` is the common one (that of the
    first by default), whose effects count as known. ``without``: effects to leave out of the
    library. ``bank``: signatures of the same design from an earlier call. Raises ConfigError if the
    rig's effects are malformed.
    """
    rig = recordings[0].rig if rig is None else rig
    given = rig
    rates = {o.rig.converter.sample_rate_hz for o in recordings if o.stated_rate_hz}
    lines: dict[str, object] = {'converter.sample_rate_hz': rates.pop()} if len(rates) == 1 else {}
    rng = np.random.default_rng(seed)
    base = effects_of_rig(rig)
    progress('checking the recording')
    cleaned = [clean(o, base) for o in recordings]
    timed = [time_loads(o) for o, _ in cleaned]
    late = [f for _, found in timed for f in found]
    observations, findings, rewired = wire([o for o, _ in timed], base)
    before = 0.0
    if findings or late:
        stated = Workspace([o for o, _ in cleaned], base)
        before = stated.gap(stated.residual(base)[1])
    findings = [*late, *(f for _, found in cleaned for f in found), *findings]
    lines.update(rewired)
    if lines:
        rig = replace_values(rig, lines)
    physics = Physics.of(rig)
    of_lattice = [e for e in catalogue().values() if e.lattice]
    lattice = _lattice(observations, physics, base, [e for e in of_lattice if e.name not in without])
    if lattice is not None:
        observations = [_snapped(o, lattice.values[lattice.effect.lattice]) for o in observations]
    progress('simulating the rig as it is described')
    workspace = Workspace(observations, base)
    delays = likely_delays(workspace)
    if any(d > 0.0 for d in delays):
        # The loads of the last moments are noted after the end.
        observations = [_without_end(o, max(delays)) for o in observations]
        workspace = Workspace(observations, base)
    workspace.nuisance = tuple(_beginnings(workspace))
    # Signatures that are kept are those of recordings as they were, from rest.
    changed = bool(findings) or bool(workspace.nuisance) or any(d > 0.0 for d in delays)
    kept = SignatureBank() if bank is None or changed else bank
    kept.nominal(workspace)
    found = _proposals(workspace)
    if lattice is not None:
        workspace.base = (*workspace.base, lattice)

    looked_for = set(FIRST)

    def screen(_: Comparison, current: Fit | None) -> Screen:
        ws = workspace
        residual = ws.residual([*ws.base, *ws.nuisance])[0] if current is None else current.residual
        more = mistakes(len(observations), delays, likely_jumps(ws, residual))
        more = [e for e in more if e.name not in FIRST or e.name in looked_for]
        library = [e for e in catalogue().values() if e.name not in without and not e.lattice]
        values: Mapping[str, list[float]] = found
        if current is not None and current.effects:
            # A large effect hides the spectral lines of a small one.
            beside = _proposals(workspace, current.effects)
            values = {name: [*seen, *(v for v in beside[name] if v not in seen)] for name, seen in found.items()}
        listed = candidates([*library, *more], physics, values)
        if current is None or not far(current):
            return Screen(ws, [(c, kept.get(c, ws)) for c in listed])
        # A large effect changes the signatures of the others.
        return Screen(ws, signatures_beside(ws, listed, current))

    progress('signatures of every effect')
    search = Search(workspace, screen, progress)
    result = search.run()
    names = {a.effect.name for a in result.fit.effects}
    if names & FIRST and names - SETUP:
        # A mistake that needs an effect beside it must be much better than effects alone.
        looked_for.clear()
        noise = workspace.noise
        other = Search(workspace, screen, progress)
        plain = other.run()
        if plain.fit.chi2 + other.penalty * plain.fit.parameters < (
            result.fit.chi2 + search.penalty * result.fit.parameters + BIC_ACCEPT
        ):
            search, result = other, plain
        else:
            workspace.noise = noise
    workspace.nuisance = result.fit.nuisance
    progress('weighing')
    heldout, fit = accept(search, result, rng)
    seen = 0.0 if lattice is None else 2.0 * _lattice_gain(workspace, lattice)

    def look(fit: Fit, null: Fit) -> Localisation:
        explained = null.residual - fit.residual if fit.free else None
        return localise(workspace, fit.residual, fit.jacobian if fit.free else None, rng, explained=explained)

    fit, heldout, left = credible(search, result, fit, heldout, seen, look)
    if lattice is not None:
        workspace.base = tuple(a for a in workspace.base if a is not lattice)
    checked = _Checked(findings, lines, tuple(base), before, given)
    return _answer(workspace, search, result, fit, heldout, left, lattice, rng, seed, progress, checked)


def _beginnings(workspace: Workspace) -> list[ActiveEffect]:
    """How the link moved when the loads of a recording became known, if it was not unloaded and at rest."""
    starts = [o.unknown_load[0] * o.period for o in workspace.observations]
    effect = beginning(starts)
    out = []
    for o, choice in zip(workspace.observations, effect.variants(), strict=True):
        if o.unknown_load[0] or np.any(o.loads[0] != 0.0):
            out.append(ActiveEffect(effect, effect.off_values(workspace.physics, choice)))
    return list(refit(workspace, out, iterations=3).effects) if out else []


@dataclass(frozen=True, slots=True, eq=False)
class _Checked:
    """What the check of the recordings found, the lines for the rig file, the effects that the rig file has, and the
    gap before the wiring was put right, m, 0 if that was right.
    """

    findings: Sequence[Finding]
    lines: Mapping[str, object]
    known: tuple[ActiveEffect, ...]
    gap: float
    rig: Rig


def _lattice(
    observations: Sequence[Observation], physics: Physics, base: Sequence[ActiveEffect], effects: Sequence[Effect]
) -> ActiveEffect | None:
    """The first of ``effects`` with the step that the readings themselves show, if there is one."""
    if not effects or any(a.effect.lattice for a in base):
        return None
    found = [propose.coarse_step(o) for o in observations]
    steps = [s for s in found if s is not None]
    if len(steps) < len(found):
        return None
    effect = effects[0]
    values = effect.off_values(physics, next(effect.variants()))
    # The recording with the widest range of values determines it best.
    return ActiveEffect(effect, {**values, effect.lattice: min(steps, key=lambda s: s[1])[0]})


def _snapped(o: Observation, step: float) -> Observation:
    """The readings as multiples of ``step``, V: the converter has rounded each of them once more."""
    return dataclasses.replace(o, volts=np.rint(o.volts / step) * step, digest=o.digest or o.hashed())


def _without_end(o: Observation, seconds: float) -> Observation:
    volts = o.volts.copy()
    volts[len(volts) - math.ceil(seconds / o.period) - 1 :] = np.nan
    return dataclasses.replace(o, volts=volts, digest=o.digest or o.hashed())


def _answer(
    ws: Workspace,
    search: Search,
    result: SearchResult,
    fit: Fit,
    heldout: list[HeldOut],
    left: Localisation,
    lattice: ActiveEffect | None,
    rng: np.random.Generator,
    seed: int,
    progress: Callable[[str], None],
    checked: _Checked,
) -> Discovery:
    null = result.null
    if lattice is not None:
        null = refit(ws, ())
        ws.base = (*ws.base, lattice)
    law = None
    # Coarse steps cause noise that varies with the signal, which is no law.
    if lattice is None and (
        unknown_of(left, 1.0) or ws.gap(fit.difference) > UNSAID * ws.floor() or coincidences(fit, ws.physics)
    ):
        law = find_law(ws, null, fit, search.penalty, left.excess, rng, progress)
    if law is not None:
        fit, heldout = _beside(law, search, result, fit, heldout)
        explains = null.residual - fit.residual if fit.free else None
        left = localise(ws, fit.residual, fit.jacobian if fit.free else None, rng, explained=explains)
    progress('alternatives')
    named = named_effects(
        search,
        result,
        fit,
        heldout,
        lambda best, equal: suggest(ws, best, equal[: 3 if ws.simulations < ws.budget else 1]),
    )
    setup, lines = list(checked.findings), dict(checked.lines)
    for i, effect in enumerate(named):
        if effect.active.effect.name in SETUP:
            more, own = said(ws, fit, i, effect.delta_bic)
            setup += [dataclasses.replace(f, equivalent=effect.equivalent) for f in more]
            lines.update(own)
    rivals = tuple(r.fit for e in named for r in e.rivals)
    unsettled = tuple(dict.fromkeys(name for e in named for name in e.equivalent))
    named = [n for n in named if n.active.effect.name not in SETUP]
    setup += noise_finding(ws) if lattice is None else []
    if lattice is not None:
        named.append(_named_lattice(ws, lattice))
        ws.base = ws.base[:-1]
    progress('where')
    before = left if fit is null else localise(ws, null.residual, None, rng)
    floor = ws.floor()
    # Coarse steps cause noise that varies with the signal; compare what they explain with it.
    steps = 0.0 if lattice is None else 2.0 * _lattice_gain(ws, lattice)
    explained = max(null.chi2 - fit.chi2, 0.0) + steps
    gap_before, gap_after = checked.gap or ws.gap(null.difference), ws.gap(fit.difference)
    unknown = (
        unknown_of(left, explained, gap_after, floor, steps, ws.worded)
        or unsaid(ws, gap_before, gap_after)
        or tied(coincidences(fit, ws.physics), fit, result, before)
    )
    verdict = 'unknown_effect' if unknown else 'effects_found' if named else 'nothing_missing'
    held = heldout_tables(ws, fit)
    return Discovery(
        verdict=verdict,
        effects=tuple(named),
        unknown=unknown,
        where=before,
        left=left,
        gap_before=gap_before,
        gap_after=gap_after,
        gap_floor=floor,
        gap_heldout_before=gap_before,
        gap_heldout_after=ws.gap(held),
        per_channel=per_channel_of(ws, null.difference, fit.difference),
        heldout_per_channel=heldout_per_channel_of(ws, held),
        waterfall=waterfall_of(ws, fit, gap_before, gap_after),
        simulations=ws.simulations,
        search=result,
        fit=fit,
        workspace=ws,
        seed=seed,
        nuisance=(),
        setup=tuple(setup),
        values=lines,
        known=checked.known,
        law=law if verdict == 'unknown_effect' else None,
        rivals=rivals,
        unsettled=unsettled,
        moves=pose_change(ws, fit) if named else (0.0, 0.0, 0.0),
        rig=checked.rig,
    )


def pose_change(ws: Workspace, fit: Fit) -> tuple[float, float, float]:
    """By how much at most the effects of ``fit`` change the estimates of the recordings: dX m, dY m, theta rad."""
    tables = ws.block_dots(ws.simulate([*ws.base, *fit.effects])), ws.block_dots(ws.simulate(ws.base))
    most = np.zeros(3)
    for o, dots, nominal in zip(ws.observations, *tables, strict=True):
        solver = solver_from_rig(o.rig.estimator.solver, o.rig)
        there = np.isfinite(dots).all(axis=0) & np.isfinite(nominal).all(axis=0)
        variances = dot_noise_variances(o.rig) / o.rig.estimator.block_size
        poses = [solver.solve_many(d[:, there].T, variances).pose for d in (dots, nominal)]
        change = np.abs(poses[0] - poses[1])
        if np.isfinite(change).any():
            most = np.fmax(most, np.nanmax(change, axis=0))
    return (float(most[0]), float(most[1]), float(most[2]))


def _beside(
    law: FoundLaw, search: Search, result: SearchResult, fit: Fit, heldout: list[HeldOut]
) -> tuple[Fit, list[HeldOut]]:
    """``fit`` without the effects that only stood in for the law."""
    kept = {(a.effect.name, a.choices) for a in law.beside}
    for i in reversed(range(len(fit.effects))):
        active = fit.effects[i]
        if (active.effect.name, active.choices) not in kept:
            search.trace.append(f'{active.label} only stood in for the law')
            fit = without_one(search, result, fit, i)
            heldout = [h for j, h in enumerate(heldout) if j != i]
    return fit, heldout


def _lattice_gain(workspace: Workspace, lattice: ActiveEffect) -> float:
    """Log-likelihood of all readings lying on the lattice: by chance each does so with probability LSB/step."""
    lsb = workspace.observations[0].rig.converter.volts_per_count
    return workspace.size * workspace.fine[0] * float(np.log(max(lattice.values[lattice.effect.lattice] / lsb, 1.0)))


def _named_lattice(workspace: Workspace, lattice: ActiveEffect) -> NamedEffect:
    """The named effect of coarse steps, which the readings themselves show."""
    gain = _lattice_gain(workspace, lattice)
    sd = min(s[1] for o in workspace.observations if (s := propose.coarse_step(o)) is not None)
    heldout = HeldOut(gain, float(np.sqrt(2.0 * gain)))
    return NamedEffect(lattice, {lattice.effect.lattice: sd}, 0.0, 2.0 * gain, heldout, (), (), (), None)
