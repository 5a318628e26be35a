# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The same declaration as a matplotlib figure."""

from __future__ import annotations

import numpy as np

from psd_deflection.base.charts import Chart, Panel, Rule, Series
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
