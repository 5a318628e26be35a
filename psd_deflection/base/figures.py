# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A declared drawing as a matplotlib figure, for a file or a notebook; pages draw the same declaration themselves."""

import io
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from psd_deflection.base.charts import Chart, Panel, Rule, Series, thinned
from psd_deflection.base.drawings import BarColumn, Bars, Drawing, Matrix

TONES = {
    'blue': '#4c72b0',
    'red': '#c44e52',
    'green': '#55a868',
    'violet': '#8172b3',
    'orange': '#dd8452',
    'quiet': '#8c8c8c',
    'text': '#222222',
}
WIDTH = 10.0
"""Inches."""
LINE_PX = 12.0
"""px of a panel's height from the words beside one upright rule to those beside the next."""
PX = 100.0
"""Of a panel's height, an inch."""


class ShownFigure(Figure):
    """A figure that a notebook shows by itself, without pyplot."""

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        self.savefig(stream, format='png')
        return stream.getvalue()


def figure_of(drawing: Drawing) -> ShownFigure:
    """The figure of a drawing, as the page has it."""
    if isinstance(drawing, Chart):
        return _chart(drawing)
    return _bars(drawing) if isinstance(drawing, Bars) else _matrix(drawing)


def _bars(bars: Bars) -> ShownFigure:
    count = len(bars.names)
    figure = ShownFigure(figsize=(WIDTH, 0.26 * count + 1.5), layout='constrained')
    grid: Any = figure.subplots(1, len(bars.columns), sharey=True, squeeze=False)
    tones = [TONES[colour] for colour in bars.colours]
    for axis, column in zip(grid[0], bars.columns, strict=True):
        _bar_column(axis, column, bars, tones)
    grid[0, 0].set_yticks(range(count), bars.names)
    grid[0, 0].set_ylim(count - 0.4, -0.6)
    if bars.legend:
        keys = [Patch(color=TONES[tone], label=name) for name, tone in bars.legend]
        # The shortest bars are last.
        grid[0, -1].legend(handles=keys, loc='lower right', fontsize=8)
    figure.suptitle(bars.words, fontsize=10)
    return figure


def _bar_column(axis: Any, column: BarColumn, bars: Bars, tones: list[str]) -> None:
    count = len(bars.names)
    if column.least > 0.0:
        # The same length as on the page: it begins at the least.
        widths = np.maximum(column.values, column.least) - column.least
        axis.barh(range(count), widths, left=column.least, color=tones)
        axis.set_xscale('log')
        axis.set_xlim(column.least, 6.0 * column.most)
    else:
        axis.barh(range(count), column.values, color=tones)
        axis.set_xlim(0.0, 1.3 * column.most or 1.0)
    for i, value in enumerate(column.values):
        end = max(value, column.least)
        axis.text(end, i, f' {value:{bars.digits}}', va='center', fontsize=8)
    axis.set_xlabel(column.title)
    axis.grid(axis='x', alpha=0.25)
    axis.set_axisbelow(True)


def _matrix(matrix: Matrix) -> ShownFigure:
    count, across = np.shape(matrix.values)
    figure = ShownFigure(figsize=(0.16 * across + 3.0, 0.16 * count + 2.6), layout='constrained')
    axis: Any = figure.subplots()
    shades = LinearSegmentedColormap.from_list('shades', (TONES['red'], 'white', TONES['blue']))
    axis.imshow(matrix.values, cmap=shades, vmin=-matrix.most, vmax=matrix.most, aspect='auto', interpolation='none')
    axis.set_xticks(range(across), matrix.columns, rotation=90, fontsize=7)
    axis.set_yticks(range(count), matrix.rows, fontsize=7)
    axis.xaxis.tick_top()
    figure.suptitle(matrix.words, fontsize=9, wrap=True)
    return figure


def _chart(chart: Chart) -> ShownFigure:
    columns = chart.beside
    rows = -(-len(chart.panels) // columns)
    heights = [max(p.height for p in chart.panels[i * columns : (i + 1) * columns]) for i in range(rows)]
    figure = ShownFigure(figsize=(WIDTH, 0.6 + 1.4 * sum(heights) / PX), layout='constrained')
    grid: Any = figure.subplots(rows, columns, squeeze=False, height_ratios=heights)
    axes = grid.ravel()
    for i, (axis, panel, rules) in enumerate(zip(axes, chart.panels, chart.rules(), strict=False)):
        _draw(axis, panel, rules)
        below = i + 1 < len(chart.panels) and columns == 1 and chart.panels[i + 1].x_label == panel.x_label
        if below:
            axis.set_xlabel('')
    for axis in axes[len(chart.panels) :]:
        axis.set_visible(False)
    figure.suptitle(chart.words, fontsize=10)
    return figure


def _draw(axis: Any, panel: Panel, rules: list[Rule]) -> None:
    series, _ = thinned(panel.curves)
    for curve in series:
        _curve(axis, curve)
    for i, rule in enumerate(rules):
        line = axis.axhline if rule.across else axis.axvline
        line(rule.at, color=TONES[rule.colour], lw=0.8, ls='--')
        if rule.across:
            place, how, side, edge = (1.0, rule.at), axis.get_yaxis_transform(), 'right', 'bottom'
        else:
            below = i % 3 * LINE_PX / panel.height
            place, how, side, edge = (rule.at, 0.97 - below), axis.get_xaxis_transform(), 'left', 'top'
        axis.text(*place, f' {rule.words} ', transform=how, ha=side, va=edge, fontsize=8)
    if 'x' in panel.log:
        axis.set_xscale('log')
    if 'y' in panel.log:
        axis.set_yscale('log')
    if panel.y_range is not None:
        axis.set_ylim(*panel.y_range)
    axis.set(xlabel=panel.x_label, ylabel=panel.y_label)
    axis.grid(alpha=0.25)
    if any(curve.name for curve in panel.series):
        axis.legend(loc='best', ncols=3, frameon=False, fontsize=9)


def _curve(axis: Any, curve: Series) -> None:
    tone = TONES[curve.colour]
    styles: dict[str, dict[str, Any]] = {
        'line': {'lw': 2.2 if curve.bold else 1.0},
        'points': {'ls': 'none', 'marker': '.', 'ms': 3},
        'rings': {'ls': 'none', 'marker': 'o', 'ms': 4, 'mfc': 'none'},
    }
    axis.plot(curve.x, curve.y, color=tone, label=curve.name or None, **styles[curve.style])
    if curve.half_width is None:
        return
    if curve.style == 'line':
        axis.fill_between(curve.x, curve.y - curve.half_width, curve.y + curve.half_width, color=tone, alpha=0.2, lw=0)
    else:
        axis.errorbar(curve.x, curve.y, np.abs(curve.half_width), fmt='none', ecolor=tone, lw=1)
