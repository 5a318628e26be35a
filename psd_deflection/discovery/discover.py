"""Compare, localise, name, add, show: :func:`discover` runs all steps.

The default answer is "nothing missing"; an effect is named only if all of these hold: library-wide
p <= 0.01, a BIC better by more than 10, a gain of more than two standard errors on held-out load
cases, and parameters within their bounds. A discrepancy that no effect explains is described as
unknown.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.commissioning.checkup import Finding
from psd_deflection.config import Rig, replace_values
from psd_deflection.discovery import proposals as propose
from psd_deflection.discovery.cleaning import clean
from psd_deflection.discovery.coincidence import Coincidence, coincidences
from psd_deflection.discovery.fit import Fit, refit
from psd_deflection.discovery.hidden import FIRST, SETUP, beginning, mistakes
from psd_deflection.discovery.laws import FoundLaw, find_law
from psd_deflection.discovery.localise import Localisation, localise
from psd_deflection.discovery.observation import Observation
from psd_deflection.discovery.planning import Suggestion, suggest
from psd_deflection.discovery.screen import Screen
from psd_deflection.discovery.search import BIC_ACCEPT, BUDGET, P_ACCEPT, Search, SearchResult, far, unphysical
from psd_deflection.discovery.setup import likely_delays, likely_jumps, noise_finding, said, wire
from psd_deflection.discovery.signatures import SignatureBank, candidates, signature_columns
from psd_deflection.discovery.validate import HeldOut, heldout_gain, heldout_gap
from psd_deflection.discovery.workspace import Workspace
from psd_deflection.records import FloatArray
from psd_deflection.simulation.catalogue import catalogue, effects_of_rig
from psd_deflection.simulation.declaration import ActiveEffect, Effect
from psd_deflection.simulation.physics import Physics

EQUIVALENT = 21.6
"""Loss in chi-square below which an alternative of no more parameters counts as equivalent: at
lambda sin^2(theta/2) = 5.4 one in a hundred would be misnamed, and sin^2(theta) is four times that."""
EQUIVALENT_BIC = 6.0
"""An alternative with more parameters must also be this close in BIC, because a more flexible effect always
fits as well.
"""
UNKNOWN_P = 1e-4
UNKNOWN_EXCESS = 60.0
STEPS_SHARE = 0.02
"""Coarse steps cause noise that varies with the signal; up to this share of what they explain it is nothing else."""
UNSAID = 1.5
"""A gap of more floors than this never remains without being reported as unknown."""
RIVAL_BIC = 10.0
"""An effect in place of the named one counts as its rival up to this loss in BIC."""


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """An effect in place of a named one, with its fitted values; ``delta_bic``: how much worse, below 0 better.
    ``fit``: the whole model with it.
    """

    active: ActiveEffect
    sd: Mapping[str, float]
    delta_bic: float
    fit: Fit


@dataclass(frozen=True, slots=True, eq=False)
class NamedEffect:
    """One effect of the answer. ``sd``: per fitted parameter. ``alternatives``: (name, loss in
    chi-square, difference of BIC), the closest first; ``equivalent``: those that this data cannot exclude;
    ``rivals``: those and what else comes close in BIC.
    """

    active: ActiveEffect
    sd: Mapping[str, float]
    p: float
    delta_bic: float
    heldout: HeldOut
    equivalent: tuple[str, ...]
    rivals: tuple[Rival, ...]
    alternatives: tuple[tuple[str, float, float], ...]
    suggestion: Suggestion | None


@dataclass(frozen=True, slots=True)
class Unknown:
    """A discrepancy that no effect explains, or only several tied effects: ``signature`` in words,
    ``explains``: its fraction of the gap's energy. ``remains``: whether it is still present with all effects added.
    ``rms``: its size, m, as the gap counts it, without noise.
    """

    signature: str
    depends_on: tuple[str, ...]
    explains: float
    remains: bool = True
    rms: float = 0.0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Discovery:
    """The answer. Gaps in m (rms of block means over x1 y1 x2 y2).

    ``setup``: mistakes of the set-up and the recording, with ``lines`` that put the rig file right; ``known``: the
    effects that the rig file has already. ``law``: describes what is unknown; it is in no gap and no effect here.
    ``rivals``: the whole models that these recordings do not exclude beside ``fit``, also those of mistakes of the
    set-up; ``unsettled``: names of what explains the recordings as well as something in ``fit``.
    """

    verdict: str
    effects: tuple[NamedEffect, ...]
    unknown: tuple[Unknown, ...]
    where: Localisation
    left: Localisation
    gap_before: float
    gap_after: float
    gap_floor: float
    gap_heldout_before: float
    gap_heldout_after: float
    per_channel: Mapping[str, tuple[float, float]]
    waterfall: tuple[tuple[str, float], ...]
    simulations: int
    search: SearchResult
    fit: Fit
    workspace: Workspace
    seed: int
    setup: tuple[Finding, ...]
    lines: Mapping[str, object]
    known: tuple[ActiveEffect, ...]
    law: FoundLaw | None = None
    rivals: tuple[Fit, ...] = ()
    unsettled: tuple[str, ...] = ()

    @property
    def floors(self) -> float:
        """The gap that remains, in units of the gap that noise alone leaves."""
        return self.gap_after / self.gap_floor if self.gap_floor > 0.0 else 0.0

    @property
    def active_effects(self) -> list[ActiveEffect]:
        """The effects to add to the rig file."""
        return [*self.known, *(e.active for e in self.effects)]

    def __repr__(self) -> str:
        named = ', '.join(e.active.label for e in self.effects) or 'no effect'
        before, after, floor = (f'{1e6 * v:.3f}' for v in (self.gap_before, self.gap_after, self.gap_floor))
        return f'<Discovery {self.verdict}: {named}; gap {before} → {after} µm (noise alone: {floor} µm)>'


def _proposals(workspace: Workspace) -> dict[str, list[float]]:
    raw = workspace.raw_residual(workspace.base)
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
    rates = {o.rig.converter.sample_rate_hz for o in recordings if o.stated_rate_hz}
    lines: dict[str, object] = {'converter.sample_rate_hz': rates.pop()} if len(rates) == 1 else {}
    rng = np.random.default_rng(seed)
    base = effects_of_rig(rig)
    progress('checking the recording')
    cleaned = [clean(o, base) for o in recordings]
    observations, findings, rewired = wire([o for o, _ in cleaned], base)
    before = 0.0
    if findings:
        stated = Workspace([o for o, _ in cleaned], base)
        before = stated.gap(stated.residual(base)[1])
    findings = [*(f for _, found in cleaned for f in found), *findings]
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
    workspace.base = (*base, *_beginnings(workspace))
    # Signatures that are kept are those of recordings as they were, from rest.
    changed = bool(findings) or len(workspace.base) > len(base) or any(d > 0.0 for d in delays)
    kept = SignatureBank() if bank is None or changed else bank
    kept.nominal(workspace)
    found = _proposals(workspace)
    if lattice is not None:
        workspace.base = (*workspace.base, lattice)

    looked_for = set(FIRST)

    def screen(ws: Workspace, current: Fit | None) -> Screen:
        residual = ws.residual(ws.base)[0] if current is None else current.residual
        more = mistakes(len(observations), delays, likely_jumps(ws, residual))
        more = [e for e in more if e.name not in FIRST or e.name in looked_for]
        listed = candidates(physics, found, (*without, *(e.name for e in of_lattice)), more)
        if current is None or not far(current):
            return Screen(ws, [(c, kept.get(c, ws)) for c in listed])
        # A large effect changes the signatures of the others.
        beside = [*ws.base, *current.effects]
        now = ws.simulate(beside)
        return Screen(ws, [(c, signature_columns(c, ws, now, beside)) for c in listed])

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
    progress('weighing')
    heldout, fit = _accept(search, result, rng)
    seen = 0.0 if lattice is None else 2.0 * _lattice_gain(workspace, lattice)
    fit, heldout, left = _credible(search, result, fit, heldout, seen, rng)
    if lattice is not None:
        workspace.base = tuple(a for a in workspace.base if a is not lattice)
    checked = _Checked(findings, lines, tuple(base), before)
    return _answer(search, result, fit, heldout, left, lattice, rng, seed, progress, checked)


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


def _credible(
    search: Search, result: SearchResult, fit: Fit, heldout: list[HeldOut], seen: float, rng: np.random.Generator
) -> tuple[Fit, list[HeldOut], Localisation]:
    """Remove effects that explain less than the unknown remainder: they probably stand in for it."""
    ws = search.workspace
    while True:
        explained = result.null.residual - fit.residual if fit.free else None
        left = localise(ws, fit.residual, fit.jacobian if fit.free else None, rng, explained=explained)
        if not fit.effects or not _unknown(left, 0.0, steps=seen):
            break
        weakest = int(np.argmin(result.delta_chi2))
        if result.delta_chi2[weakest] >= left.excess:
            break
        search.trace.append(f'{fit.effects[weakest].label} explains less than what remains unknown')
        fit = _without(ws, result, fit, weakest)
        heldout = [h for j, h in enumerate(heldout) if j != weakest]
    return fit, heldout, left


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


def _accept(search: Search, result: SearchResult, rng: np.random.Generator) -> tuple[list[HeldOut], Fit]:
    """The joint rule: remove the effects that fail it, the weakest first, and refit the rest."""
    ws, fit = search.workspace, result.fit
    while True:
        heldout = []
        fails: list[tuple[float, int]] = []
        for i, without in enumerate(search.without_each(fit, result.null)):
            gain = heldout_gain(ws, without, fit, rng)
            heldout.append(gain)
            columns = fit.columns_of(i)
            chi2 = without.chi2 - fit.chi2
            bic = chi2 - search.penalty * len(columns)
            if (
                not gain.holds
                or unphysical(ws, fit, i)
                or search.library_p(chi2, len(columns)) > P_ACCEPT
                or bic <= BIC_ACCEPT
            ):
                fails.append((bic, i))
        if not fails:
            break
        _, worst = min(fails)
        search.trace.append(f'{fit.effects[worst].label} fails the joint rule')
        fit = _without(ws, result, fit, worst)
    return heldout, fit


def _without(ws: Workspace, result: SearchResult, fit: Fit, index: int) -> Fit:
    """``fit`` refitted without one effect, which is taken out of ``result`` too."""
    for listed in (result.p, result.delta_bic, result.delta_chi2):
        del listed[index]
    rest = [a for j, a in enumerate(fit.effects) if j != index]
    return refit(ws, rest, iterations=6) if rest else result.null


def _answer(
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
    ws, null = search.workspace, result.null
    if lattice is not None:
        null = refit(ws, ())
        ws.base = (*ws.base, lattice)
    law = None
    # Coarse steps cause noise that varies with the signal, which is no law.
    if lattice is None and (
        _unknown(left, 1.0) or ws.gap(fit.difference) > UNSAID * ws.floor() or coincidences(fit, ws.physics)
    ):
        law = find_law(ws, null, fit, search.penalty, left.excess, rng, progress)
    if law is not None:
        fit, heldout = _beside(law, search, result, fit, heldout)
        explains = null.residual - fit.residual if fit.free else None
        left = localise(ws, fit.residual, fit.jacobian if fit.free else None, rng, explained=explains)
    progress('alternatives')
    named = _named(search, result, fit, heldout)
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
        _unknown(left, explained, gap_after, floor, steps)
        or _unsaid(gap_before, gap_after, floor)
        or _tied(coincidences(fit, ws.physics), fit, result, before)
    )
    verdict = 'unknown_effect' if unknown else 'effects_found' if named else 'nothing_missing'
    channels = ws.gap_per_channel(null.difference), ws.gap_per_channel(fit.difference)
    return Discovery(
        verdict,
        tuple(named),
        unknown,
        before,
        left,
        gap_before,
        gap_after,
        floor,
        gap_before,
        heldout_gap(ws, fit),
        {n: (float(a), float(b)) for n, a, b in zip(('x1', 'y1', 'x2', 'y2'), *channels, strict=True)},
        _waterfall(ws, fit, gap_before, gap_after),
        ws.simulations,
        result,
        fit,
        ws,
        seed,
        tuple(setup),
        lines,
        checked.known,
        law if verdict == 'unknown_effect' else None,
        rivals,
        unsettled,
    )


def _beside(
    law: FoundLaw, search: Search, result: SearchResult, fit: Fit, heldout: list[HeldOut]
) -> tuple[Fit, list[HeldOut]]:
    """``fit`` without the effects that only stood in for the law."""
    kept = {(a.effect.name, a.choices) for a in law.beside}
    for i in reversed(range(len(fit.effects))):
        active = fit.effects[i]
        if (active.effect.name, active.choices) not in kept:
            search.trace.append(f'{active.label} only stood in for the law')
            fit = _without(search.workspace, result, fit, i)
            heldout = [h for j, h in enumerate(heldout) if j != i]
    return fit, heldout


def _named(search: Search, result: SearchResult, fit: Fit, heldout: Sequence[HeldOut]) -> list[NamedEffect]:
    """The effects of ``fit`` with their standard deviations and the equally good alternatives."""
    ws, covariance = search.workspace, fit.covariance()
    # If the joint rule has removed effects, their alternatives are no longer comparable.
    as_found = fit is result.fit
    named: list[NamedEffect] = []
    for i, active in enumerate(fit.effects):
        fits = result.alternatives[i] if as_found else search.alternatives(result.null, fit, i, result.delta_chi2[i])
        rows, equal, rivals = [], [], []
        for f in fits:
            loss = f.chi2 - fit.chi2
            bic = loss + search.penalty * (f.parameters - fit.parameters)
            rows.append((f.effects[-1].effect.name, loss, bic))
            if loss < EQUIVALENT and (f.parameters <= fit.parameters or bic < EQUIVALENT_BIC):
                equal.append(f)
            if (bic < RIVAL_BIC or f in equal) and not unphysical(ws, f, len(f.effects) - 1):
                rivals.append(Rival(f.effects[-1], _sd(f, f.covariance(), len(f.effects) - 1), bic, f))
        names = tuple(dict.fromkeys(f.effects[-1].effect.name for f in equal))
        named.append(
            NamedEffect(
                active,
                _sd(fit, covariance, i),
                result.p[i],
                result.delta_bic[i],
                heldout[i],
                names,
                tuple(sorted(rivals, key=lambda r: r.delta_bic)),
                tuple(rows),
                suggest(ws, fit, equal[: 3 if ws.simulations < BUDGET else 1]) if equal else None,
            )
        )
    return named


def _sd(fit: Fit, covariance: FloatArray, index: int) -> dict[str, float]:
    """Standard deviation of each fitted parameter of effect ``index``."""
    return {fit.free[j][1]: float(np.sqrt(max(covariance[j, j], 0.0))) for j in fit.columns_of(index)}


def _waterfall(ws: Workspace, fit: Fit, gap_before: float, gap_after: float) -> tuple[tuple[str, float], ...]:
    """The gap after each effect is added, and the gap from noise alone."""
    steps = [('as described', gap_before)]
    for i in range(len(fit.effects) - 1):
        _, difference = ws.residual([*ws.base, *fit.effects[: i + 1]])
        steps.append(('+ ' + fit.effects[i].effect.name, ws.gap(difference)))
    if fit.effects:
        steps.append(('+ ' + fit.effects[-1].effect.name, gap_after))
    return (*steps, ('noise alone', ws.floor()))


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


def _beyond(gap: float, floor: float) -> float:
    """The part of a gap, m, that noise does not explain."""
    return float(np.sqrt(max(gap**2 - floor**2, 0.0)))


def _unsaid(before: float, after: float, floor: float) -> tuple[Unknown, ...]:
    """What remains although no place of it stands out: several small differences, or the simulation's own error."""
    if after <= UNSAID * floor:
        return ()
    size = _beyond(after, floor)
    words = f'{1e6 * size:.3g} µm remain, {after / floor:.1f} times the noise, in no single place or band'
    return (Unknown(words, (), float(min((after / before) ** 2, 1.0)), rms=size),)


def _unknown(
    left: Localisation, explained: float, gap: float = 0.0, floor: float = 0.0, steps: float = 0.0
) -> tuple[Unknown, ...]:
    """``gap``, ``floor``: what remains and what noise leaves, m. ``steps``: chi-square that coarse steps explain."""
    if left.p > UNKNOWN_P or left.excess < max(UNKNOWN_EXCESS, STEPS_SHARE * steps):
        return ()
    strong = [d for d in left.dependences if d.p < 1e-3][:6]
    channels = list(dict.fromkeys([*(c.channel for c in left.cells if c.p < 0.01), *(d.channel for d in strong)]))
    names = tuple(dict.fromkeys(d.regressor for d in strong))
    even = sum(d.gain for d in strong if _even(d.regressor))
    odd = sum(d.gain for d in strong if not _even(d.regressor))
    lagging = any('history' in d.regressor for d in strong[:2])
    size = _beyond(gap, floor)
    words = [f'on {", ".join(channels) or "no single channel"}']
    if size > 0.0:
        words.append(f'{1e6 * size:.3g} µm rms ({gap / floor:.1f} times the noise remain)')
    if strong:
        words.append(f'follows {", ".join(names[:3])}')
        words.append('mostly even' if even > 2.0 * odd else 'mostly odd' if odd > 2.0 * even else 'odd and even parts')
    if lagging:
        words.append('hysteretic: it depends on which way the load last changed')
    if left.cells:
        c = left.cells[0]
        words.append(f'strongest at {c.when[0]:.1f} to {c.when[1]:.1f} s, {c.band[0]:g} to {c.band[1]:g} Hz')
    share = left.excess / max(left.excess + explained, 1e-300)
    return (Unknown('; '.join(words), names, float(min(max(share, 0.0), 1.0)), rms=size),)


def _tied(ties: Sequence[Coincidence], fit: Fit, result: SearchResult, before: Localisation) -> tuple[Unknown, ...]:
    """Effects whose sizes agree beyond chance are reported as one unknown cause."""
    if not ties:
        return ()
    tie = ties[0]
    (i, first), (j, second) = tie.first, tie.second
    (a, b), unit = tie.sizes, f' {tie.unit}' if tie.unit else ''
    words = (
        f'{fit.effects[i].label} and {fit.effects[j].label} agree in size ({first} {a:.4g}, {second} {b:.4g}{unit}) as '
        f'independent effects hardly would (odds {tie.odds:.0f} to 1): one cause that is not in the catalogue'
    )
    names = tuple(dict.fromkeys(d.regressor for d in before.dependences[:6] if d.p < 1e-3))
    share = (result.delta_chi2[i] + result.delta_chi2[j]) / max(result.null.chi2 - fit.chi2, 1e-300)
    return (Unknown(words, names, float(min(max(share, 0.0), 1.0)), remains=False),)


def _even(regressor: str) -> bool:
    return '^2' in regressor or '|' in regressor or regressor in ('constant', 'dot_x dot_y')
