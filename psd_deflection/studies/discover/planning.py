# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The next recording: of those that the limits allow, the one whose chi-square best tells the named model from its
rivals, averaged over all pairs and counted up to ``SURE``; with less effort at the same value."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from psd_deflection.base.tables import columns
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.studies.discover.experiment import (
    Limits,
    ModelSums,
    Piece,
    Setting,
    expected_sums,
    limits_to_tree,
    nothing_of,
    proposals,
)
from psd_deflection.studies.discover.search.comparison import EQUIVALENT
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.thresholds import SURE
from psd_deflection.studies.loads.thresholds import SAME


@dataclass(frozen=True, slots=True)
class Suggestion:
    """``separation``: smallest chi-square between the alternatives; below ``EQUIVALENT`` the experiment is not
    enough.
    """

    words: str
    separation: float

    @property
    def text(self) -> str:
        """The suggestion as text, for people and result.json."""
        if self.separation < EQUIVALENT:
            return (
                f'none of the experiments tried tells them apart; the best, {self.words}, separates them by '
                f'{math.sqrt(self.separation):.1f} standard deviations (needed: {math.sqrt(EQUIVALENT):.1f})'
            )
        apart = f'{math.sqrt(self.separation):.2g}'
        return f'{self.words}: in simulation this separates them by {float(apart):g} standard deviations'


@dataclass(frozen=True, slots=True, eq=False)
class Discrimination:
    """One alternative model: ``alternative`` for ``named``, labels of effects. ``separation``: chi-square by which it
    would lose in the planned recording if the named effect is true; ``reverse``: by which the named one would lose if
    the alternative is true; ``possible``: the greatest of both in any recording within the limits.
    """

    alternative: str
    named: str
    separation: float
    reverse: float
    possible: float

    @property
    def separable(self) -> bool:
        """Whether any recording within the limits tells the two apart."""
        return self.possible >= EQUIVALENT


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """The next recording: ``pieces`` one after the other in ``setting``, at ``rate`` Hz.

    ``discriminations``: one per alternative model.
    """

    setting: Setting
    pieces: tuple[Piece, ...]
    discriminations: tuple[Discrimination, ...]
    limits: Limits
    rate: float

    @property
    def loads(self) -> FloatArray:
        """(n, 3) N, N, N m, one row a sample."""
        return np.concatenate([p.loads(self.rate) for p in self.pieces])

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return len(self.loads) / self.rate

    @property
    def script(self) -> list[str]:
        """The loads in the notation of ``simulate --loads``."""
        return [s for p in self.pieces for s in p.script]

    @property
    def useful(self) -> bool:
        """Whether any recording within the limits tells an alternative from the named model."""
        return any(t.separable for t in self.discriminations)

    @property
    def words(self) -> str:
        """What to do."""
        repeats = [(w, len(list(g))) for w, g in itertools.groupby(p.words for p in self.pieces)]
        done = '; then '.join(w if times == 1 else f'{w}, {times} times' for w, times in repeats)
        return f'{done}, {self.setting.words}' if self.setting.words else done

    @property
    def sentence(self) -> str:
        """The plan in one sentence."""
        alternatives = ', '.join(dict.fromkeys(t.alternative for t in self.discriminations))
        if not self.useful:
            return f'No recording within the limits would tell {self.discriminations[0].named} from {alternatives}.'
        apart = [t for t in self.discriminations if t.separable]
        least = min(max(t.separation, t.reverse) for t in apart)
        separable = ', '.join(dict.fromkeys(t.alternative for t in apart))
        out = (
            f'Record next, {self.seconds:.0f} s: {self.words}. It tells {apart[0].named} from {separable} '
            f'(chi-square {least:.0f} at least, {EQUIVALENT:g} needed)'
        )
        lasting = [t.alternative for t in self.discriminations if not t.separable]
        return f'{out}; nothing within the limits tells {", ".join(lasting)} apart.' if lasting else f'{out}.'

    @property
    def table(self) -> str:
        """The loads, one row for each that is held or swept, if the plan is worth it; what becomes of each
        alternative.
        """
        rows: list[tuple[str, ...]] = [('load', 'Fx / N', 'Fy / N', 'Tz / N m', 'for / s')]
        for script in self.script:
            kind, loads, *rest = script.split(':')
            words = 'hold' if kind != 'chirp' else f'sweep {rest[0].replace(",", " to ")} Hz, up to'
            rows += [(words, *load.split(','), rest[-1]) for load in loads.split(';')]
        rows_of_alternatives = [
            ('instead of', 'alternative', 'expected chi-square', 'if the alternative is true', 'at most')
        ]
        rows_of_alternatives += [
            (t.named, t.alternative, f'{t.separation:.0f}', f'{t.reverse:.0f}', f'{t.possible:.0f}')
            for t in self.discriminations
        ]
        held = f'{columns(rows)}\n\n' if self.useful else ''
        return held + columns(rows_of_alternatives, align_left=2)

    @property
    def loads_csv(self) -> str:
        """The loads as ``simulate --loads`` takes them from a file."""
        loads = self.loads
        t = np.arange(len(loads)) / self.rate
        lines = ['t,load_fx,load_fy,load_tz']
        lines += [','.join(f'{v:.9g}' for v in row) for row in np.column_stack((t, loads)).tolist()]
        return '\n'.join(lines) + '\n'

    def tree(self) -> dict[str, Any]:
        """Return the plan as result.json has it."""
        return {
            'sentence': self.sentence,
            'useful': self.useful,
            'seconds': self.seconds,
            'sample_rate_hz': self.rate,
            'loads': self.script,
            'celsius': self.setting.knots if self.setting.swing else None,
            'overrides': dict(self.setting.changes),
            'rivals': [
                {
                    'name': t.alternative,
                    'instead_of': t.named,
                    'separation': t.separation,
                    'reverse': t.reverse,
                    'possible': t.possible,
                    'separable': t.separable,
                }
                for t in self.discriminations
            ],
            'limits': limits_to_tree(self.limits),
        }


def plan_next(
    workspace: Workspace, named: Fit, alternatives: Sequence[Fit], limits: Limits | None = None
) -> Plan | None:
    """Return the recording within ``limits`` that best tells ``named`` from ``alternatives``; None without
    alternatives.
    """
    if not alternatives:
        return None
    limits = limits or Limits()
    models = [named, *alternatives]
    known = [m.jacobian.T @ m.jacobian for m in models]
    # One of the alternatives may be true: then it is to be distinguished from the other alternatives too.
    pairs = list(itertools.permutations(range(len(models)), 2))
    rig = workspace.observations[0].rig

    def separations(s: ModelSums) -> FloatArray:
        return np.array([s.separation(a, b, known[b]) for a, b in pairs])

    possible = np.zeros(len(pairs))
    best: tuple[float, Setting, list[Piece]] = (-np.inf, Setting(), [])
    for _, group in itertools.groupby(proposals(rig, limits), key=lambda p: id(p.setting)):
        offered = list(group)
        setting = offered[0].setting
        expected = [
            (p.piece, expected_sums(workspace, models, setting, p.piece.loads(rate_of(rig, setting)))) for p in offered
        ]
        for _, s in expected:
            # The same for as long as a recording may be.
            possible = np.maximum(possible, separations(s * max(limits.seconds // s.seconds, 1.0)))
        value, chosen = best_combination(expected, nothing_of(models), separations, limits.seconds)
        if chosen and value - setting.effort > best[0]:
            best = (value - setting.effort, setting, chosen)
    _, setting, chosen = best
    plan = Plan(setting, tuple(chosen), (), limits, rate_of(rig, setting))
    final = separations(expected_sums(workspace, models, setting, plan.loads))
    possible = np.maximum(possible, final)
    discriminations = []
    for k, alternative in enumerate(alternatives, start=1):
        there, back = pairs.index((0, k)), pairs.index((k, 0))
        most = float(max(possible[there], possible[back]))
        discriminations.append(
            Discrimination(
                alternative.effects[-1].label,
                _replaced(named, alternative),
                float(final[there]),
                float(final[back]),
                most,
            )
        )
    return dataclasses.replace(plan, discriminations=tuple(discriminations))


def suggest(
    workspace: Workspace, named: Fit, alternatives: Sequence[Fit], limits: Limits | None = None
) -> Suggestion | None:
    """Return the next experiment that best separates ``named`` from the closest of ``alternatives``."""
    plan = plan_next(workspace, named, alternatives, limits)
    return (
        None
        if plan is None
        else Suggestion(plan.words, min(max(t.separation, t.reverse) for t in plan.discriminations))
    )


def rate_of(rig: Rig, setting: Setting) -> float:
    """Return the sample rate in ``setting``, Hz."""
    changed = replace_values(rig, setting.changes) if setting.changes else rig
    return changed.converter.sample_rate_hz


def best_combination(
    expected: Sequence[tuple[Piece, ModelSums]],
    total: ModelSums,
    separations: Callable[[ModelSums], FloatArray],
    seconds: float,
) -> tuple[float, list[Piece]]:
    """Pieces for one recording, the most valuable first, and the value of all."""
    chosen: list[Piece] = []
    value = 0.0
    while True:
        trials: list[tuple[float, int, Piece, ModelSums]] = []
        for piece, s in expected:
            more = total + s
            if more.seconds <= seconds + 1e-6:
                worth = float(np.mean(np.minimum(separations(more) / SURE, 1.0)))
                trials.append((worth - SAME * more.seconds / 60.0, len(trials), piece, more))
        if not trials:
            return value, chosen
        best, _, piece, more = max(trials, key=lambda t: t[:2])
        # One piece is there in any case: to say what it would be like.
        if chosen and best < value + SAME:
            return value, chosen
        value, total = best, more
        chosen.append(piece)


def _replaced(named: Fit, alternative: Fit) -> str:
    """Return the label of the effect of ``named`` that ``alternative`` does without."""
    common = {(a.effect.name, a.choices) for a in alternative.effects[:-1]}
    return ', '.join(a.label for a in named.effects if (a.effect.name, a.choices) not in common)
