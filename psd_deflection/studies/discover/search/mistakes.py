# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mistakes of the set-up that touch every channel: one that explains nearly all is taken before any effect."""

from __future__ import annotations

from collections.abc import Sequence

from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.screen import Score, Screen
from psd_deflection.studies.discover.search.trials import MOST_CLOSED, Trials, far, unbound

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


def mistake(trials: Trials, null: Fit, scores: Sequence[Score]) -> Fit:
    """Return one of the mistakes that touch every channel if it explains nearly all by itself, else ``null``.

    Late loads may be taken with one effect, if they explain nearly all together: each would hide the other.
    """
    if not scores or min(s.p for s in scores) > trials.workspace.p_accept:
        return null
    best = trials.best_of(_mistaken(trials, null, scores), 2, 12)
    if not _nearly_all(trials, null, best):
        best = _delays_beside_an_effect(trials, null, scores)
    if best is None or not _nearly_all(trials, null, best) or _is_a_mass(best):
        return null
    trials.log('the set-up: ' + ', '.join(a.label for a in best.effects))
    return best


def _nearly_all(trials: Trials, null: Fit, fit: Fit | None) -> bool:
    """Return whether ``fit`` passes and leaves next to nothing."""
    size = trials.workspace.size
    if fit is None or not trials.passes(null, fit, null):
        return False
    return fit.chi2 - size <= NEARLY_ALL * (null.chi2 - size)


def _delays_beside_an_effect(trials: Trials, null: Fit, scores: Sequence[Score]) -> Fit | None:
    """Late loads with the best effect beside them."""
    delays = [s for s in scores if s.candidate.effect.name == LATE and s.p <= trials.workspace.p_accept]
    alone = trials.best_of([[s.candidate.from_coefficients(s.coefficients)] for s in delays], 1, 6)
    if alone is None or not trials.passes(null, alone, null):
        return None
    both = _effect_beside_delays(trials, alone, trials.screen)
    if far(alone) and not _nearly_all(trials, null, both) and alone.chi2 < MOST_CLOSED * null.chi2:
        # Late loads hide the spectral lines of a small effect, and change its signature.
        both = _effect_beside_delays(trials, alone, trials.screen_beside(alone))
    return both if both is not None and trials.passes(alone, both, null) else None


def _effect_beside_delays(trials: Trials, alone: Fit, screen: Screen) -> Fit | None:
    """Return the late loads of ``alone`` with the best effect of ``screen`` beside them."""
    scores = screen.score(alone.residual, unbound(alone))
    return trials.further(alone, [s for s in scores if s.candidate.effect.name not in trials.workspace.first])


def _mistaken(trials: Trials, null: Fit, scores: Sequence[Score]) -> list[list[ActiveEffect]]:
    """Return the starts of :meth:`mistake`."""
    best = max((s.gain for s in scores), default=0.0)
    starts: list[list[ActiveEffect]] = []
    for s in scores:
        if s.candidate.effect.name not in trials.workspace.first:
            continue
        start, name = s.candidate.from_coefficients(s.coefficients), s.candidate.effect.name
        if name == 'sensitivity' and start.values['error'] < FARTHEST_ERROR:
            start = ActiveEffect(start.effect, {'error': HALVED})
        if s.gain > LIKELY * best:
            starts.append([start])
        if name == 'sample_rate' and far(null):
            # A linear step does not reach another frequency of the ringing.
            starts += [[ActiveEffect(start.effect, {'error': v})] for v in OTHER_RATES]
    return starts + _frequency_starts(trials, null, [s for s in scores if s.gain > RINGS * best])


def _frequency_starts(trials: Trials, null: Fit, scores: Sequence[Score]) -> list[list[ActiveEffect]]:
    """Starts: either natural frequency is wrong, or both are."""
    near = []
    for s in scores:
        if s.candidate.effect.name in RINGING and s.candidate.effect.name in trials.workspace.first:
            near.append(frequency(trials.workspace, null, s))
    return [*([a] for a in near), *([near] if len(near) > 1 else [])]


def frequency(ws: Comparison, beside: Fit, score: Score) -> ActiveEffect:
    """Return the best start for another natural frequency: from far away a linear step does not reach it."""
    start = score.candidate.from_coefficients(score.coefficients)
    starts = OTHER_FREQUENCIES if far(beside) else ()
    return min(
        [start, *(ActiveEffect(start.effect, {'error': v}) for v in starts)],
        key=lambda a: ws.loss(ws.residual([*ws.base, *beside.coefficients_with_nuisance, a])[0]),
    )


def _is_a_mass(fit: Fit) -> bool:
    """Whether a lower frequency of the bending is all: a mass at the tip does the same, and the catalogue has it."""
    ringing = [a for a in fit.effects if a.effect.name in RINGING]
    return len(ringing) == 1 and ringing[0].effect.name == RINGING[0] and ringing[0].values['error'] < 0.0
