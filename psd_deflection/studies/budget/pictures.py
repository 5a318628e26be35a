# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The bars of an error budget, for its page and for a file."""

from typing import NamedTuple

import numpy as np

from psd_deflection.base.axes import SHOWN, SHOWN_UNITS, SYMBOLS
from psd_deflection.base.charts import Colour
from psd_deflection.base.drawings import BarColumn, Bars
from psd_deflection.records import FloatArray
from psd_deflection.studies.budget.evaluate import Budget
from psd_deflection.studies.budget.term import Kind

TITLES = tuple(f'{symbol}, {unit}' for symbol, unit in zip(SYMBOLS, SHOWN_UNITS, strict=True))
LEAST = 1e-3
"""Share of the total at which a bar begins."""

COLOURS: dict[Kind, Colour] = {Kind.PER_ESTIMATE: 'blue', Kind.SYSTEMATIC: 'red', Kind.KNOWN: 'quiet'}


class DrawnCause(NamedTuple):
    """What the chart has of a cause: ``values`` (3,) µm, µm, mdeg."""

    name: str
    kind: Kind
    values: FloatArray


def plotted_causes(budget: Budget) -> tuple[list[DrawnCause], FloatArray]:
    """Return every cause that does something, the largest first, and the total (3,)."""
    factors = np.array(SHOWN)
    total = budget.total().rms * factors
    # What does nothing, or only rounds, has no place on a logarithmic axis.
    least = 1e-9 * budget.total().rms
    causes = [
        DrawnCause(f'{cause.name} ({cause.row})' if cause.row else cause.name, cause.kind, line.rms * factors)
        for cause, line in budget.lines
        if np.any(line.rms > least)
    ]
    causes.sort(key=lambda cause: -float(np.max(cause.values / np.where(total > 0.0, total, 1.0))))
    return causes, total


def bars_of(budget: Budget) -> Bars:
    """Return every cause, the largest first, below the total."""
    causes, total = plotted_causes(budget)
    names = ['total', *(cause.name for cause in causes)]
    colours: list[Colour] = ['text', *(COLOURS[cause.kind] for cause in causes)]
    columns = [
        BarColumn(title, [float(total[i]), *(float(cause.values[i]) for cause in causes)], total[i], LEAST * total[i])
        for i, title in enumerate(TITLES)
    ]
    keys: list[tuple[str, Colour]] = [(kind.value, COLOURS[kind]) for kind in Kind]
    words = f'Error budget, method {budget.at.method}: standard deviation or known bias'
    return Bars(words, names, colours, columns, legend=keys)
