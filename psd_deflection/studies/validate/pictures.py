"""The pictures of the page of validate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from psd_deflection.base.pages import picture, table
from psd_deflection.records import FloatArray
from psd_deflection.studies.axes import SHOWN, SHOWN_UNITS, SYMBOLS
from psd_deflection.studies.study import PageSection
from psd_deflection.studies.validate.agreement import Agreement

MEASURED, REFERENCE, DIFFERENCE, LIMIT = '#4c72b0', '#c44e52', '#333333', '#8c8c8c'
DRAWN = 4000
"""Points of a picture at most."""


@dataclass(frozen=True)
class DrawnAgreement:
    """What is drawn: ``t`` (k,), s; ``estimate`` and ``reference`` (k, 3), m, m, rad; how the axes agree."""

    solver: str
    t: FloatArray
    estimate: FloatArray
    reference: FloatArray
    agreements: Sequence[Agreement]


def sections(found: DrawnAgreement, rows: Sequence[Sequence[str]]) -> list[PageSection]:
    """The page below the sentences; ``rows``: the table of all solvers, its head first."""
    head, *cells = rows
    shares = (
        '<p class=quiet>Estimate minus reference. The last column is the rms in percent of the largest deflection.</p>'
    )
    altman = (
        '<p class=quiet>Differences over means (Bland and Altman 1986): the lines are the bias and the limits '
        'within which 95 % of the differences lie.</p>'
    )
    over_time = picture(_over_time(found), 'estimate and reference over time, and differences')
    return [
        PageSection('Every solver', (shares, table(head, cells))),
        PageSection('Over time', (over_time,)),
        PageSection('Agreement', (altman, picture(_bland_altman(found), 'differences over means'))),
        PageSection('One against the other', (picture(_scatter(found), 'estimate over reference'),)),
    ]


def _thinned(found: DrawnAgreement) -> tuple[Any, Any, Any]:
    every = max(1, math.ceil(len(found.t) / DRAWN))
    return found.t[::every], found.estimate[::every], found.reference[::every]


def _over_time(found: DrawnAgreement) -> Figure:
    t, estimate, reference = _thinned(found)
    figure = Figure(figsize=(10, 8), layout='constrained')
    axes = figure.subplots(6, 1, sharex=True, height_ratios=[2, 1] * 3)
    for i in range(3):
        upper, lower = axes[2 * i], axes[2 * i + 1]
        upper.plot(t, SHOWN[i] * estimate[:, i], color=MEASURED, lw=0.9, label=f'estimate ({found.solver})')
        upper.plot(t, SHOWN[i] * reference[:, i], 'o', ms=2.5, mfc='none', color=REFERENCE, label='reference')
        upper.set_ylabel(f'{SYMBOLS[i]} / {SHOWN_UNITS[i]}')
        lower.plot(t, SHOWN[i] * (estimate - reference)[:, i], '.', ms=2, color=DIFFERENCE)
        lower.set_ylabel('difference')
        for axis in (upper, lower):
            axis.grid(alpha=0.25)
    axes[0].legend(loc='upper right', ncols=2, frameon=False)
    axes[-1].set_xlabel('time / s, by the clock of the samples')
    return figure


def _bland_altman(found: DrawnAgreement) -> Figure:
    _, estimate, reference = _thinned(found)
    figure = Figure(figsize=(10, 3.6), layout='constrained')
    for i, axis in enumerate(figure.subplots(1, 3)):
        a = found.agreements[i]
        mean = SHOWN[i] * 0.5 * (estimate + reference)[:, i]
        axis.plot(mean, SHOWN[i] * (estimate - reference)[:, i], '.', ms=3, color=MEASURED)
        axis.axhline(SHOWN[i] * a.bias, color=DIFFERENCE, lw=1)
        for limit in a.limits:
            axis.axhline(SHOWN[i] * limit, color=LIMIT, lw=1, ls='--')
        axis.set_xlabel(f'mean of both, {SYMBOLS[i]} / {SHOWN_UNITS[i]}')
        axis.set_ylabel(f'difference / {SHOWN_UNITS[i]}')
        axis.grid(alpha=0.25)
    return figure


def _scatter(found: DrawnAgreement) -> Figure:
    _, estimate, reference = _thinned(found)
    figure = Figure(figsize=(10, 3.6), layout='constrained')
    for i, axis in enumerate(figure.subplots(1, 3)):
        axis.plot(SHOWN[i] * reference[:, i], SHOWN[i] * estimate[:, i], '.', ms=3, color=MEASURED)
        both = np.concatenate([reference[:, i], estimate[:, i]])
        ends = SHOWN[i] * np.array([np.nanmin(both), np.nanmax(both)])
        axis.plot(ends, ends, color=LIMIT, lw=1)
        axis.set_xlabel(f'reference {SYMBOLS[i]} / {SHOWN_UNITS[i]}')
        axis.set_ylabel(f'estimate / {SHOWN_UNITS[i]}')
        axis.grid(alpha=0.25)
    return figure
