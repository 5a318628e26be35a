# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A declared chart on a page and as a figure of matplotlib; what is shown of the axes of the tip."""

import base64
import hashlib
import json
import math
import re
import sys
from typing import Any

import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.axes import ranges
from psd_deflection.base.charts import BUCKETS, Chart, Panel, Rule, Series, drawn
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.figures import figure_of
from psd_deflection.base.pages import page, table
from psd_deflection.base.tables import Column, Table, columns_of, html_table, text_column
from psd_deflection.records import FloatArray
from tools.program import ROOT


def reported(chart: Chart) -> dict[str, Any]:
    match = re.search(r'<script type="application/json">(.*?)</script>', drawn(chart))
    assert match is not None
    out: dict[str, Any] = json.loads(match[1])
    return out


def column(content: dict[str, Any], place: int) -> FloatArray:
    text = content['columns'][place]
    raw = np.frombuffer(base64.b64decode(text[1:]), '<f8' if text[0] == 'd' else '<f4')
    return np.asarray(raw, np.float64)


def chart_of(x: FloatArray, *rows: FloatArray, words: str = 'words') -> Chart:
    curves = [Series(f'row {i}', x, row, 'blue') for i, row in enumerate(rows)]
    return Chart(words, [Panel(curves, 'time / s', 'x1 / µm')])


def test_the_same_array_is_there_once() -> None:
    x = np.arange(5.0)
    content = reported(Chart('words', [*chart_of(x, x**2, x**3).panels, *chart_of(x.copy(), x**2).panels]))
    assert len(content['columns']) == 3
    first, second = (panel['series'] for panel in content['panels'])
    assert [s['x'] for s in (*first, *second)] == [0, 0, 0]
    assert (second[0]['y'], column(content, first[1]['y']).tolist()) == (first[0]['y'], [0.0, 1.0, 8.0, 27.0, 64.0])


def test_what_is_declared_reaches_the_page() -> None:
    x = np.array([1.0, 2.0])
    series = Series('a', x, x, 'red', 'points', half_width=x / 10.0, bold=True)
    panel = Panel((series,), 'f / Hz', 'y / m', log='x, y', rules=[Rule(1.5, 'here')], y_range=(0.0, 3.0), height=99)
    content = reported(Chart('what it shows', [panel], beside=2))
    assert (content['words'], content['beside']) == ('what it shows', 2)
    (only,) = content['panels']
    assert (only['x'], only['y'], only['log'], only['range'], only['height']) == ('f / Hz', 'y / m', 'x, y', [0, 3], 99)
    assert only['rules'] == [[1.5, 'here', False, 'quiet']]
    assert column(content, only['series'][0].pop('spread')) == pytest.approx([0.1, 0.2])
    assert only['series'] == [{'name': 'a', 'colour': 'red', 'style': 'points', 'bold': True, 'x': 0, 'y': 0}]


def test_times_of_an_epoch_keep_their_digits() -> None:
    x = np.linspace(1.7e9, 1.7e9 + 0.06, 4)
    content = reported(chart_of(x, np.zeros(4)))
    assert content['columns'][0][0] == 'd'
    assert column(content, 0) == pytest.approx(x, abs=1e-6)
    assert content['columns'][1][0] == 'f'


def test_a_long_curve_keeps_its_extremes_and_its_gaps() -> None:
    n = 100 * BUCKETS
    x = np.linspace(0.0, 1e-3 * (n - 1), n)
    y = np.random.default_rng(1).normal(size=n)
    y[51_234], y[73_210] = 100.0, -90.0
    y[20_000:20_300] = np.nan
    content = reported(chart_of(x, y, np.zeros(n)))
    at, drawn_y = (column(content, place) for place in (0, 1))
    assert len(at) <= 4 * BUCKETS + 4
    assert (drawn_y[np.argmin(np.abs(at - 51.234))], drawn_y[np.argmin(np.abs(at - 73.210))]) == (100.0, -90.0)
    assert np.isnan(drawn_y[np.argmin(np.abs(at - 20.0))])
    assert at[[0, -1]] == pytest.approx(x[[0, -1]])
    assert content['note'] == 'of every 100 points the least and the largest are drawn'


def test_a_cloud_keeps_points_that_do_not_lie_on_each_other() -> None:
    rng = np.random.default_rng(2)
    x = np.repeat([0.0, 10.0], 20_000)
    y = np.concatenate([rng.normal(size=20_000), np.full(20_000, 7.0)])
    content = reported(chart_of(x, y))
    at, drawn_y = (column(content, place) for place in (0, 1))
    assert 50 < len(at) < 300
    assert (np.sum(at == 10.0), drawn_y.max()) == (1, 7.0)
    assert content['note'] == f'{len(at)} of 40000 points are drawn'


def test_words_of_a_stranger_are_words() -> None:
    text = drawn(chart_of(np.arange(2.0), np.arange(2.0), words='</script><b>"'))
    assert text.count('</script>') == 1
    assert '<b>' not in text
    assert 'aria-label="&lt;/script&gt;&lt;b&gt;&quot;"' in text


def test_a_page_without_a_chart_runs_nothing() -> None:
    text = page('title', [table(('a',), [('<figure class="chart"',)])])
    assert "script-src 'none'" in text
    assert '<script' not in text


def test_page_policy_allows_only_its_own_scripts() -> None:
    chart = drawn(chart_of(np.arange(2.0), np.arange(2.0)))
    text = page('title', [chart, chart])
    scripts = re.findall(r'<script type="(?:text/javascript|module)">(.*?)</script>', text, flags=re.S)
    assert len(scripts) == 2
    digests = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy is not None
    allowed = ' '.join(f"'sha256-{digest}'" for digest in digests)
    assert policy[1] == f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}"
    assert not re.search(r'^(import|export) ', scripts[1], flags=re.M)


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
    assert (first.get_xlabel(), second.get_xlabel(), second.get_ylabel()) == ('', 't / s', 'y / µm')
    assert second.get_legend() is None
    assert np.asarray(second.lines[1].get_xdata()).tolist() == [3.0, 3.0]
    assert [text.get_text().strip() for text in second.texts] == ['here']


def test_pose_ranges_are_in_um_and_millidegrees() -> None:
    poses = np.array([[1e-6, -2e-3, math.radians(0.5)], [3e-6, math.nan, math.radians(-0.25)], [2e-6, 1e-3, 0.0]])
    assert ranges(poses) == [
        ('ΔX', '+1.00 … +3.00 µm'),
        ('ΔY', '-2000.00 … +1000.00 µm'),
        ('θ', '-250.00 … +500.00 mdeg'),
    ]


T = Column('t', np.arange(3) * 0.5, 's', 'time')
TABLE = Table(T, columns_of(np.arange(6.0).reshape(3, 2), ('a', 'b'), ('m', ''), ('one', 'two')), {'path': 'somewhere'})


def test_pandas_has_the_units() -> None:
    pytest.importorskip('pandas')
    frame = TABLE.to_pandas()
    assert (list(frame.index), frame['b'].tolist()) == ([0.0, 0.5, 1.0], [1.0, 3.0, 5.0])
    assert frame.attrs == {'path': 'somewhere', 'units': {'t': 's', 'a': 'm', 'b': ''}}


def test_a_column_may_have_words_numbers_and_none() -> None:
    values = text_column('value', [(1.0, 2.0), -1.0, None], 'of anything').values
    assert values.tolist() == [(1.0, 2.0), -1.0, None]


@pytest.mark.slow
def test_xarray_has_the_units() -> None:
    pytest.importorskip('xarray')
    data = TABLE.to_xarray()
    assert (data['a'].values.tolist(), data['a'].attrs) == ([0.0, 2.0, 4.0], {'units': 'm', 'long_name': 'one'})
    # A number without a unit has the unit 1, as the CF conventions have it.
    assert (data['b'].attrs['units'], data['t'].attrs) == ('1', {'units': 's', 'long_name': 'time'})
    assert data.attrs == {'path': 'somewhere'}


def test_a_plot_without_matplotlib_names_the_line_of_pip(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'psd_deflection.base.figures', None)
    recording = psd_deflection.open(ROOT / 'bags/clean')
    for shown in (recording, psd_deflection.replay(recording), psd_deflection.budget()):
        with pytest.raises(ConfigError, match=r"plot\(\) needs matplotlib: `pip install 'psd_deflection\[plot\]'`"):
            shown.plot()


@pytest.mark.parametrize('name', ['pandas', 'xarray'])
def test_a_missing_library_is_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=rf"to_{name} needs {name}: `pip install 'psd_deflection\[pandas\]'`"):
        getattr(TABLE, f'to_{name}')()


def test_words_of_a_file_are_text_in_html() -> None:
    page = html_table('<b>', [('a & b', '\x1b[2J<script>'), ('long', 'x' * 1000)])
    assert '<b>' not in page
    assert '<script>' not in page
    assert '\x1b' not in page
    assert 'a &amp; b' in page
    assert len(page) < 700
