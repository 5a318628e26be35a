# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Search, plan, record, search again, until one explanation is left or no recording would help."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import yaml

from psd_deflection.base.tables import Table
from psd_deflection.recordings.observation import Observation
from psd_deflection.studies.discover.experiment import Limits
from psd_deflection.studies.discover.planning import Plan, plan_next
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.study import PageSection, StudyResult

Outcome = Literal['unique', 'limits', 'recordings']
SCRIPT, LISTED = 'next_loads.csv', 'next.yaml'
"""Files of the loads that are planned, and of the list for the next search."""


@dataclass(frozen=True, eq=False, repr=False)
class LoopResult(StudyResult):
    """``discovery``: the last answer. ``plans``: those that were carried out. ``open``: the one that was not, if
    alternatives are left. ``outcome``: one explanation is left; no recording within the limits tells the rest apart; or
    no more recordings were allowed. None: it was only planned.
    """

    study, json_name = 'discover', 'result.json'
    title = Discovery.title

    discovery: Discovery
    plans: tuple[Plan, ...]
    open: Plan | None
    outcome: Outcome | None

    @property
    def sources(self) -> Mapping[str, str]:
        """Those of the answer."""
        return self.discovery.sources

    @property
    def sentence(self) -> str:
        """The outcome, or the plan, in one sentence."""
        count = len(self.plans)
        after = f'after {count} more recording{"" if count == 1 else "s"}' if count else 'without a further recording'
        if self.outcome is None:
            if self.open is None:
                return (
                    'No other effect explains the recordings as well: there is nothing to tell apart by a further one.'
                )
            return self.open.sentence
        if self.outcome == 'unique':
            return f'The answer is unique {after}.'
        if self.outcome == 'limits' and self.open is not None:
            return f'The answer is as far as it can be {after}. {self.open.sentence}'
        return f'The answer is not unique {after}, and no more were allowed.'

    def sentences(self) -> list[str]:
        """Those of the answer, then the outcome."""
        return [*self.discovery.sentences(), self.sentence]

    def lines(self) -> list[str]:
        """Those of the answer, what was recorded, the outcome or the plan with its table."""
        made = [f'{recorded_name(i)}: {p.words}' for i, p in enumerate(self.plans, start=1)]
        out = [*self.discovery.lines(), *made]
        if self.outcome is None and self.open is not None:
            return [*out, '', self.sentence, '', *self.open.table.split('\n')]
        return [*out, self.sentence]

    def tree(self) -> dict[str, Any]:
        """That of the answer, with the plan and what was recorded."""
        out = {**self.discovery.tree(), 'next': None if self.open is None else self.open.tree()}
        if self.outcome is not None:
            made = [{'file': recorded_name(i), **p.tree()} for i, p in enumerate(self.plans, start=1)]
            out['run'] = {'outcome': self.outcome, 'sentence': self.sentence, 'recordings': made}
        return out

    def table(self) -> Table:
        """That of the answer."""
        return self.discovery.table()

    def sections(self) -> Iterable[PageSection]:
        """Those of the answer."""
        return self.discovery.sections()

    def adopt(self, name: str) -> LoopResult:
        """See :meth:`Discovery.adopt`."""
        return replace(self, discovery=self.discovery.adopt(name))

    def files(self) -> dict[str, str]:
        """Those of the answer; the list for the next search, and the loads that are planned."""
        out = {**self.discovery.files(), self.json_name: self.json()}
        if self.outcome is not None:
            return {**out, LISTED: _listed([(recorded_name(i), p) for i, p in enumerate(self.plans, start=1)])}
        if self.open is not None and self.open.useful:
            out |= {SCRIPT: self.open.loads_csv, LISTED: _listed([('next.csv', self.open)])}
        return out


def recorded_name(number: int) -> str:
    """Return the file of a recording that was planned and made; ``number`` counts from 1."""
    return f'next_{number}.csv'


def _listed(made: Sequence[tuple[str, Plan]]) -> str:
    """Return the list of recordings that were made or are to be made, with the parameters that differ in each."""
    tree = [{'recording': name, 'overrides': dict(plan.setting.changes)} for name, plan in made]
    return yaml.safe_dump(tree, sort_keys=False)


def next_of(discovery: Discovery, limits: Limits | None = None) -> Plan | None:
    """Return the next recording after a search; None if it left no alternatives."""
    return plan_next(discovery.workspace, discovery.fit, discovery.alternative_fits, limits)


def planned(discovery: Discovery, limits: Limits | None = None) -> LoopResult:
    """Return the answer with the plan of the next recording, which nobody makes here."""
    return LoopResult(discovery, (), next_of(discovery, limits), None)


def run_loop(
    recordings: Sequence[Observation],
    search: Callable[[Sequence[Observation]], Discovery],
    record: Callable[[Plan, int], Observation],
    *,
    limits: Limits | None = None,
    most: int = 3,
    progress: Callable[[str], None] = lambda _: None,
) -> LoopResult:
    """``search`` ``recordings``, and ``record`` what is planned (its number counts from 1) until the answer is unique.

    ``most``: how many further recordings are made.
    """
    known, plans = list(recordings), list[Plan]()
    while True:
        discovery = search(known)
        progress('planning')
        plan = next_of(discovery, limits)
        # An alternative with more parameters that came out as the named effect would be has nothing left that could be
        # tested: nothing within the limits needs its further ones.
        needed = any(alternative.parameters <= discovery.fit.parameters for alternative in discovery.alternative_fits)
        if plan is None or not (plan.useful or (discovery.unsettled and needed)):
            return LoopResult(discovery, tuple(plans), None, 'unique')
        if not plan.useful:
            return LoopResult(discovery, tuple(plans), plan, 'limits')
        if len(plans) == most:
            return LoopResult(discovery, tuple(plans), plan, 'recordings')
        plans.append(plan)
        progress(f'recording {len(plans)}')
        known.append(record(plan, len(plans)))
