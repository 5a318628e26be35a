# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The parts of the verdict: named effects with their uncertainty and their alternatives, gaps, and what remains
unknown.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from psd_deflection.model.simulation.declaration import MOVES_FREQUENCY, ActiveEffect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.planning import Suggestion
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, HeldOut, scatter
from psd_deflection.studies.discover.search.localise import Dependence, Localisation
from psd_deflection.studies.discover.search.search import SearchResult
from psd_deflection.studies.discover.thresholds import (
    BANDS,
    CERTAIN_SD,
    DECADES,
    ODDS,
    P_CHANCE,
    P_LIBRARY,
    P_STRONG,
    SIGNIFICANT,
    SURE,
)
from psd_deflection.studies.loads.thresholds import DISTINCT_SD, SAME, SIMULATION_ERROR


@dataclass(frozen=True, slots=True)
class Coincidence:
    """Amplitudes of the fit, (index of the effect, parameter), whose ``sizes`` agree; ``odds`` for one cause."""

    members: tuple[tuple[int, str], ...]
    sizes: tuple[float, ...]
    unit: str
    odds: float


def _amplitudes(fit: Fit, physics: Physics | None, covariance: FloatArray) -> list[tuple[int, float, str]]:
    """Column, distance from off and unit of every amplitude that is significantly different from zero."""
    out = []
    for column, (i, name) in enumerate(fit.free):
        if i < 0:
            continue
        p = fit.effects[i].effect.parameter(name)
        size = fit.effects[i].values[name] - p.off(physics)
        clear = abs(size) > CERTAIN_SD * math.sqrt(covariance[column, column])
        if p.kind == 'amplitude' and clear and not fit.effects[i].effect.finite:
            out.append((column, size, p.unit))
    return out


def coincidences(fit: Fit, physics: Physics | None) -> list[Coincidence]:
    """The ties between amplitudes of different effects of ``fit`` that are beyond chance, the strongest first."""
    covariance = fit.covariance()
    sizes = _amplitudes(fit, physics, covariance)
    out = []
    for count in (2, 3):
        compared = [group for group in itertools.combinations(sizes, count) if _may_coincide(fit, group)]
        for group in compared:
            odds = _odds(group, covariance) / len(compared)
            if odds >= ODDS:
                members = tuple(fit.free[column] for column, _, _ in group)
                out.append(Coincidence(members, tuple(size for _, size, _ in group), group[0][2], odds))
    return sorted(out, key=lambda c: -c.odds)


def _may_coincide(fit: Fit, group: Sequence[tuple[int, float, str]]) -> bool:
    """Return whether these amplitudes are of different effects and of one unit, and no known cause ties them."""
    effects = [fit.free[column][0] for column, _, _ in group]
    # What ties two stiffnesses is known, and reported below.
    stiff = [i for i in effects if MOVES_FREQUENCY in fit.effects[i].effect.parameters]
    return len(set(effects)) == len(group) == len([g for g in group if g[2] == group[0][2]]) and len(stiff) < 2


def _odds(group: Sequence[tuple[int, float, str]], covariance: FloatArray) -> float:
    """Odds that the sizes of ``group`` are one against independent ones, of this group alone."""
    columns, sizes = [g[0] for g in group], np.array([g[1] for g in group])
    of_logs = covariance[np.ix_(columns, columns)] / np.outer(sizes, sizes)
    # The logarithm of the first less those of the others.
    less = np.column_stack((np.ones(len(group) - 1), -np.eye(len(group) - 1)))
    size_covariance = less @ (of_logs + 0.5 * SIMULATION_ERROR**2 * np.eye(len(group))) @ less.T
    off = less @ np.log(np.abs(sizes))
    density = math.exp(-0.5 * float(off @ np.linalg.solve(size_covariance, off))) / math.sqrt(
        np.linalg.det(2.0 * np.pi * size_covariance)
    )
    return float((DECADES * math.log(10.0)) ** len(off) * density)


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
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
    ``fitted_alternatives``: those and what else comes close in BIC.
    """

    active: ActiveEffect
    sd: Mapping[str, float]
    p: float
    delta_bic: float
    heldout: HeldOut
    equivalent: tuple[str, ...]
    fitted_alternatives: tuple[Alternative, ...]
    alternatives: tuple[tuple[str, float, float], ...]
    suggestion: Suggestion | None

    @property
    def name(self) -> str:
        """As the catalogue has it."""
        return self.active.effect.name

    @property
    def values(self) -> Mapping[str, float]:
        """Of its parameters, by name, SI units; ``sd`` has the standard deviations of those that were fitted."""
        return self.active.values


@dataclass(frozen=True, slots=True)
class Unknown:
    """A discrepancy that no effect explains, or only several tied effects: ``signature`` in words,
    ``explains``: its fraction of the gap's energy. ``unexplained``: whether it is still present with all effects added.
    ``rms``: its size, as the gap counts it, without noise.
    """

    signature: str
    depends_on: tuple[str, ...]
    explains: float
    unexplained: bool = True
    rms: float = 0.0


def sd_of(workspace: Comparison, fit: Fit, index: int) -> dict[str, float]:
    """Standard deviation of each fitted parameter of effect ``index`` (below 0: of the nuisance).

    From the noise. If more than noise remains, the model is not exact, and the scatter over load cases or recordings
    tells how far it is off; the larger of the two is taken.
    """
    sd = workspace.sd(fit.jacobian, fit.covariance())
    if workspace.open_level or workspace.gap(fit.difference) > SIGNIFICANT * workspace.floor():
        sd = np.maximum(sd, scatter(workspace, fit))
    return {fit.free[j][1]: float(sd[j]) for j in fit.columns_of(index)}


def covariance_of(fit: Fit, effects: Sequence[NamedEffect]) -> tuple[tuple[str, ...], FloatArray]:
    """Names (p) ``effect.parameter`` and covariance (p, p) of the fitted sizes, in the order of ``effects``.

    Correlations are those of ``fit``; standard deviations are those that the effects tell. What the readings show
    without a fit is independent of the rest.
    """
    places = [(e, name) for e in effects for name in e.sd if np.isfinite(e.active.values[name])]
    index = {id(a): i for i, a in enumerate(fit.effects)}
    columns = [fit.free.index((index[id(e.active)], n)) if id(e.active) in index else -1 for e, n in places]
    sd = np.array([e.sd[name] for e, name in places])
    fitted = fit.covariance()
    deviations = np.sqrt(np.maximum(np.diag(fitted), 0.0))
    out = np.diag(sd**2)
    for a, i in enumerate(columns):
        for b, j in enumerate(columns):
            if a != b and min(i, j) >= 0 and min(deviations[i], deviations[j]) > 0.0:
                out[a, b] = fitted[i, j] / (deviations[i] * deviations[j]) * sd[a] * sd[b]
    return tuple(f'{e.active.effect.name}.{name}' for e, name in places), out


def per_channel_of(
    workspace: Comparison, before: Sequence[FloatArray], after: Sequence[FloatArray]
) -> dict[str, tuple[float, float]]:
    """Gap of each channel before and after."""
    gaps = workspace.gap_per_channel(before), workspace.gap_per_channel(after)
    return {n: (float(a), float(b)) for n, a, b in zip(workspace.channels, *gaps, strict=True)}


def heldout_per_channel_of(workspace: Comparison, held: Sequence[FloatArray]) -> dict[str, float]:
    """Gap of each channel on load cases that the fit has not seen."""
    return {n: float(v) for n, v in zip(workspace.channels, workspace.gap_per_channel(held), strict=True)}


def waterfall_of(ws: Comparison, fit: Fit, gap_before: float, gap_after: float) -> tuple[tuple[str, float], ...]:
    """The gap after each effect is added, and the gap from noise alone."""
    steps = [('as described', gap_before)]
    for i in range(len(fit.effects) - 1):
        _, difference = ws.residual([*ws.base, *fit.nuisance, *fit.effects[: i + 1]])
        steps.append(('+ ' + fit.effects[i].effect.name, ws.gap(difference)))
    if fit.effects:
        steps.append(('+ ' + fit.effects[-1].effect.name, gap_after))
    return (*steps, ('noise alone', ws.floor()))


def _beyond(gap: float, floor: float) -> float:
    """Return the part of a gap that noise does not explain; all of it if nobody knows the noise."""
    return float(np.sqrt(max(gap**2 - floor**2, 0.0))) if np.isfinite(floor) else gap


def unnamed_gap(workspace: Comparison, before: float, after: float) -> tuple[Unknown, ...]:
    """What remains although no place of it stands out: several small differences, or the simulation's own error."""
    floor = workspace.floor()
    if not after > SIGNIFICANT * floor:
        return ()
    size = _beyond(after, floor)
    words = f'{workspace.worded(size)} remain, {after / floor:.1f} times the noise, in no single place or band'
    return (Unknown(words, (), float(min((after / before) ** 2, 1.0)), rms=size),)


def no_noise(workspace: Comparison, residual: Localisation, before: float, after: float) -> tuple[Unknown, ...]:
    """What remains where nobody states a noise, if it follows something or one value is like the next."""
    if not workspace.open_level or np.isfinite(workspace.floor()) or after <= 0.0:
        return ()
    # Of few values even all are a small chi-square: Fisher's F of a channel, over all that was tried.
    n = workspace.size / max(len({c.channel for c in residual.cells}), 1)
    least = n / (1.0 + (n - 1.0) / fdtri(1.0, n - 1.0, 1.0 - P_CHANCE / max(len(residual.dependences), 1)))
    follows = [d for d in residual.dependences if d.p < P_CHANCE or d.gain > least][:3]
    if not follows and not workspace.correlated:
        return ()
    names = tuple(dict.fromkeys(d.regressor for d in follows))
    how = f'it follows {", ".join(names)}' if names else 'one value is like the next'
    words = f'{workspace.worded(after)} remain, which is no noise: {how}'
    return (Unknown(words, names, float(min((after / max(before, 1e-300)) ** 2, 1.0)), rms=after),)


def unknown_of(
    residual: Localisation,
    explained: float,
    gap: float = 0.0,
    floor: float = 0.0,
    by_noise: float = 0.0,
    steps: float = 0.0,
    worded: Callable[[float], str] = str,
) -> tuple[Unknown, ...]:
    """``gap``: what remains; ``floor``: what noise leaves, ``by_noise``: at most. ``steps``: chi-square that coarse
    steps explain. ``worded``: a gap with its unit.
    """
    if residual.p > P_LIBRARY or residual.excess < max(SURE, SAME * steps):
        return ()
    fast = any(c.p < P_CHANCE and c.band[0] >= BANDS[4] for c in residual.cells)
    if 0.0 < gap <= max(floor, by_noise) < math.inf and not fast:
        # Noise alone may leave more.
        return ()
    strong = [d for d in residual.dependences if d.p < P_STRONG][:6]
    size = _beyond(gap, floor)
    words = _place_of(residual, strong)
    if size > 0.0:
        times = f' ({gap / floor:.1f} times the noise remain)' if floor > 0.0 else ''
        words.insert(1, f'{worded(size)} rms{times}')
    share = residual.excess / (residual.excess + explained)
    names = tuple(dict.fromkeys(d.regressor for d in strong))
    return (Unknown('; '.join(words), names, share, rms=size),)


def _place_of(residual: Localisation, strong: Sequence[Dependence]) -> list[str]:
    """On which channels, what it follows and how, and when it is strongest."""
    channels = list(
        dict.fromkeys([*(c.channel for c in residual.cells if c.p < P_CHANCE), *(d.channel for d in strong)])
    )
    names = tuple(dict.fromkeys(d.regressor for d in strong))
    even = sum(d.gain for d in strong if _even(d.regressor))
    odd = sum(d.gain for d in strong if not _even(d.regressor))
    lagging = any('history' in d.regressor for d in strong[:2])
    words = [f'on {", ".join(channels) or "no single channel"}']
    if strong:
        words.append(f'follows {", ".join(names[:3])}')
        words.append('mostly even' if even > 2.0 * odd else 'mostly odd' if odd > 2.0 * even else 'odd and even parts')
    if lagging:
        words.append('hysteretic: it depends on which way the load last changed')
    if residual.cells:
        c = residual.cells[0]
        words.append(f'strongest at {c.when[0]:.1f} to {c.when[1]:.1f} s, {c.band[0]:g} to {c.band[1]:g} Hz')
    return words


def tied(ties: Sequence[Coincidence], fit: Fit, result: SearchResult, before: Localisation) -> tuple[Unknown, ...]:
    """Effects whose sizes agree beyond chance are reported as one unknown cause."""
    if not ties:
        return ()
    tie = ties[0]
    *labels, last = [fit.effects[i].label for i, _ in tie.members]
    unit = f' {tie.unit}' if tie.unit else ''
    sizes = ', '.join(f'{name} {size:.4g}' for (_, name), size in zip(tie.members, tie.sizes, strict=True))
    words = (
        f'{", ".join(labels)} and {last} agree in size ({sizes}{unit}) as '
        f'independent effects hardly would (odds {tie.odds:.0f} to 1): one cause that is not in the catalogue'
    )
    names = tuple(dict.fromkeys(d.regressor for d in before.dependences[:6] if d.p < P_STRONG))
    share = sum(result.delta_chi2[i] for i, _ in tie.members) / max(result.null.chi2 - fit.chi2, 1e-300)
    return (Unknown(words, names, float(min(max(share, 0.0), 1.0)), unexplained=False),)


def _even(regressor: str) -> bool:
    return '^2' in regressor or '|' in regressor or regressor in ('constant', 'dot_x dot_y')


@dataclass(frozen=True, slots=True)
class CommonCause:
    """``factor``: by what the rig's radii, or the annotated loads, would have to be multiplied; with ``sd``."""

    name: str
    factor: float
    sd: float


@dataclass(frozen=True, slots=True)
class Tie:
    """``share``: by how much both stiffnesses differ from the rig file's, relative, with ``sd``; ``causes``: each
    explains both. ``moves``: whether the natural frequencies moved with them.
    """

    share: float
    sd: float
    moves: bool
    causes: tuple[CommonCause, ...]

    @property
    def sentence(self) -> str:
        """Why they are tied, the causes with their sizes, and what tells these apart."""
        share_words = f'{100.0 * self.share:.3g} ± {100.0 * self.sd:.1g} %'
        factors = {c.name: f'{c.factor:.5g} ± {c.sd:.1g}' for c in self.causes}
        words = f'Both stiffnesses, EI and GJ, differ by the same share ({share_words}), as one cause makes them: '
        radius = f"the link's radii times {factors['link_radius']} (EI and GJ grow with their fourth power)"
        if self.moves:
            return (
                f'{words}{radius}, or its material (E and G alike). Not the loads: the natural frequencies moved too. '
                f"Measure the link's diameter: that tells the radius from the material."
            )
        return (
            f'{words}{radius}, its material (E and G alike), or the annotated loads times {factors["load_unit"]}. '
            f"Static loads cannot tell these apart: measure the link's diameter, and weigh the loads."
        )


def ties(effects: Sequence[NamedEffect]) -> tuple[Tie, ...]:
    """Return the tie of the two stiffnesses among ``effects`` and their alternatives, if they differ by the same
    share.
    """
    for first, second in itertools.combinations(sorted(_shares(effects), key=lambda share: share.effect), 2):
        apart = DISTINCT_SD * math.hypot(first.sd, second.sd, SIMULATION_ERROR * first.value)
        clear = min(abs(first.value) / first.sd, abs(second.value) / second.sd) > CERTAIN_SD
        same = first.moves == second.moves and abs(first.value - second.value) <= apart
        if first.effect != second.effect and same and clear:
            return (_tie(first.value, first.sd, second.value, second.sd, first.moves),)
    return ()


class _Share(NamedTuple):
    """Relative change of a stiffness by an effect, with its sd; ``moves``: whether the mode moves with it."""

    effect: str
    value: float
    sd: float
    moves: bool


def _shares(effects: Sequence[NamedEffect]) -> Iterator[_Share]:
    """The changes of stiffnesses, wherever they are named or an alternative."""
    for named in effects:
        either: tuple[NamedEffect | Alternative, ...] = (named, *named.fitted_alternatives)
        for e in either:
            effect = e.active.effect
            if MOVES_FREQUENCY not in effect.parameters:
                continue
            scale = next(p.name for p in effect.parameters if p.kind == 'amplitude')
            sd = e.sd.get(scale, 0.0)
            if sd > 0.0:
                yield _Share(effect.name, e.active.values[scale], sd, bool(e.active.values[MOVES_FREQUENCY.name]))


def _tie(a: float, sd_a: float, b: float, sd_b: float, moves: bool) -> Tie:
    weight = sd_b**2 / (sd_a**2 + sd_b**2)
    share = weight * a + (1.0 - weight) * b
    sd = sd_a * sd_b / math.hypot(sd_a, sd_b)
    radius = (1.0 + share) ** 0.25
    causes = [CommonCause('link_radius', radius, 0.25 * radius / (1.0 + share) * sd)]
    if not moves:
        causes.append(CommonCause('load_unit', 1.0 / (1.0 + share), sd / (1.0 + share) ** 2))
    return Tie(share, sd, moves, tuple(causes))
