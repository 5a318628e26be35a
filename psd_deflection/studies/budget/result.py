"""The answer of budget: each cause's error, the totals, the chart."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from psd_deflection.base.pages import picture, table
from psd_deflection.base.tables import columns
from psd_deflection.studies.budget.evaluate import Budget
from psd_deflection.studies.budget.term import Contribution, Kind
from psd_deflection.studies.study import PageSection, StudyResult

SHOWN = np.array([1e6, 1e6, math.degrees(1e3)])
"""µm, µm and mdeg of m, m and rad."""
UNITS = ('ΔX µm', 'ΔY µm', 'θ mdeg')


@dataclass(frozen=True, eq=False)
class Budgeted(StudyResult):
    """``budget``: every cause at ``load`` (Fx N, Fy N, Tz N m). ``sampled``: of ``draws`` random draws with ``seed``.

    ``rig_file``: the name of the rig's, '' if it has none.
    """

    study, json_name = 'budget', 'budget.json'
    title = 'Error budget'

    budget: Budget
    load: tuple[float, float, float]
    sampled: Contribution | None = None
    draws: int = 0
    seed: int = 0
    rig_file: str = ''

    @property
    def sources(self) -> Mapping[str, str]:
        """The rig file."""
        return {'rig': self.rig_file} if self.rig_file else {}

    def sentences(self) -> list[str]:
        """The total, and the cause that gives most of it."""
        at, total = self.budget.at, self.budget.total()
        out = [f'A single estimate is wrong by {_words(total)} (rms), method {at.method}.']
        name, share = max(
            ((cause.name, float(self.budget.shares(line).max())) for cause, line in self.budget.lines),
            key=lambda entry: entry[1],
        )
        out.append(f'The largest cause is {name}: up to {share:.0%} of the mean square of an axis.')
        if self.sampled is not None:
            out.append(f'{self.draws} random draws of all causes at once give {_words(self.sampled)}.')
        return out

    def lines(self) -> list[str]:
        """The situation, the table of all causes, the totals."""
        out = [self._situation(), '', *columns(self._causes(), left=3).splitlines()]
        out += ['', *columns(self._totals()).splitlines()]
        if self.sampled is not None:
            dx, dy, theta = _figures(self.sampled)
            out += ['', f'Monte Carlo, {self.draws} draws of everything at once (seed {self.seed}):']
            out.append(f'total     ΔX {dx} µm  ΔY {dy} µm  θ {theta} mdeg')
        return out

    def sections(self) -> Iterable[PageSection]:
        """The chart, the totals, every cause."""
        from psd_deflection.studies.budget.pictures import chart

        head, *rows = self._causes()
        totals_head, *totals = self._totals()
        drawn = picture(chart(self.budget), 'every cause of error beside the total, for ΔX, ΔY and θ')
        return [
            PageSection('', (f'<p class=quiet>{self._situation()}</p>',)),
            PageSection('Every cause beside the total', (drawn,)),
            PageSection('Totals', (table(totals_head, totals),)),
            PageSection('Every cause', (table(head, rows),)),
        ]

    def tree(self) -> dict[str, Any]:
        """SI, (ΔX, ΔY, θ) in this order."""
        budget = self.budget
        totals = {kind.name.lower(): _si(budget.total(kind)) for kind in Kind}
        totals['total'] = _si(budget.total())
        if self.sampled is not None:
            totals['monte_carlo'] = _si(self.sampled)
        return {
            'unit': ['m', 'm', 'rad'],
            'load': list(self.load),
            'pose': budget.at.pose.tolist(),
            'method': budget.at.method,
            'terms': [
                {
                    'name': cause.name,
                    'row': cause.row,
                    'kind': cause.kind.name.lower(),
                    'formula': cause.formula,
                    'inputs': {name: budget.at[name] for name in cause.inputs},
                    **_si(line),
                    'share': budget.shares(line).tolist(),
                }
                for cause, line in budget.lines
            ],
            'totals': totals,
        }

    def _situation(self) -> str:
        at, load = self.budget.at, self.load
        dx, dy, theta = at.pose.tolist()
        return (
            f'Load ({load[0]:g} N, {load[1]:g} N, {load[2]:g} N m): ΔX {dx * 1e3:.4f} mm, ΔY {dy * 1e3:.4f} mm, '
            f'θ {math.degrees(theta):.4f} deg; method {at.method}; mean of {at.rig.estimator.block_size} samples'
        )

    def _causes(self) -> list[list[str]]:
        rows = [['term', 'Table 3.1', 'kind', *UNITS, 'ΔX %', 'ΔY %', 'θ %']]
        for cause, line in self.budget.lines:
            shares = [f'{100.0 * v:.1f}' for v in self.budget.shares(line).tolist()]
            rows.append([cause.name, cause.row or '-', cause.kind.value, *_figures(line), *shares])
        return rows

    def _totals(self) -> list[list[str]]:
        rows = [['', *UNITS]]
        rows += [[f'all {kind.value} terms', *_figures(self.budget.total(kind))] for kind in Kind]
        return [*rows, ['total', *_figures(self.budget.total())]]


def _figures(line: Contribution) -> list[str]:
    return [f'{v:.3f}' for v in (line.rms * SHOWN).tolist()]


def _words(line: Contribution) -> str:
    dx, dy, theta = (f'{v:.3g}' for v in (line.rms * SHOWN).tolist())
    return f'ΔX {dx} µm, ΔY {dy} µm, θ {theta} mdeg'


def _si(line: Contribution) -> dict[str, Any]:
    return {'rms': line.rms.tolist(), 'bias': line.bias.tolist(), 'covariance': line.covariance.tolist()}
