# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Drawings of a report, declared: charts, bars and matrices. The page and matplotlib draw the same declaration.

Bars and matrices are text of the page in the page's own colours, right on dark pages without a script.
:mod:`psd_deflection.base.figures` draws each with matplotlib.
"""

import html
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from psd_deflection.base.charts import Chart, Colour, drawn
from psd_deflection.base.pages import wide
from psd_deflection.base.tables import optional_library
from psd_deflection.records import FloatArray

if TYPE_CHECKING:
    from psd_deflection.base.figures import ShownFigure

LEVELS = 20
"""Of the shade of a cell."""
CELL = 13
LETTER = 5.6
"""px of a letter of a label, its width on average."""


class BarColumn(NamedTuple):
    """A bar for each name: ``values`` (n,). A bar of ``most`` is whole; logarithmic from ``least`` if that is not 0."""

    title: str
    values: Sequence[float]
    most: float
    least: float = 0.0


@dataclass(frozen=True, eq=False)
class Bars:
    """Bars with their numbers, a row for each of ``names``. ``words``: what it shows; ``legend``: of the colours."""

    words: str
    names: Sequence[str]
    colours: Sequence[Colour]
    columns: Sequence[BarColumn]
    digits: str = '.3g'
    legend: Sequence[tuple[str, Colour]] = ()


@dataclass(frozen=True, eq=False)
class Matrix:
    """Cells in shades: blue above 0, red below; ``most``: from there on darkest. NaN: no cell.

    ``values`` (rows, columns). ``height`` of a row, px. ``words``: what it shows.
    """

    words: str
    values: FloatArray
    rows: Sequence[str]
    columns: Sequence[str]
    most: float
    height: int = CELL


Drawing = Chart | Bars | Matrix


def in_page(part: str | Drawing) -> str:
    """A part of a page as HTML: text as it is, a drawing drawn."""
    if isinstance(part, str):
        return part
    if isinstance(part, Chart):
        return drawn(part)
    return _bars(part) if isinstance(part, Bars) else _matrix(part)


def plotted(drawing: Drawing) -> 'ShownFigure':
    """Return ``drawing`` as a matplotlib figure. Raises ConfigError if matplotlib is not installed."""
    figures = optional_library('psd_deflection.base.figures', 'plot()', 'matplotlib', 'plot')
    figure: ShownFigure = figures.figure_of(drawing)
    return figure


def _bars(bars: Bars) -> str:
    head = ''.join(f'<th scope="col">{html.escape(column.title)}</th>' for column in bars.columns)
    rows = []
    for i, (name, colour) in enumerate(zip(bars.names, bars.colours, strict=True)):
        cells = ''.join(
            f'<td><i style="--w:{_share(column, i):.4f};--tone:var(--{colour})"></i>'
            f'{column.values[i]:{bars.digits}}</td>'
            for column in bars.columns
        )
        # A name may break after an underscore.
        shown = html.escape(name).replace('_', '_<wbr>')
        rows.append(f'<tr><th scope="row">{shown}</th>{cells}</tr>')
    keys = ' '.join(
        f'<span class="tone" style="--tone:var(--{tone})">{html.escape(name)}</span>' for name, tone in bars.legend
    )
    reported = f'<p class="quiet">{keys}</p>' if keys else ''
    return f'{reported}<table class="bars"><tr><td></td>{head}</tr>{"".join(rows)}</table>'


def _matrix(matrix: Matrix) -> str:
    words, values, most, height = matrix.words, matrix.values, matrix.most, matrix.height
    rows, columns = matrix.rows, matrix.columns
    x0, y0 = 10 + LETTER * max(map(len, rows)), 10 + LETTER * max(map(len, columns))
    width, tall = x0 + CELL * len(columns) + 6, y0 + height * len(rows) + 6
    drawn = [
        f'<text x="{x0 - 4:.0f}" y="{y0 + height * (i + 0.5) + 3:.1f}" text-anchor="end">{html.escape(name)}</text>'
        for i, name in enumerate(rows)
        if name
    ]
    drawn += [
        f'<text transform="translate({x0 + CELL * (i + 0.5) + 3:.1f},{y0 - 4:.0f})rotate(-90)">'
        f'{html.escape(name)}</text>'
        for i, name in enumerate(columns)
        if name
    ]
    levels = np.nan_to_num(np.rint(np.clip(values / most, -1.0, 1.0) * LEVELS)).astype(int)
    for level in np.unique(levels[levels != 0]).tolist():
        path = ''.join(f'M{i} {row}h{n}v1h-{n}z' for row, i, n in _runs(levels, level))
        tone = 'blue' if level > 0 else 'red'
        drawn.append(
            f'<path transform="translate({x0:.0f},{y0:.0f})scale({CELL},{height})" shape-rendering="crispEdges" '
            f'style="fill:var(--{tone})" fill-opacity="{abs(level) / LEVELS:.2f}" d="{path}"/>'
        )
    drawn.append(
        f'<path fill="none" style="stroke:var(--line)" d="M{x0:.0f} {y0:.0f}h{CELL * len(columns)}'
        f'v{height * len(rows)}h-{CELL * len(columns)}z"/>'
    )
    return wide(
        f'<svg class="matrix" role="img" aria-label="{html.escape(words)}" viewBox="0 0 {width:.0f} {tall:.0f}" '
        f'width="{width:.0f}" height="{tall:.0f}">{"".join(drawn)}</svg>',
        f'matrix: {words}',
    )


def _runs(levels: np.ndarray[tuple[int, ...], np.dtype[np.int_]], level: int) -> Iterator[tuple[int, int, int]]:
    """Row, first column and number of neighbouring cells of one level."""
    for row, cells in enumerate((levels == level).tolist()):
        at = 0
        for there, group in itertools.groupby(cells):
            count = len(list(group))
            if there:
                yield row, at, count
            at += count


def _share(column: BarColumn, i: int) -> float:
    """The length of a bar, 0 to 1."""
    value = column.values[i]
    if column.least > 0.0:
        share = math.log(max(value, column.least) / column.least) / math.log(column.most / column.least)
        return min(share, 1.0)
    return min(max(value / column.most, 0.0), 1.0) if column.most > 0.0 else 0.0
