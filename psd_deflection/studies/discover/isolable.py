# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which effects could be told apart, from the rig and planned loads alone: detectable from the size at which a search
accepts it, identifiable from the size at which the part that no other effect imitates reaches ``EQUIVALENT``; to first
order."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import chi2

from psd_deflection.base.drawings import Matrix
from psd_deflection.base.pages import table, wide
from psd_deflection.base.tables import Column, Table, columns, text_column
from psd_deflection.model.simulation.catalogue import effects_for
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.discover.problem import Problem, Progress
from psd_deflection.studies.discover.recorded_rig import RecordedRig
from psd_deflection.studies.discover.search.comparison import EQUIVALENT
from psd_deflection.studies.discover.search.screen import Candidate, Screen, solve_observable
from psd_deflection.studies.discover.search.search import Search
from psd_deflection.studies.discover.thresholds import BIC_GAIN
from psd_deflection.studies.study import PageSection, StudyResult

FROM_READINGS = ('spectral', 'line', 'value_grid', 'value_grid_dots')
"""Proposals that only readings can make."""


@dataclass(frozen=True, slots=True)
class Isolable:
    """One effect, with its choices, under the loads. ``parameter``: that of the sizes, in ``unit``.

    ``observed``, ``named``: the least sizes, None if no size that the parameter may have is enough. ``alike``: the
    effect that imitates it best; ``apart``: sin² of the angle between the two, 0 to 1.
    """

    label: str
    parameter: str
    unit: str
    observed: float | None
    named: float | None
    alike: str
    apart: float

    def tree(self) -> dict[str, Any]:
        """As isolable.json has it."""
        names = ('label', 'parameter', 'unit', 'observed', 'named', 'alike', 'apart')
        return {name: getattr(self, name) for name in names}

    @property
    def row(self) -> tuple[str, ...]:
        """For a table."""
        sizes = [
            f'{size:.2g} {self.unit}'.strip() if size is not None else 'never' for size in (self.observed, self.named)
        ]
        return (self.label, self.parameter, *sizes, self.alike)


HEAD = ('effect', 'size', 'detectable from', 'identifiable from', 'most like')


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Isolability(StudyResult):
    """``effects``: each effect that shows under ``loads``, in words. ``hidden``: the others, and what each needs.

    ``matrix`` (n, n): how much of the signature of each the other imitates, 0 to 1.
    """

    study, json_name = 'discover', 'isolable.json'
    title = 'What these loads can tell apart'

    loads: str
    seconds: float
    effects: tuple[Isolable, ...]
    hidden: Mapping[str, str]
    matrix: FloatArray
    params_file: str

    @property
    def sources(self) -> Mapping[str, str]:
        """The rig and the loads."""
        return {'loads': self.loads, 'rig': self.params_file}

    def sentences(self) -> list[str]:
        """How many can be named, which imitate each other, which do not show."""
        named = [f for f in self.effects if f.named is not None]
        count = len(self.effects) + len(self.hidden)
        out = [
            f'Under {self.loads}, {self.seconds:.0f} s, {len(named)} of {count} effects can be named, '
            f'each from its own size on.'
        ]
        lost = [f for f in self.effects if f.named is None]
        if lost:
            out.append('Seen, but not told apart: ' + '; '.join(f'{f.label} from {f.alike}' for f in lost) + '.')
        if self.hidden:
            out.append('Not seen: ' + '; '.join(f'{label} (needs {why})' for label, why in self.hidden.items()) + '.')
        return out

    def lines(self) -> list[str]:
        """Return the table, then the sentences."""
        return [*columns([HEAD, *(f.row for f in self.effects)], align_left=5).split('\n'), '', *self.sentences()]

    def tree(self) -> dict[str, Any]:
        """Return the answer for programs; sizes in SI units."""
        return {
            'loads': self.loads,
            'seconds': self.seconds,
            'effects': [f.tree() for f in self.effects],
            'hidden': dict(self.hidden),
        }

    def table(self) -> Table:
        """One row an effect: the least sizes at which it is ``observed`` and ``named``, NaN: never, and its
        ``unit``.
        """
        effects = self.effects
        sizes = np.array([(f.observed, f.named) for f in effects], dtype=np.float64)
        sizes = sizes.reshape(-1, 2)
        return Table(
            text_column('effect', [f.label for f in effects], 'that may be there'),
            [
                Column('observed', sizes[:, 0], '', 'from this size on'),
                Column('named', sizes[:, 1], '', 'from this size on'),
                text_column('unit', [f.unit for f in effects], 'of the sizes'),
                text_column('alike', [f.alike for f in effects], 'what it is mistaken for'),
            ],
            {'loads': self.loads, 'seconds': self.seconds},
        )

    def sections(self) -> Iterable[PageSection]:
        """Return the table, and the picture of all pairs."""
        rows = table(HEAD, [f.row for f in self.effects])
        yield PageSection('From which size', (wide(rows, 'the least sizes'),))
        labels = [f.label for f in self.effects]
        words = 'how much of the signature of each effect another one imitates'
        shown = Matrix(words, self.matrix, labels, labels, most=1.0)
        note = '<p class=quiet>Each row an effect; dark: the effect of the column imitates it.</p>'
        yield PageSection('Which imitates which', (note, shown))


def isolable(
    rig: Rig,
    loads: FloatArray,
    words: str = 'these loads',
    *,
    without: Sequence[str] = (),
    params_file: str = 'the thesis rig',
    progress: Progress = lambda _: None,
) -> Isolability:
    """What a recording of ``rig`` under ``loads`` (n, 3) N, N, N m, one row a sample, could tell apart.

    ``words`` for the loads, ``params_file`` for the rig; ``without``: effects to leave out. Raises RecordingError
    if the loads are too short for a search.
    """
    counts = RigSimulator(rig).step(loads).counts
    volts = Wiring.from_rig(rig).to_psds(counts.astype(np.float64) * rig.converter.volts_per_count)
    planned = Observation('planned', rig, volts, loads)
    machine = RecordedRig.of([planned], rig, without, None, progress)
    problem = Problem.of(machine, 0, progress, np.random.default_rng(0))
    screen = problem.search.screen
    accepts = partial(_accepted, problem.search)
    variants: dict[str, list[Candidate]] = {}
    for candidate in screen.candidates:
        variants.setdefault(_label(candidate), []).append(candidate)
    effects, matrix = [], []
    for label, shapes in variants.items():
        isolable_effect, shares = min((_isolable(screen, label, c, variants, accepts) for c in shapes), key=_easiest)
        if shapes[0].effect.finite:
            isolable_effect = _of_probes(screen, isolable_effect, shapes, accepts(1))
        effects.append(isolable_effect)
        matrix.append(shares)
    hidden = {}
    for effect in effects_for(len(rig.psds)):
        for choice in effect.variants(len(rig.psds)):
            label = ActiveEffect(effect, choice).label
            # Lines of a spectrum and coarse steps are looked for where readings have them; none are there yet.
            by_itself = any(p.proposed_by(choice) in FROM_READINGS for p in effect.parameters)
            if label not in variants and effect.name not in without and not by_itself:
                hidden[label] = effect.needs
    return Isolability(
        loads=words,
        seconds=len(loads) / rig.converter.sample_rate_hz,
        effects=tuple(effects),
        hidden=hidden,
        matrix=np.array(matrix).reshape(len(effects), -1),
        params_file=params_file,
    )


def _accepted(search: Search, parameters: int) -> float:
    """Chi-square from which a search accepts an effect of so many free parameters."""
    by_chance = -math.expm1(math.log1p(-search.workspace.p_accept) / len(search.screen.candidates))
    return max(float(chi2.isf(by_chance, parameters)), search.penalty * parameters + BIC_GAIN)


def _label(candidate: Candidate) -> str:
    return ActiveEffect(candidate.effect, candidate.start).label


def _easiest(candidate: tuple[Isolable, list[float]]) -> float:
    return math.inf if candidate[0].named is None else candidate[0].named


def _isolable(
    screen: Screen,
    label: str,
    candidate: Candidate,
    variants: Mapping[str, Sequence[Candidate]],
    accepts: Callable[[int], float],
) -> tuple[Isolable, list[float]]:
    """Return one candidate, and the share of its signature that each of ``variants`` imitates at best."""
    column = screen.slice_of(candidate).start
    length = float(screen.fisher[column, column])
    shares = [
        max(_imitated(screen, column, screen.slice_of(c)) for c in other_choices) for other_choices in variants.values()
    ]
    alternatives = [
        (share, name)
        for (name, other_choices), share in zip(variants.items(), shares, strict=True)
        if other_choices[0].effect is not candidate.effect and len(other_choices[0].free) <= len(candidate.free)
    ]
    share, alike = max(alternatives, default=(0.0, ''))
    # What is left of two like signatures of 32 bit is rounding.
    apart = 1.0 - share if 1.0 - share > 100.0 * np.finfo(np.float32).eps else 0.0
    accepted = accepts(len(candidate.free))
    p = candidate.effect.parameter(candidate.free[0])
    out = Isolable(
        label=label,
        parameter=p.name,
        unit=p.unit,
        observed=_size(candidate, length, accepted),
        named=None if apart == 0.0 else _size(candidate, length, max(accepted, EQUIVALENT / apart)),
        alike=alike,
        apart=apart,
    )
    return out, shares


def _imitated(screen: Screen, column: int, imitating: slice) -> float:
    """Return the share, 0 to 1, of the squared length of a column that those of another candidate make up."""
    gain = solve_observable(
        screen.fisher[imitating, imitating], screen.fisher[imitating, column], screen.lengths[imitating]
    )[0]
    return min(gain / float(screen.fisher[column, column]), 1.0)


def _size(candidate: Candidate, length: float, wanted: float) -> float | None:
    """Return the size with a chi-square of ``wanted``, if its probe has ``length``; None if it may not be so large."""
    p, off, times = candidate.effect.parameter(candidate.free[0]), candidate.off, math.sqrt(wanted / length)
    if not candidate.effect.finite:
        size, room = p.scale * times, max(p.maximum - off[p.name], off[p.name] - p.minimum)
        return size if size <= room else None
    if p.power:
        size = candidate.start[p.name] * times ** (1.0 / p.power)
        return size if p.minimum <= size <= p.maximum else None
    return candidate.start[p.name] if times <= 1.0 else None


def _of_probes(screen: Screen, effect: Isolable, probes: Sequence[Candidate], accepted: float) -> Isolable:
    """``effect`` with the weakest of several probes that still shows, if the effect does not grow in proportion."""
    p = probes[0].effect.parameter(probes[0].free[0])
    if p.power:
        return effect
    lengths = {c: float(screen.lengths[screen.slice_of(c).start]) for c in probes}

    def weakest(wanted: float) -> float | None:
        enough = [c for c in probes if lengths[c] >= wanted]
        return min(enough, key=lambda c: lengths[c]).start[p.name] if enough else None

    named = None if effect.apart == 0.0 else weakest(max(accepted, EQUIVALENT / effect.apart))
    return replace(effect, observed=weakest(accepted), named=named)
