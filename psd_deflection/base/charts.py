# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Charts of a report: curves over an axis are declared here, and the page's own script draws them with uPlot.

A chart says values under the cursor, is looked at closer by dragging, and switches its curves on and off. Its
arrays are inside the page. :mod:`psd_deflection.base.figures` draws the same declaration with matplotlib.
"""

from __future__ import annotations

import base64
import html
import itertools
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.records import FloatArray, Moment

FOLDER = Path(__file__).parent / 'page'
"""``charts.js``, which draws with uPlot (``vendor/``), and what reports add to it."""

UPLOT = FOLDER / 'vendor' / 'uPlot.iife.min.js'
UPLOT_STYLE = FOLDER / 'vendor' / 'uPlot.min.css'
CHARTS = FOLDER / 'charts.js'


def text(path: Path) -> str:
    """Of a file of ours."""
    return path.read_text(encoding='utf-8')


def joined(*paths: Path) -> str:
    """Modules as one: what they export to each other is in one file."""
    return '\n'.join(re.sub(r'^import .*\n|^export (?=const|function|class)', '', text(p), flags=re.M) for p in paths)


def packed(values: npt.ArrayLike, kind: type[np.floating[Any]] = np.float32) -> str:
    """Little-endian floats in base64: an hour is 13 MB, where its digits would be 25 MB."""
    return base64.b64encode(np.asarray(values, np.dtype(kind).newbyteorder('<')).tobytes()).decode()


def safe(json_text: str) -> str:
    """JSON that ends no script element."""
    return json_text.replace('<', '\\u003c')


Colour = Literal['blue', 'red', 'green', 'violet', 'orange', 'quiet', 'text']
"""A tone for light pages and one for dark ones: ``STYLE`` in pages.py."""
Style = Literal['line', 'points', 'rings']

SMALL = 200
"""px: the height of a panel that has others beside it."""
BUCKETS = 1000
"""Of a curve with more points the page has the least and the largest value of each of so many stretches."""
MOST_POINTS = 4000
"""Of a cloud of points the page has so many at most."""
ONE_AFTER_ANOTHER = '(recordings one after another)'
MOST_WORDS = 20
"""So many marks have their words beside them, the first; the others are lines only."""
GAP = 1.5
"""Median steps of time from which on a line breaks: the next value is missing."""
SQUEEZED = 1e-3
"""Median steps of time below which a line breaks: the stamps are raised after a step of the time map."""
CELLS = (600, 200)
"""Points of a cloud that share one of so many cells (across, up) lie on each other: one is kept."""


@dataclass(frozen=True, eq=False)
class Series:
    """One curve: ``x`` and ``y`` (k,) in the units of its panel, NaN: no value.

    ``name``: in the legend; curves of one name are switched together. ``half_width`` (k,): ± of each value.
    ``after_gap`` (k,): True where values are missing before a point; over time None: after each step of more than
    ``GAP`` or less than ``SQUEEZED`` medians.
    """

    name: str
    x: FloatArray
    y: FloatArray
    colour: Colour
    style: Style = 'line'
    half_width: FloatArray | None = None
    bold: bool = False
    after_gap: npt.NDArray[np.bool_] | None = None

    def broken(self) -> Series:
        """The same curve with a point without a value inside each gap, so that no line is drawn across it."""
        steps = np.diff(self.x)
        if self.style != 'line' or len(steps) == 0:
            return self
        apart = gaps_of(steps) if self.after_gap is None else self.after_gap[1:]
        at = np.flatnonzero(apart) + 1
        if len(at) == 0:
            return self
        half_width = None if self.half_width is None else np.insert(self.half_width, at, np.nan)
        x = np.insert(self.x, at, 0.5 * (self.x[at - 1] + self.x[at]))
        return replace(self, x=x, y=np.insert(self.y, at, np.nan), half_width=half_width, after_gap=None)


def gaps_of(steps: FloatArray) -> npt.NDArray[np.bool_]:
    """Where ``steps`` (k,) of time are more than ``GAP`` or less than ``SQUEEZED`` medians: (k,)."""
    usual = np.nanmedian(steps)
    return (steps > GAP * usual) | (steps < SQUEEZED * usual)


class Rule(NamedTuple):
    """A straight line through the panel at ``at``, upright, or level if ``across``; ``words`` beside it."""

    at: float
    words: str = ''
    across: bool = False
    colour: Colour = 'quiet'


@dataclass(frozen=True, eq=False)
class TimeAxis:
    """An axis of time, s, on which lines break at gaps. ``since``: where it is 0. ``marks``: drawn in every panel.

    The only way to an axis of time, so no chart can leave out what somebody marked. ``name``: stands before the label
    of a panel whose axis is its own.
    """

    since: str
    marks: Sequence[Moment]
    name: str = ''

    def __str__(self) -> str:
        return f'{self.name}{": " if self.name else ""}time / s {self.since}'.rstrip()


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves ``over`` an axis. Labels end with `` / unit``. Panels of a chart with one
    ``x_label`` share cursor and zoom.

    ``log``: the axes that are logarithmic. ``y_range``: what is shown at first, if not all.
    ``height``: px.
    """

    series: Sequence[Series]
    over: str | TimeAxis
    y_label: str
    log: Literal['', 'x', 'y', 'x, y'] = ''
    rules: Sequence[Rule] = ()
    y_range: tuple[float, float] | None = None
    height: int = 140

    @property
    def x_label(self) -> str:
        """That of the axis."""
        return str(self.over)

    @property
    def curves(self) -> list[Series]:
        """``series`` as they are drawn: over time a line breaks where values are missing."""
        timed = isinstance(self.over, TimeAxis)
        return [curve.broken() if timed or curve.after_gap is not None else curve for curve in self.series]

    def marked(self, words: bool) -> list[Rule]:
        """``rules``, and the marks of the axis of time among the points; with their ``words``, if these are wanted."""
        if not isinstance(self.over, TimeAxis) or not self.over.marks:
            return list(self.rules)
        x = np.concatenate([curve.x for curve in self.series])
        low, high = np.nanmin(x, initial=np.inf), np.nanmax(x, initial=-np.inf)
        shown = [mark for mark in self.over.marks if low <= mark.t <= high]
        return [*self.rules, *(Rule(m.t, m.text if words and i < MOST_WORDS else '') for i, m in enumerate(shown))]


@dataclass(frozen=True, eq=False)
class Chart:
    """``panels`` below each other, or so many ``beside`` each other where there is room. ``words``: what it shows."""

    words: str
    panels: Sequence[Panel]
    beside: int = 1

    def rules(self) -> list[list[Rule]]:
        """The straight lines of each panel; panels over one axis say the words of a mark once."""
        labels = [panel.x_label for panel in self.panels]
        return [panel.marked(words=panel.x_label not in labels[:i]) for i, panel in enumerate(self.panels)]


MARK = '<figure class="chart"'
"""How a chart begins in a page: a page without it needs no script."""


def drawn(chart: Chart) -> str:
    """The chart as a part of a page."""
    columns: dict[str, int] = {}
    notes: dict[str, None] = {}
    panels = []
    for panel, rules in zip(chart.panels, chart.rules(), strict=True):
        series, message = thinned(panel.curves)
        notes |= dict.fromkeys(message)
        panels.append(
            {
                'series': [_reported(curve, columns) for curve in series],
                'x': panel.x_label,
                'y': panel.y_label,
                'log': panel.log,
                'rules': rules,
                'range': panel.y_range,
                'height': panel.height,
            }
        )
    content = {
        'words': chart.words,
        'note': '; '.join(notes),
        'beside': chart.beside,
        'panels': panels,
        'columns': list(columns),
    }
    words = html.escape(chart.words)
    return (
        f'{MARK} role="group" aria-label="{words}"><noscript><p>A chart, {words}: it is drawn with JavaScript.</p>'
        f'</noscript><script type="application/json">{safe(json.dumps(content, ensure_ascii=False))}</script></figure>'
    )


def _reported(series: Series, columns: dict[str, int]) -> dict[str, Any]:
    """For the page's script; ``columns``: the place of each array, by its text. The same one is there once."""

    def place(values: FloatArray) -> int:
        # Pixels are coarser than floats of 32 bits, except for times of a day or of an epoch.
        with np.errstate(over='ignore'):
            single = np.asarray(values, np.float32)
        reach = np.ptp(values[np.isfinite(values)]) if np.isfinite(values).any() else 0.0
        fine = bool(np.all(np.abs(single - values)[np.isfinite(values)] <= 1e-5 * reach)) or reach == 0.0
        text = 'f' + packed(values) if fine else 'd' + packed(values, np.float64)
        return columns.setdefault(text, len(columns))

    return {
        'name': series.name,
        'colour': series.colour,
        'style': series.style,
        'bold': series.bold,
        'x': place(series.x),
        'y': place(series.y),
        'spread': None if series.half_width is None else place(series.half_width),
    }


def thinned(series: Sequence[Series]) -> tuple[list[Series], Iterable[str]]:
    """What of ``series`` can be seen, and what was done, in words. Curves over the same x stay so."""
    indices: dict[bytes, npt.NDArray[np.intp]] = {}
    message: dict[str, None] = {}
    for key, group in _by_x(series).items():
        x, rows = group[0].x, [curve.y for curve in group]
        if len(x) <= 2 * BUCKETS:
            indices[key] = np.arange(len(x))
        elif np.all(np.diff(x) >= 0.0) and len(np.unique(x)) > len(x) // 2:
            indices[key] = _extremes(rows)
            message[f'of every {len(x) / BUCKETS:.3g} points the least and the largest are drawn'] = None
        else:
            indices[key] = _apart(x, rows)
            message[f'{len(indices[key])} of {len(x)} points are drawn'] = None
    return [_of(curve, indices[_key(curve)]) for curve in series], message


def _key(curve: Series) -> bytes:
    return curve.x.tobytes()


def _by_x(series: Sequence[Series]) -> dict[bytes, list[Series]]:
    out: dict[bytes, list[Series]] = {}
    for curve in series:
        out.setdefault(_key(curve), []).append(curve)
    return out


def _extremes(rows: Sequence[FloatArray]) -> npt.NDArray[np.intp]:
    """Indices of the least and the largest value of each row in each of ``BUCKETS`` stretches."""
    n = len(rows[0])
    edges = np.linspace(0, n, BUCKETS + 1).astype(np.intp)
    keep = np.zeros(n, dtype=bool)
    keep[[0, -1]] = True
    for row in rows:
        # Where a gap begins.
        keep[1:] |= np.isnan(row[1:]) & np.isfinite(row[:-1])
        low, high = np.where(np.isfinite(row), row, np.inf), np.where(np.isfinite(row), row, -np.inf)
        for a, b in itertools.pairwise(edges):
            keep[a + np.argmin(low[a:b])] = keep[a + np.argmax(high[a:b])] = True
    return np.flatnonzero(keep)


def _apart(x: FloatArray, rows: Sequence[FloatArray]) -> npt.NDArray[np.intp]:
    """Indices of points that do not lie on each other, evenly thinned to ``MOST_POINTS``."""
    keep = np.zeros(len(x), dtype=bool)
    across = _cells(x, CELLS[0])
    for row in rows:
        _, first = np.unique(across * CELLS[1] + _cells(row, CELLS[1]), return_index=True)
        keep[first[np.isfinite(row[first])]] = True
    at = np.flatnonzero(keep & np.isfinite(x))
    return at if len(at) <= MOST_POINTS else at[np.linspace(0, len(at) - 1, MOST_POINTS).astype(np.intp)]


def _cells(values: FloatArray, count: int) -> FloatArray:
    """The number of the cell of each value; that of NaN is 0."""
    good = values[np.isfinite(values)]
    low, reach = (good.min(), np.ptp(good) or 1.0) if len(good) else (0.0, 1.0)
    return np.nan_to_num(np.floor((values - low) / reach * (count - 1)))


def _of(curve: Series, at: npt.NDArray[np.intp]) -> Series:
    half_width = None if curve.half_width is None else curve.half_width[at]
    return replace(curve, x=curve.x[at], y=curve.y[at], half_width=half_width)
