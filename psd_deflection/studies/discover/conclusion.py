# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a search concludes: sentences, result.json, model.yaml, the files of a law (docs/discover.md).

``report`` makes its page.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from psd_deflection import __version__
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.files import replace_file
from psd_deflection.base.tables import Column, Table, text_column
from psd_deflection.model.simulation.catalogue import FOLDERS, effect_folders, effect_names, effects_to_values
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.laws import Law, effect_of, law_text, values_of
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.observation import Observation
from psd_deflection.rig.config import Rig
from psd_deflection.rig.parameter_files import with_effects_section, with_values
from psd_deflection.studies.check.result import Finding, finding_tree
from psd_deflection.studies.check.shared_findings import LOADS
from psd_deflection.studies.check.wirings import line
from psd_deflection.studies.discover import rehearsal as rehearsing
from psd_deflection.studies.discover.hidden import RIG_NUMBERS, SETUP
from psd_deflection.studies.discover.laws import FoundLaw
from psd_deflection.studies.discover.redundant import STAGES
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.localise import Localisation
from psd_deflection.studies.discover.search.predictive import Predictive
from psd_deflection.studies.discover.search.search import SearchResult
from psd_deflection.studies.discover.search.smooth import Remainder
from psd_deflection.studies.discover.search.weighing import NamedEffect, Unknown, ties
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.trees import (
    covariance_tree,
    effect_tree,
    fitted,
    law_tree,
    number,
    parameters_of,
    size_of,
)
from psd_deflection.studies.loads.thresholds import AS_GOOD
from psd_deflection.studies.study import GIVEN_RIG, Notify, StudyResult, described, edited_rig_file, named, warn_caller

SHOWN = 1e-3
"""µm and µrad: a smaller change of an estimate is none."""


@dataclass(frozen=True, eq=False, repr=False)
class Conclusion(StudyResult):
    """The answer of a search. Gaps are rms values of measured minus simulated in the unit of ``workspace``.

    ``per_channel``: before and after; ``heldout_per_channel``: after, on load cases that the fit has not seen.
    ``nuisance``: what every model has, each with the standard deviations of its parameters. ``remainder``: what is
    unknown as a function of named variables. ``prediction``: the model that predicts best, None if none was looked for.
    ``rehearsal``: see :meth:`rehearse`.
    """

    study, json_name = 'discover', 'result.json'
    title = 'What the model lacks'

    verdict: str
    effects: tuple[NamedEffect, ...]
    unknown: tuple[Unknown, ...]
    where: Localisation
    residual: Localisation
    gap_before: float
    gap_after: float
    gap_floor: float
    gap_heldout_before: float
    gap_heldout_after: float
    per_channel: Mapping[str, tuple[float, float]]
    heldout_per_channel: Mapping[str, float]
    waterfall: tuple[tuple[str, float], ...]
    remainder: Remainder | None
    prediction: Predictive | None
    simulations: int
    search: SearchResult
    fit: Fit
    workspace: Comparison
    seed: int
    nuisance: tuple[tuple[ActiveEffect, Mapping[str, float]], ...]
    rehearsal: rehearsing.Rehearsal | None = field(default=None, kw_only=True)

    def rehearse(self, times: int) -> Self:
        """Return the answer with a measured confidence: ``times`` searches in simulations of the found model, with the
        loads, gaps and noise of what was measured. Raises ConfigError if ``times`` is below 1.
        """
        return self.rehearsed([run() for run in rehearsing.rehearsals(self, times)])

    def rehearsed(self, outcomes: Sequence[rehearsing.RehearsalOutcome]) -> Self:
        """Return the answer with the ``outcomes`` of its rehearsals."""
        return replace(self, rehearsal=rehearsing.Rehearsal(rehearsing.named_by(self), tuple(outcomes)))

    @abc.abstractmethod
    def search_in_simulation(self, seed: int) -> Callable[[], Conclusion]:
        """Return the same search in a simulation of the found model; ``seed``: of its noise."""

    @property
    def floors(self) -> float:
        """The gap that remains, in units of the gap that noise alone leaves; 0 if nobody knows the noise."""
        return self.gap_after / self.gap_floor if self.gap_floor > 0.0 else 0.0

    def __repr__(self) -> str:
        effects = ', '.join(e.active.label for e in self.effects) or 'no effect'
        before, after, floor = (self.workspace.worded(v) for v in (self.gap_before, self.gap_after, self.gap_floor))
        return f'<{type(self).__name__} {self.verdict}: {effects}; gap {before} → {after} (noise alone: {floor})>'

    @property
    def sources(self) -> Mapping[str, str]:
        """Version and recordings, with their digests."""
        provenance = self.workspace.provenance()
        of = {
            f'recording {n}': named(str(r['name']), str(r.get('sha256', '')), 64) for n, r in enumerate(provenance, 1)
        }
        return {'version': __version__, 'seed': str(self.seed), **of}

    @property
    def sentence(self) -> str:
        """The whole answer as one text."""
        return ' '.join(self.sentences())

    def sentences(self) -> list[str]:
        """What is missing, or that nothing is, and which effects may have one cause."""
        rehearsed = [] if self.rehearsal is None else self.rehearsal.sentences()
        return [_missing(self), *(t.sentence for t in ties(self.effects)), *self.small_terms, *rehearsed]

    @property
    def unexplained(self) -> bool:
        """Whether more terms would lower the error on unseen cases than the named effects do."""
        return self.prediction is not None and self.prediction.unexplained

    @property
    def small_terms(self) -> list[str]:
        """What small terms beyond the named effects do together, in a sentence; nothing if they do nothing."""
        return [self.prediction.sentence(self.workspace)] if self.prediction is not None and self.unexplained else []

    @property
    def predicting(self) -> tuple[ActiveEffect, ...]:
        """The effects of the model that predicts best: at least the nuisance and the named ones."""
        return self.fit.coefficients_with_nuisance if self.prediction is None else self.prediction.effects

    def lines(self) -> list[str]:
        """Return the sentences in one line, then what is unknown."""
        unknown = [f'unknown: {u.signature}' for u in self.unknown]
        limits = [f'limit: {x.limit}; {x.further}' for x in self.search.limits]
        return [self.sentence, *unknown, *limits, f'{self.simulations} forward simulations']

    def tree(self) -> dict[str, Any]:
        """Verdict, places, effects, unknown, gaps, provenance."""
        return {
            'verdict': self.verdict,
            'where': self._where(),
            'effects': [effect_tree(e) for e in self.effects],
            'unknown': [
                {
                    'signature': u.signature,
                    'depends_on': list(u.depends_on),
                    'explains': u.explains,
                    'rms': u.rms,
                    'law': None,
                }
                for u in self.unknown
            ],
            'ties': self._ties(),
            'covariance': covariance_tree(self.fit, self.effects),
            'limits': [x.tree() for x in self.search.limits],
            'remainder': None if self.remainder is None else self.remainder.tree(),
            'setup': [],
            'moves': None,
            'remains': self.unexplained,
            'predictive': None if self.prediction is None else self.prediction.tree(),
            'remaining': {'rms': self.gap_after, 'floors': self.floors},
            'rehearsal': None if self.rehearsal is None else self.rehearsal.tree(),
            'gap': self._gap(),
            'nuisance': [{'name': a.effect.name, 'parameters': fitted(a, sd)} for a, sd in self.nuisance],
            'provenance': {
                'version': __version__,
                'seed': self.seed,
                'forward_simulations': self.simulations,
                'recordings': self.workspace.provenance(),
            },
        }

    def table(self) -> Table:
        """One row a parameter of each effect that was named: ``value``, ``sd``, ``unit``, and what speaks for it."""
        rows = [(e, name, entries) for e in self.effects for name, entries in parameters_of(e).items()]
        entries = [t if isinstance(t, dict) else {'value': t, 'sd': 0.0, 'unit': ''} for *_, t in rows]
        return Table(
            text_column('effect', [e.active.label for e, *_ in rows], 'that was missing'),
            [
                text_column('parameter', [name for _, name, _ in rows], 'of the effect'),
                Column(
                    'value', np.array([t['value'] for t in entries], dtype=np.float64), '', 'in the unit of the row'
                ),
                Column('sd', np.array([t['sd'] for t in entries], dtype=np.float64), '', 'its standard deviation'),
                text_column('unit', [t['unit'] for t in entries], 'of the row'),
                Column('delta_bic', np.array([e.delta_bic for e, *_ in rows], dtype=np.float64), '', 'BIC better by'),
                Column('p', np.array([e.p for e, *_ in rows], dtype=np.float64), '', 'over the whole library'),
            ],
            {'verdict': self.verdict, 'gap_before': self.gap_before, 'gap_after': self.gap_after},
        )

    def _where(self) -> list[dict[str, Any]]:
        return [
            {
                'channel': c.channel,
                'recording': self.workspace.names[c.recording],
                'when': [c.when[0], c.when[1]],
                'band_hz': [c.band[0], c.band[1]],
                'depends_on': list(c.depends_on),
                'statistic': number(c.statistic),
                'p': min(max(c.p, 0.0), 1.0),
            }
            for c in self.where.cells
            if c.p < 0.05
        ]

    def _ties(self) -> list[dict[str, Any]]:
        return [
            {
                'share': {'value': t.share, 'sd': t.sd},
                'frequencies_moved': t.moves,
                'causes': [{'name': c.name, 'factor': {'value': c.factor, 'sd': c.sd}} for c in t.causes],
                'sentence': t.sentence,
            }
            for t in ties(self.effects)
        ]

    def _gap(self) -> dict[str, Any]:
        return {
            'unit': self.workspace.unit,
            'before': self.gap_before,
            'after': self.gap_after,
            'floor': self.gap_floor if math.isfinite(self.gap_floor) else None,
            'heldout_before': self.gap_heldout_before,
            'heldout_after': self.gap_heldout_after,
            'per_channel': {
                k: {'before': a, 'after': b, 'heldout': self.heldout_per_channel[k]}
                for k, (a, b) in self.per_channel.items()
            },
        }


@dataclass(frozen=True, eq=False, repr=False)
class RigConclusion(Conclusion):
    """The answer for the rig. Gaps in m (rms of block means over all dots).

    ``setup``: mistakes of the set-up and the recording, with ``values`` that put the rig file right; ``known``: the
    effects that the rig file has already. ``law``: describes what is unknown; it is in no gap and no effect here.
    ``alternative_fits``: complete models that these recordings do not exclude beside ``fit``, also those of mistakes of
    the set-up; ``unsettled``: names of what explains the recordings as well as something in ``fit``.
    ``moves``: by how much at most an estimate is wrong that is not corrected for the effects: dX m, dY m, theta rad.
    ``late``: of PSDs on another clock, in words. ``recordings``: as given; ``search_again``: the same search in others.
    ``rig``: as it was known, with the parameter file it has, if any. ``adopted``: name of the effect that the law
    became, '' if it is none. ``notify``: takes warnings.
    """

    workspace: Workspace
    setup: tuple[Finding, ...]
    values: Mapping[str, object]
    known: tuple[ActiveEffect, ...]
    law: FoundLaw | None
    alternative_fits: tuple[Fit, ...]
    unsettled: tuple[str, ...]
    moves: tuple[float, float, float]
    rig: Rig
    recordings: tuple[Observation, ...]
    search_again: Callable[[Sequence[Observation]], Conclusion]
    params_file: str | Path | None = None
    adopted: str = ''
    notify: Notify = warn_caller
    late: tuple[str, ...] = ()
    rig_source: str = GIVEN_RIG

    def search_in_simulation(self, seed: int) -> Callable[[], Conclusion]:
        """Return the same search in simulated recordings of the found model; ``seed``: of their noise."""
        return partial(self.search_again, rehearsing.simulated_recordings(self, seed))

    @property
    def active_effects(self) -> list[ActiveEffect]:
        """The effects to add to the rig file."""
        return [*self.known, *(e.active for e in self.effects)]

    @property
    def predictive(self) -> dict[str, object]:
        """The effects of the model that predicts best, as a rig file has them below ``effects:`` and ``simulate`` takes
        them; mistakes of the set-up are no effects.
        """
        names = effect_names()
        return dict(effects_to_values([*self.known, *(a for a in self.predicting if a.effect.name in names)]))

    @property
    def model_of_law(self) -> Law | None:
        """The law by the name that it gets; None if there is none, or if it leaves too much to be a model."""
        if self.law is None or self.law.heldout_gap > AS_GOOD * self.gap_floor:
            return None
        return self.law.adopted(self.adopted or 'law')

    @property
    def sources(self) -> Mapping[str, str]:
        """Version, recordings, rig."""
        rig = self.rig_source if self.params_file is None else str(self.params_file)
        return {**super().sources, 'rig': rig}

    def sentences(self) -> list[str]:
        """What is wrong with the set-up, what is missing besides, what that does to an estimate, the law."""
        setup = _setup(self)
        missing = _missing(self, ' besides' if setup else '')
        tied = [t.sentence for t in ties(self.effects)]
        annotated = _as_annotated(self)
        words = (setup, missing, *tied, annotated, _moved(self), law_sentence(self), *self.small_terms)
        return [*filter(None, words), *([] if self.rehearsal is None else self.rehearsal.sentences())]

    def lines(self) -> list[str]:
        """Return the sentences in one line, what puts the set-up right, what would decide, what is unknown."""
        first, *remaining_lines = super().lines()
        out = [first, *self.late, *map(_setup_line, self.setup)]
        numbers = [RIG_NUMBERS[e.name] for e in self.effects if e.name in RIG_NUMBERS]
        out += [f'rig file: {line(key, self.values[key])}' for key in numbers]
        for e in self.effects:
            if e.suggestion is not None:
                out.append(f'to tell {e.active.effect.name} from {", ".join(e.equivalent)}: {e.suggestion.text}')
        return out + remaining_lines

    def tree(self) -> dict[str, Any]:
        """As for any machine, with set-up, moves and law."""
        out = super().tree()
        for unknown, law in zip(out['unknown'], [self.law] if self.law is not None else [], strict=False):
            unknown['law'] = law_tree(law)
        out['setup'] = [{**finding_tree(f), 'evidence': number(f.evidence)} for f in self.setup]
        out['moves'] = dict(zip(('dx_m', 'dy_m', 'theta_rad'), self.moves, strict=True))
        return out

    def adopt(self, name: str) -> Self:
        """Return the answer with its law as the effect ``name``, written to the folder of the user's effects.

        Without a law nothing happens. Raises ConfigError for a name that cannot be, RecordingError if the disk rejects.
        """
        folder = adopting_folder(name)
        if self.law is None:
            return self
        out = replace(self, adopted=name)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if (law := out.model_of_law) is not None:
                replace_file(folder / f'{name}.yaml', _law_file(law).encode())
        except OSError as error:
            raise RecordingError(f'{folder}: cannot be written ({error.strerror or error})') from None
        return out

    def model_yaml(self) -> str:
        """Return the user's parameter file with the effects, comments kept; without one what describes the rig."""
        # Other numbers of the rig file are lines of it.
        effects = [a for a in self.active_effects if a.effect.name not in RIG_NUMBERS]
        if self.adopted and self.law is not None:
            beside = [a for a in self.law.beside if a.effect.name in effect_names()]
            law = self.model_of_law
            laws = [] if law is None else [ActiveEffect(effect_of(law), values_of(law))]
            effects = [*self.known, *beside, *laws]
        return model_yaml(self.params_file, self.rig, effects, self.values, self.notify)

    def files(self) -> dict[str, str]:
        """Return the rig file with the effects, the page, the JSON, and the law as an effect that can be adopted."""
        law = self.model_of_law
        laws = {} if law is None else {'law.yaml': _law_file(law)}
        return {'model.yaml': self.model_yaml(), **super().files(), **laws}


def adopting_folder(name: str) -> Path:
    """Return the folder of the user's effects, for an effect ``name``. Raises ConfigError if there cannot be one."""
    if not name.isidentifier() or name.startswith('_'):
        raise ConfigError(f'{name}: must be a name of letters, digits and underscores, such as base_yields')
    if name in effect_names():
        raise ConfigError(f'{name}: there is an effect of that name; give another')
    folders = effect_folders()
    if not folders:
        raise ConfigError(f'{name}: there is no folder for your effects; set {FOLDERS}')
    return folders[0]


def _law_file(law: Law) -> str:
    return law_text(
        law,
        (
            f'Found by psd-deflection discover {__version__}: no effect of the catalogue explains this.',
            f'Edit it, and put it as NAME.yaml, with name: NAME, into a folder of effects ({FOLDERS}).',
        ),
    )


def model_yaml(
    params_file: str | Path | None,
    rig: Rig,
    effects: Iterable[ActiveEffect],
    values: Mapping[str, object],
    notify: Notify = warn_caller,
) -> str:
    """Return the user's parameter file with ``effects``, comments kept; without one what describes ``rig``.

    ``values``: what was wrong in the rig file, put right. ``notify`` gets a warning if the file cannot be edited.
    """
    given = list(effects)

    def edit(text: str, path: Path) -> str:
        text = with_effects_section(text, effects_to_values(given), path)
        if not values:
            return text
        return with_values(text, values, f'Put right by psd-deflection {__version__}', path)

    return edited_rig_file(params_file, 'model.yaml', lambda: described(rig, given), edit, notify)


def _residual_words(discovery: Conclusion) -> str:
    """What remains, and how many floors it is."""
    after, floor = (
        discovery.workspace.worded(v, discovery.workspace.digits) for v in (discovery.gap_after, discovery.gap_floor)
    )
    if not math.isfinite(discovery.gap_floor):
        return after
    return f'{after}, {discovery.floors:.2f} times the noise floor ({floor})'


def _setup(discovery: RigConclusion) -> str:
    """What is wrong with the set-up, in a sentence, or nothing; with what else the same recording may be of."""
    where: dict[str, dict[str, None]] = {}
    alternatives: dict[str, dict[str, None]] = {}
    for f in discovery.setup:
        if f.by_hand:
            continue
        name = f.name.replace('_', ' ')
        place = ', '.join(filter(None, (_place(f), _seconds(f))))
        where.setdefault(name, {}).update({place: None} if place else {})
        alternatives.setdefault(name, {}).update(dict.fromkeys(other_causes(f)))
    names = []
    for name, places in where.items():
        causes = [or_else(alternatives[name])] if alternatives[name] else []
        details = '; '.join([*places, *causes])
        names.append(f'{name} ({details})' if details else name)
    may_be_effect = any(other in effect_names() for causes in alternatives.values() for other in causes)
    or_effect = ', or one effect is missing' if may_be_effect else ''
    return f'The set-up is not as the rig file or the recording says{or_effect}: {", ".join(names)}.' if names else ''


def or_else(causes: Iterable[str]) -> str:
    """What explains the recordings as well as what is named, in words."""
    return f'or {", ".join(causes)}: this data cannot tell'


def other_causes(finding: Finding) -> list[str]:
    """Mistakes and effects, by name, that explain the recordings as well; another wiring needs more changes."""
    return [name for name in finding.equivalent if name in SETUP or name in effect_names()]


def _setup_line(finding: Finding) -> str:
    """A mistake of the set-up, what else it may be, and what puts it right, in a line."""
    besides = f'({or_else(causes)})' if (causes := other_causes(finding)) else ''
    return f'set-up: {" ".join(filter(None, (finding.name, _place(finding), besides)))}: {finding.fix}'


def _place(finding: Finding) -> str:
    """Where a mistake is; '' if it is in all loads."""
    return '' if finding.where == ' '.join(LOADS) else finding.where


def _seconds(finding: Finding) -> str:
    """How late a load was noted, or how long it took."""
    if not isinstance(finding.value, float) or finding.name not in ('load_time', 'load_delay', 'load_ramp'):
        return ''
    direction = '' if finding.name == 'load_ramp' else ' late' if finding.value > 0.0 else ' early'
    return f'{abs(finding.value):.3g} s{direction}'


STATIC = ('bending_stiffness', 'torsional_stiffness', 'clamp_bending_compliance', 'clamp_torsional_compliance')
"""Effects that change how far a load moves the link at rest; stiffnesses with ``moves_frequency`` its ringing, too."""
LEAST_FACTOR = 1e-3
"""A load is as noted if it is so by this share."""


def _as_annotated(discovery: RigConclusion) -> str:
    """Return what wrong loads would do as the only effects do, in a sentence; nothing if they cannot."""
    effects = [e.active for e in discovery.effects]
    if not effects or any(a.effect.name not in STATIC or a.values.get('moves_frequency') for a in effects):
        return ''
    known, now = (ForwardModel(discovery.rig, [*discovery.known, *more]).physics for more in ((), effects))
    factors = {
        'forces': now.force_compliance / known.force_compliance,
        'torques': now.torque_compliance / known.torque_compliance,
    }
    wrong = [f'{name} {v:.4g} times the noted ones' for name, v in factors.items() if abs(v - 1.0) > LEAST_FACTOR]
    which = {'forces': 'the scale', 'torques': 'the arm'}
    check = ' and '.join(which[w.split()[0]] for w in wrong)
    return f'{" and ".join(wrong).capitalize()} would do the same: check {check}.' if wrong else ''


def _moved(discovery: RigConclusion) -> str:
    """What the effects do to an estimate, in a sentence, or nothing."""
    if not discovery.effects:
        return ''
    dx, dy, theta = (1e6 * v for v in discovery.moves)
    effects = [e.active.effect for e in discovery.effects]
    stays = dict.fromkeys(effect.name for effect in effects if effect.stage in STAGES and not effect.corrected)
    uncorrected = f'An estimate is not corrected for {", ".join(stays)}.' if stays else ''
    if max(dx, dy, theta) < SHOWN and uncorrected:
        return uncorrected
    if max(dx, dy, theta) < SHOWN:
        return 'The estimates of the pose are right without; the simulated motion, and with it the wrench, is not.'
    them = 'it' if len(discovery.effects) == 1 else 'them'
    sizes = (('ΔX', dx, 'µm'), ('ΔY', dy, 'µm'), ('θ', theta, 'µrad'))
    words = ', '.join(f'{name} {size:.3g} {unit}' for name, size, unit in sizes if size >= SHOWN)
    return ' '.join(filter(None, (f'Without {them} an estimate is wrong by up to {words}.', uncorrected)))


def law_sentence(discovery: RigConclusion) -> str:
    """Return the law for what is unknown, in a sentence, or nothing."""
    if discovery.law is None:
        return ''
    law = discovery.law
    expressions = '; '.join(e.expression for e in law.laws)
    words = f'What remains follows a law ({law.law.stage}, {law.law.kind}): {expressions}'
    beside = [a.effect.name for a in law.beside]
    named = {e.active.effect.name for e in discovery.effects}
    with_law = f'; on unseen load cases it leaves {1e6 * law.heldout_gap:.3f} µm'
    also = f', beside {", ".join(beside)}' if beside and set(beside) != named else ''
    return f'{words}{also}{with_law}.'


def _missing(discovery: Conclusion, besides: str = '') -> str:
    """What is missing, in a sentence. ``besides``: a word if the set-up was wrong too."""
    ws, residual = discovery.workspace, _residual_words(discovery)
    before = f'{ws.display_scale[0] * discovery.gap_before:{ws.digits}}'
    if discovery.verdict == 'nothing_missing':
        if not math.isfinite(discovery.gap_floor):
            # Without a stated noise nobody knows how large what remains should be.
            return (
                f'Nothing is missing{besides} as far as these readings show: {residual} remains and follows nothing, '
                'as noise does. How exact the readings are is not stated.'
            )
        return f'Nothing is missing{besides}: the gap is {residual}.'
    parts = []
    for e in discovery.effects:
        text = e.active.label
        if e.equivalent:
            text += f' ({or_else(e.equivalent)})'
        parts.append(text)
    sizes = '; '.join(f'{e.active.effect.name} {size}' for e in discovery.effects if (size := size_of(e)))
    fitted = f' Fitted: {sizes}.' if sizes else ''
    named = ' and '.join(parts)
    if discovery.verdict == 'effects_found':
        is_are, them = ('is', 'it') if len(parts) == 1 else ('are', 'them')
        # The gap is that before both: nobody can say what share of it each closes.
        way = f'adding {them} and putting the set-up right together close' if besides else f'adding {them} closes'
        return f'{named} {is_are} missing from the model{besides}; {way} the gap from {before} to {residual}.{fitted}'
    named += ' and the set-up put right' if besides and named else ''
    if not any(u.unexplained for u in discovery.unknown):
        return (
            f'{named} close the gap from {before} to {residual}, but their sizes '
            f'are tied: one effect that is not in the catalogue is likelier.'
        )
    if named:
        explains = 'explains' if len(parts) == 1 and not besides else 'explain'
        return (
            f'{named} {explains} part, but an unknown effect remains: the gap goes from {before} '
            f'{ws.display_scale[1]} to {residual}.{fitted}'
        )
    return f'An effect that is not in the catalogue: the gap is {residual}.'
