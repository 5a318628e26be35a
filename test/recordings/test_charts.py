# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recording and its estimates as figures."""

from __future__ import annotations

import numpy as np
import pytest

import psd_deflection
from psd_deflection.recordings.charts import estimates_chart, moments, samples_chart
from psd_deflection.recordings.sample_table import sample_dtype
from psd_deflection.records import Mark
from tools.program import ROOT


def test_every_channel_is_drawn_with_the_marks() -> None:
    samples = np.zeros(3, sample_dtype(2))
    samples['t_ns'] = [5_000_000_000, 5_500_000_000, 6_000_000_000]
    samples['t'] = [0.0, 0.5, 1.0]
    samples['seq'] = [0, 1, 2]
    samples['y2'] = [1.0, 2.0, 3.0]
    chart = samples_chart(samples, 2, moments([Mark(5_250_000_000, 'bump')], 5_000_000_000))
    assert [panel.y_label for panel in chart.panels] == [f'{n} / V' for n in ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')]
    # Its words are beside it once.
    words = ['bump', *[''] * 5]
    assert [[(rule.at, rule.words) for rule in rules] for rules in chart.rules()] == [[(0.25, w)] for w in words]
    (curve,) = chart.panels[4].series
    assert curve.x.tolist() == [0.0, 0.5, 1.0]
    assert curve.y.tolist() == [1.0, 2.0, 3.0]


def test_estimates_are_drawn_with_their_interval() -> None:
    pose = np.array([[1e-6, 2e-6, np.radians(0.003)]])
    sd = np.array([[1e-7, 2e-7, np.radians(0.0001)]])
    panels = estimates_chart(np.array([0.5]), pose, sd, '/link_tip/deflection', ()).panels
    shown = [(float(s.y[0]), float(s.half_width[0])) for p in panels for s in p.series if s.half_width is not None]
    assert np.allclose(shown, [(1.0, 0.196), (2.0, 0.392), (3.0, 0.196)])
    assert estimates_chart(np.array([0.5]), pose, None, 'a', ()).panels[0].series[0].half_width is None


def test_no_line_is_drawn_over_a_step_of_the_time_map() -> None:
    """Twenty samples, ten of which the stamps are raised by 1 ns each, ten right ones, and a leap by 5 ms."""
    samples = np.zeros(50, sample_dtype(2))
    samples['seq'] = np.arange(50)
    steps = np.repeat([1e-3, 1e-9, 1e-3], [20, 10, 20])
    steps[40] = 5e-3
    samples['t'] = t = np.cumsum(steps)
    (curve,) = samples_chart(samples, 2, ()).panels[0].curves
    drawn = [span for span in _spans(curve.x, curve.y) if span[0] < span[1]]
    assert drawn == [(t[0], t[19]), (t[29], t[39]), (t[40], t[49])]


@pytest.mark.parametrize('part', ['samples', 'estimates'])
def test_a_recording_draws_itself(part: str) -> None:
    recording = psd_deflection.open(ROOT / 'bags' / 'clean').crop(1.0, 2.0)
    figure = recording.plot() if part == 'samples' else psd_deflection.replay(recording).plot()
    assert len(figure.axes) == {'samples': 6, 'estimates': 3}[part]
    assert figure._repr_png_()[:4] == b'\x89PNG'


def _spans(x: np.ndarray, y: np.ndarray) -> list[tuple[float, float]]:
    """From where to where a line is drawn."""
    ends = np.flatnonzero(np.diff(np.concatenate(([False], np.isfinite(y), [False])).astype(int)))
    return [(float(x[a]), float(x[b - 1])) for a, b in ends.reshape(-1, 2)]


@pytest.mark.slow
@pytest.mark.parametrize('drawing', ['samples', 'estimates'])
@pytest.mark.parametrize('bag', ['lost_samples', 'laser_off'])
def test_a_figure_draws_no_line_over_a_gap(drawing: str, bag: str) -> None:
    recording = psd_deflection.open(ROOT / 'bags' / bag)
    estimates = psd_deflection.replay(recording)
    samples = drawing == 'samples'
    figure = recording.plot() if samples else estimates.plot()
    t, steps = (
        (recording.samples['t'], np.diff(recording.samples['seq']))
        if samples
        else (estimates.t, np.diff(estimates.t) / np.median(np.diff(estimates.t)))
    )
    gaps = np.flatnonzero(steps > 1.5)
    expected = list(zip(t[np.concatenate(([0], gaps + 1))], t[np.concatenate((gaps, [len(t) - 1]))], strict=True))
    assert len(expected) > 1 or (samples and bag == 'laser_off')
    for axes in figure.axes:
        (line,) = [one for one in axes.lines if np.size(one.get_xdata()) > 2]
        drawn = _spans(np.asarray(line.get_xdata()), np.asarray(line.get_ydata()))
        # Of many points, those at the ends of a stretch may be thinned.
        assert len(drawn) == len(expected)
        assert np.allclose(drawn, expected, atol=0.01)
