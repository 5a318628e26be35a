# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The same declaration as a matplotlib figure."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest

from psd_deflection.base.charts import Chart, Panel, Rule, Series
from psd_deflection.base.drawings import BarColumn, Bars, Matrix
from psd_deflection.base.figures import figure_of

X = np.array([1.0, 2.0, 4.0])


def test_every_curve_is_in_its_panel() -> None:
    above = Panel((Series('a', X, X**2, 'red'), Series('b', X, X, 'blue', 'points')), 't / s', 'x / µm', y_range=(0, 9))
    below = Panel((Series('', X, -X, 'text', 'rings'),), 't / s', 'y / µm', rules=[Rule(3.0, 'here')])
    first, second = figure_of(Chart('words', (above, below))).axes
    assert [np.asarray(line.get_ydata()).tolist() for line in first.lines] == [[1, 4, 16], [1, 2, 4]]
    assert first.get_ylim() == (0, 9)
    legend = first.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ['a', 'b']
    # The axis of time is named once.
    assert (first.get_xlabel(), second.get_xlabel(), second.get_ylabel()) == ('', 't / s', 'y / µm')
    assert second.get_legend() is None
    assert np.asarray(second.lines[1].get_xdata()).tolist() == [3.0, 3.0]
    assert [text.get_text().strip() for text in second.texts] == ['here']


def test_logarithmic_axes_levels_and_spreads() -> None:
    band = Series('band', X, X, 'green', half_width=X / 2.0, bold=True)
    bars = Series('bars', X, X, 'violet', 'points', half_width=X / 2.0)
    one = Panel((band,), 'f / Hz', 'p', log='x, y', rules=[Rule(2.0, 'limit', across=True)])
    figure = figure_of(Chart('words', (one, Panel((bars,), 'load / N', 'p'), one), beside=2))
    first, second, _, empty = figure.axes
    assert (first.get_xscale(), first.get_yscale(), second.get_xscale()) == ('log', 'log', 'linear')
    assert np.asarray(first.lines[1].get_ydata()).tolist() == [2.0, 2.0]
    assert first.collections[0].get_paths()[0].get_extents().ymax == pytest.approx(6.0)
    assert len(second.collections) == 1
    assert not empty.get_visible()
    stream = io.BytesIO()
    figure.savefig(stream, format='png', dpi=40)
    assert stream.getvalue()[:4] == b'\x89PNG'


def test_of_a_long_curve_what_can_be_observed_is_drawn() -> None:
    x = np.arange(100_000.0)
    y = np.sin(x)
    y[70_001] = 9.0
    (axis,) = figure_of(Chart('words', (Panel((Series('', x, y, 'red'),), 't / s', 'y'),))).axes
    (line,) = axis.lines
    drawn = np.asarray(line.get_ydata())
    assert len(drawn) < 5000
    assert drawn.max() == 9.0


def test_bars_have_the_lengths_of_the_page() -> None:
    columns = (BarColumn('a', (8.0, 2.0), 8.0), BarColumn('b', (10.0, 0.001), 10.0, least=0.01))
    figure = figure_of(Bars('words', ('one', 'two'), ('text', 'red'), columns, '.2f', (('key', 'red'),)))
    axes: Any = figure.axes
    linear, logarithmic = axes
    assert [bar.get_width() for bar in linear.patches] == [8.0, 2.0]
    assert [(bar.get_x(), bar.get_width()) for bar in logarithmic.patches] == [(0.01, 9.99), (0.01, 0.0)]
    assert (linear.get_xscale(), logarithmic.get_xscale()) == ('linear', 'log')
    assert [text.get_text() for text in linear.texts] == [' 8.00', ' 2.00']
    assert [label.get_text() for label in linear.get_yticklabels()] == ['one', 'two']
    assert [text.get_text() for text in logarithmic.get_legend().get_texts()] == ['key']


def test_cells_of_a_matrix_are_blue_above_zero_and_red_below() -> None:
    values = np.array([[1.0, -1.0, np.nan], [0.0, 3.0, -0.5]])
    figure = figure_of(Matrix('words', values, ('r', 's'), ('a', 'b', 'c'), most=1.0))
    (axis,) = figure.axes
    shown: Any = axis.images[0]
    red, _, blue, alpha = shown.to_rgba(shown.get_array()).transpose(2, 0, 1)
    assert blue[0, 0] > red[0, 0]
    assert blue[0, 1] < red[0, 1]
    assert alpha[0, 2] == 0.0
    # White, to one of 256 steps.
    assert [red[1, 0], blue[1, 0]] == pytest.approx([1.0, 1.0], abs=0.01)
    assert blue[1, 1] == blue[0, 0]
    assert [label.get_text() for label in axis.get_xticklabels()] == ['a', 'b', 'c']
