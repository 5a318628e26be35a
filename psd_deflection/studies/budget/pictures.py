"""The picture of an error budget."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from psd_deflection.studies.budget.evaluate import Budget
from psd_deflection.studies.budget.term import Kind

# Okabe & Ito: told apart by a colour-blind reader too.
COLOURS = {Kind.PER_ESTIMATE: '#56B4E9', Kind.SYSTEMATIC: '#E69F00', Kind.KNOWN: '#999999'}


def chart(budget: Budget) -> Figure:
    """Bars of every cause, largest first, beside the total."""
    shown = np.array([1e6, 1e6, math.degrees(1e3)])
    total = budget.total().rms * shown
    # What does nothing, or only rounds, has no place on a logarithmic axis.
    least = 1e-9 * budget.total().rms
    lines = [(c, line.rms * shown) for c, line in budget.lines if np.any(line.rms > least)]
    lines.sort(key=lambda entry: float(np.max(entry[1] / np.where(total > 0.0, total, 1.0))))
    names = [f'{c.name} ({c.row})' if c.row else c.name for c, _ in lines]
    figure = Figure(figsize=(11.0, 0.28 * len(lines) + 1.8), layout='constrained')
    panels: Any = figure.subplots(1, 3, sharey=True)
    for i, (panel, title) in enumerate(zip(panels, ('ΔX, µm', 'ΔY, µm', 'θ, mdeg'), strict=True)):
        values = [v[i] for _, v in lines]
        panel.barh(names, values, color=[COLOURS[c.kind] for c, _ in lines])
        panel.axvline(total[i], color='black', linewidth=1.0)
        panel.text(total[i], len(lines) - 0.4, f' {total[i]:.3g}', ha='right', va='bottom', fontsize=9)
        panel.set(xscale='log', xlabel=title, xlim=(total[i] * 1e-3, total[i] * 2.0))
        panel.grid(axis='x', alpha=0.3)
        panel.set_axisbelow(True)
    handles = [Patch(color=COLOURS[kind], label=kind.value) for kind in Kind]
    handles.append(Patch(facecolor='white', edgecolor='black', label='total (line)'))
    figure.legend(handles=handles, loc='outside lower center', ncols=4, frameon=False)
    figure.suptitle(f'Error budget, method {budget.at.method}: standard deviation or known bias')
    return figure
