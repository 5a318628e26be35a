# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The answer of budget: each cause's error, the totals, the chart."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from psd_deflection.base.axes import AXES as POSE
from psd_deflection.base.axes import SHOWN as FACTORS
from psd_deflection.base.axes import SHOWN_UNITS, SYMBOLS
from psd_deflection.base.axes import UNITS as POSE_UNITS
from psd_deflection.base.pages import table
from psd_deflection.base.tables import Column, Table, columns, columns_of, text_column
from psd_deflection.records import FloatArray
from psd_deflection.studies.budget.evaluate import PROBABILITY, Budget, Interval, difference
from psd_deflection.studies.budget.pictures import LEAST, bars_of
from psd_deflection.studies.budget.term import Cause, Contribution, Kind
from psd_deflection.studies.study import PageSection, StudyResult

SHOWN = np.array(FACTORS)
UNITS = tuple(f'{symbol} {unit}' for symbol, unit in zip(SYMBOLS, SHOWN_UNITS, strict=True))


@dataclass(frozen=True, eq=False, repr=False)
class Budgeted(StudyResult):
    """``budget``: every cause at ``load`` (Fx N, Fy N, Tz N m). ``sampled``: of ``draws`` random draws with ``seed``.

    ``interval``: of as many draws from the declared distributions. ``rig_file``: the name of the rig's, '' if it has
    none.
    """

    study, json_name = 'budget', 'budget.json'
    title = 'Error budget'

    budget: Budget
    load: tuple[float, float, float]
    sampled: Contribution | None = None
    interval: Interval | None = None
    draws: int = 0
    seed: int = 0
    rig_file: str = ''

    @property
    def sources(self) -> Mapping[str, str]:
        """The rig file."""
        return {'rig': self.rig_file} if self.rig_file else {}

    def sentences(self) -> list[str]:
        """Return the total, and the cause that gives most of it."""
        at, total = self.budget.at, self.budget.total()
        out = [f'A single estimate is wrong by {_words(total)} (rms), method {at.method}.']
        name, share = max(
            ((cause.name, float(self.budget.shares(line).max())) for cause, line in self.budget.lines),
            key=lambda entry: entry[1],
        )
        out.append(f'The largest cause is {name}: up to {share:.0%} of the mean square of an axis.')
        out.append(f'Expanded uncertainty for 95 %: {in_words(self.budget.expanded().uncertainty)}.')
        if self.sampled is not None:
            out.append(f'{self.draws} random draws of all causes at once give {_words(self.sampled)}.')
        if self.interval is not None:
            out.append(self._compared(self.interval))
        return out

    def lines(self) -> list[str]:
        """Return the situation, the table of all causes, the totals."""
        out = [self._situation(), '', *columns(self.cause_rows(), align_left=4).splitlines()]
        out += ['', *columns(self.total_rows()).splitlines()]
        out += ['', *columns(self.expanded_rows()).splitlines()]
        if self.sampled is not None:
            dx, dy, theta = _figures(self.sampled)
            out += ['', f'Monte Carlo, {self.draws} draws of everything at once (seed {self.seed}):']
            out.append(f'total     ΔX {dx} µm  ΔY {dy} µm  θ {theta} mdeg')
        if self.interval is not None:
            out.append(self._compared(self.interval))
        return out

    def sections(self) -> Iterable[PageSection]:
        """Return the chart, the totals, every cause."""
        head, *rows = self.cause_rows()
        totals_head, *totals = self.total_rows()
        return [
            PageSection('', (f'<p class=quiet>{self._situation()}</p>',)),
            PageSection('Every cause beside the total', (_BARS, bars_of(self.budget))),
            PageSection('Totals', (table(totals_head, totals),)),
            PageSection('Every cause', (table(head, rows),)),
            PageSection('Expanded uncertainty (GUM)', (table(*_split(self.expanded_rows())), _RULES)),
            PageSection('Every error parameter', (table(*_split(parameter_rows(self.budget))),)),
        ]

    def tree(self) -> dict[str, Any]:
        """SI, (ΔX, ΔY, θ) in this order."""
        budget = self.budget
        totals = {kind.name.lower(): _si(budget.total(kind)) for kind in Kind}
        totals['total'] = _si(budget.total())
        if self.sampled is not None:
            totals['monte_carlo'] = _si(self.sampled)
        expanded = self.budget.expanded()
        stated = {
            'probability': PROBABILITY,
            **{name: value.tolist() for name, value in expanded._asdict().items()},
            'freedom': [_or_none(value) for value in expanded.freedom.tolist()],
        }
        if self.interval is not None:
            stated['monte_carlo'] = {'half': self.interval.half.tolist(), 'middle': self.interval.middle.tolist()}
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
                    'type': type_of(cause),
                    'distribution': cause.distribution.value,
                    'freedom': _or_none(cause.freedom(budget.at)),
                    'parameters': [
                        {'name': s.name, 'u': s.deviation, 'unit': cause.unit, 'sensitivity': s.coefficient.tolist()}
                        for s in sensitivities
                    ],
                }
                for (cause, line), sensitivities in zip(budget.lines, budget.sensitivities, strict=True)
            ],
            'totals': totals,
            'expanded': stated,
        }

    def table(self) -> Table:
        """Return one row a cause: its kind, rms and share of the mean square for dX, dY, theta; m, m, rad."""
        lines = self.budget.lines
        rms = np.array([line.rms for _, line in lines])
        share = np.array([self.budget.shares(line) for _, line in lines])
        causes = [cause for cause, _ in lines]
        return Table(
            text_column('cause', [cause.name for cause in causes], 'source of error'),
            [
                text_column('kind', [cause.kind.value for cause in causes], 'how it acts'),
                Column('freedom', np.array([c.freedom(self.budget.at) for c in causes]), '', 'degrees of freedom'),
                *columns_of(rms, [f'rms_{a}' for a in POSE], POSE_UNITS, [f'error of {a}' for a in POSE]),
                *columns_of(share, [f'share_{a}' for a in POSE], ('',) * 3, ['of the mean square'] * 3),
            ],
            {'method': self.budget.at.method, 'load': self.load},
        )

    def _situation(self) -> str:
        at, load = self.budget.at, self.load
        dx, dy, theta = at.pose.tolist()
        return (
            f'Load ({load[0]:g} N, {load[1]:g} N, {load[2]:g} N m): ΔX {dx * 1e3:.4f} mm, ΔY {dy * 1e3:.4f} mm, '
            f'θ {math.degrees(theta):.4f} deg; method {at.method}; mean of {at.rig.estimator.block_size} samples'
        )

    def cause_rows(self) -> list[list[str]]:
        """Return a row of words for each cause: its name, kind, type, degrees of freedom, size and share."""
        rows = [['term', 'Table 3.1', 'kind', 'type', 'ν', *UNITS, 'ΔX %', 'ΔY %', 'θ %']]
        for cause, line in self.budget.lines:
            shares = [f'{100.0 * v:.1f}' for v in self.budget.shares(line).tolist()]
            freedom = freedom_words(cause.freedom(self.budget.at))
            head = [cause.name, cause.row or '-', cause.kind.value, type_of(cause), freedom]
            rows.append([*head, *_figures(line), *shares])
        return rows

    def expanded_rows(self) -> list[list[str]]:
        """u_c, nu_eff, k, U, and what the draws say."""
        expanded = self.budget.expanded()
        rows = [['', *UNITS], ['standard uncertainty u_c', *display_values(expanded.standard)]]
        rows.append(['effective degrees of freedom ν_eff', *map(freedom_words, expanded.freedom.tolist())])
        rows.append(['coverage factor k, 95 %', *(f'{k:.3f}' for k in expanded.factor.tolist())])
        rows.append(['known bias b, not corrected', *display_values(expanded.bias)])
        rows.append(['expanded uncertainty U = k u_c + |b|', *display_values(expanded.uncertainty)])
        if self.interval is not None:
            rows.append(['Monte Carlo: half of the 95 % interval', *display_values(self.interval.half)])
            off = difference(expanded, self.interval).tolist()
            rows.append(['k u_c beside it, %', *(f'{100.0 * v:+.1f}' for v in off)])
        return rows

    def _compared(self, interval: Interval) -> str:
        """Return the GUM's interval beside that of the draws."""
        off = difference(self.budget.expanded(), interval).tolist()
        each = ', '.join(f'{name} {100.0 * v:+.1f} %' for name, v in zip(SYMBOLS, off, strict=True))
        return (
            f'{self.draws} draws of the declared distributions (GUM Supplement 1) have 95 % of the errors within '
            f'{in_words(interval.half)}; k u_c differs by {each}.'
        )

    def total_rows(self) -> list[list[str]]:
        """Return a row of words for the total of each kind and of all causes."""
        rows = [['', *UNITS]]
        rows += [[f'all {kind.value} terms', *_figures(self.budget.total(kind))] for kind in Kind]
        return [*rows, ['total', *_figures(self.budget.total())]]


_BARS = (
    f'<p class=quiet>Standard deviation or known bias; the bars are logarithmic, from {LEAST:g} of the total on.</p>'
)
_RULES = (
    '<p class=quiet>JCGM 100:2008: u_c is the root of the sum of the squares of the causes; ν_eff by '
    'Welch-Satterthwaite (G.2b), each cause as one, down to a whole number; k is the quantile of Student’s t for 95 %; '
    'a bias that is not corrected is added (F.2.4.5). Type A: from a series of observations; B: from anything else. '
    'An assumption has ν = 1/(2 r²), r its assumption_doubt (G.3).</p>'
)


def type_of(cause: Cause) -> str:
    """Return a or B."""
    return 'A' if cause.observed else 'B'


def _or_none(freedom: float) -> float | None:
    """JSON has no infinity."""
    return None if math.isinf(freedom) else freedom


def freedom_words(freedom: float) -> str:
    """Return a number, or ∞."""
    return '∞' if math.isinf(freedom) else f'{freedom:.0f}'


def parameter_rows(budget: Budget) -> list[list[str]]:
    """Of every error parameter what a sum by hand needs, the head first; contributions in µm, µm, mdeg."""
    rows = [['cause', 'parameter', 'type', 'distribution', 'u', 'unit', 'ν', *(f'c {a}' for a in SYMBOLS), *UNITS]]
    for (cause, _), sensitivities in zip(budget.lines, budget.sensitivities, strict=True):
        freedom = freedom_words(cause.freedom(budget.at))
        for s in sensitivities:
            head = [cause.name, s.name, type_of(cause), cause.distribution.value, f'{s.deviation:.6g}', cause.unit]
            slopes = [f'{c:.6g}' for c in s.coefficient.tolist()]
            rows.append([*head, freedom, *slopes, *display_values(np.abs(s.coefficient) * s.deviation)])
    return rows


def _split(rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
    head, *body = rows
    return head, body


def display_values(values: FloatArray) -> list[str]:
    """(3,) m, m, rad in µm, µm and mdeg."""
    return [f'{v:.3f}' for v in (values * SHOWN).tolist()]


def in_words(values: FloatArray) -> str:
    """(3,) m, m, rad for a sentence."""
    dx, dy, theta = (f'{v:.3g}' for v in (values * SHOWN).tolist())
    return f'ΔX {dx} µm, ΔY {dy} µm, θ {theta} mdeg'


def _figures(line: Contribution) -> list[str]:
    return display_values(line.rms)


def _words(line: Contribution) -> str:
    return in_words(line.rms)


def _si(line: Contribution) -> dict[str, Any]:
    return {'rms': line.rms.tolist(), 'bias': line.bias.tolist(), 'covariance': line.covariance.tolist()}
