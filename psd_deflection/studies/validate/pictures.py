# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pictures of the page of validate."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.base.axes import SHOWN, SHOWN_UNITS, SYMBOLS
from psd_deflection.base.charts import SMALL, Chart, Panel, Rule, Series, TimeAxis
from psd_deflection.base.pages import table
from psd_deflection.records import FloatArray, Moment
from psd_deflection.studies.study import PageSection
from psd_deflection.studies.validate.agreement import Agreement


@dataclass(frozen=True)
class DrawnAgreement:
    """What is drawn: ``t`` (k,), s; ``estimate`` and ``reference`` (k, 3), m, m, rad; how the axes agree.

    ``marks``: by the clock of the samples, as ``t``.
    """

    solver: str
    t: FloatArray
    estimate: FloatArray
    reference: FloatArray
    agreements: Sequence[Agreement]
    marks: Sequence[Moment]


def sections(drawn: DrawnAgreement, rows: Sequence[Sequence[str]]) -> list[PageSection]:
    """Return the page below the sentences; ``rows``: the table of solvers, its head first."""
    head, *cells = rows
    shares = (
        '<p class=quiet>Estimate minus reference. The last column is the rms in percent of the largest deflection.</p>'
    )
    altman = (
        '<p class=quiet>Differences over means (Bland and Altman 1986): the lines are the bias and the limits '
        'within which 95 % of the differences lie.</p>'
    )
    return [
        PageSection('Agreement by solver', (shares, table(head, cells))),
        PageSection('Over time', (_over_time(drawn),)),
        PageSection('Agreement', (altman, _bland_altman(drawn))),
        PageSection('One against the other', (_scatter(drawn),)),
    ]


def _over_time(drawn: DrawnAgreement) -> Chart:
    panels = []
    along = TimeAxis('by the clock of the samples', drawn.marks)
    for i, (symbol, unit) in enumerate(zip(SYMBOLS, SHOWN_UNITS, strict=True)):
        estimate, reference = SHOWN[i] * drawn.estimate[:, i], SHOWN[i] * drawn.reference[:, i]
        both = (
            Series('reference', drawn.t, reference, 'red', 'rings'),
            Series(f'estimate ({drawn.solver})', drawn.t, estimate, 'blue'),
        )
        difference = (Series('', drawn.t, estimate - reference, 'text', 'points'),)
        panels.append(Panel(both, along, f'{symbol} / {unit}'))
        panels.append(Panel(difference, along, f'{symbol}: difference / {unit}', height=90))
    return Chart('estimate and reference over time, and differences', panels)


def _bland_altman(drawn: DrawnAgreement) -> Chart:
    panels = []
    for i, (symbol, unit) in enumerate(zip(SYMBOLS, SHOWN_UNITS, strict=True)):
        agreement = drawn.agreements[i]
        mean = SHOWN[i] * 0.5 * (drawn.estimate + drawn.reference)[:, i]
        difference = Series('', mean, SHOWN[i] * (drawn.estimate - drawn.reference)[:, i], 'blue', 'points')
        rules = [Rule(SHOWN[i] * agreement.bias, 'bias', across=True, colour='text')]
        rules += [Rule(SHOWN[i] * limit, across=True) for limit in agreement.limits]
        label = f'{symbol}: difference / {unit}'
        panels.append(Panel((difference,), f'{symbol}: mean of both / {unit}', label, rules=rules, height=SMALL))
    return Chart('differences over means', panels, beside=3)


def _scatter(drawn: DrawnAgreement) -> Chart:
    panels = []
    for i, (symbol, unit) in enumerate(zip(SYMBOLS, SHOWN_UNITS, strict=True)):
        estimate, reference = SHOWN[i] * drawn.estimate[:, i], SHOWN[i] * drawn.reference[:, i]
        both = np.concatenate([reference, estimate])
        ends = np.array([np.nanmin(both), np.nanmax(both)])
        curves = (Series('equal', ends, ends, 'quiet'), Series('', reference, estimate, 'blue', 'points'))
        panels.append(Panel(curves, f'{symbol}: reference / {unit}', f'{symbol}: estimate / {unit}', height=SMALL))
    return Chart('estimate over reference', panels, beside=3)
