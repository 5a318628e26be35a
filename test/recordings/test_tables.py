# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings and estimates as Python's own things, as tables and series row by row, and as figures."""

import hashlib
import subprocess
import sys
import warnings
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.recordings.charts import estimates_chart, moments, samples_chart
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.sample_table import digest_of, sample_dtype, samples_table
from psd_deflection.recordings.spans import span_ns
from psd_deflection.records import AppliedLoad, Mark, ReferencePose, TemperatureReading
from psd_deflection.studies.study import opened
from tools.program import ROOT

START = 1_700_000_000_000_000_000
MS = 1_000_000


def series(n: int = 3) -> EstimateSeries:
    pose = np.arange(3.0 * n).reshape(n, 3) * 1e-6
    return EstimateSeries(
        'x',
        START + 20 * MS * np.arange(n),
        pose,
        np.zeros((n, 2)),
        np.tile(np.diag([4e-12, 9e-12, -1.0]), (n, 1, 1)),
        pose * 1e6,
        np.arange(float(n)),
    )


def test_series_axes_are_columns_from_first_estimate() -> None:
    made = series()
    assert made.t == pytest.approx([0.0, 0.02, 0.04])
    assert [made.dx[1], made.dy[1], made.theta[1]] == pytest.approx([3e-6, 4e-6, 5e-6])
    sd = made.sd
    assert sd is not None
    assert sd[0, :2] == pytest.approx([2e-6, 3e-6])
    assert np.isnan(sd[0, 2])
    part = made[0.01:0.03]
    assert part.t == pytest.approx([0.02])
    assert part.chi_square == pytest.approx([1.0])
    with pytest.raises(ConfigError, match='a part of time'):
        made[::2]
    assert len(series(0).t) == 0


def test_pandas_and_xarray_wait_until_they_are_asked_for() -> None:
    code = 'import sys, psd_deflection.recordings.estimates; print({"pandas", "xarray"} & {*sys.modules})'
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == 'set()\n'


def test_a_table_has_the_columns_that_there_are() -> None:
    made = series()
    names = [c.name for c in made.table().columns]
    assert names[-4:] == ['fx', 'fy', 'tz', 'chi_square']
    without = EstimateSeries('x', made.t_ns, made.pose, made.tilt)
    assert [c.name for c in without.table().columns] == ['t_ns', 'dx', 'dy', 'theta', 'phi', 'omega']
    assert without.sd is None


def test_a_summary_says_how_long_and_how_far() -> None:
    assert dict(series()._summary()) == {
        'estimates': '3',
        'duration': '0.04 s',
        'ΔX': '+0.00 … +6.00 µm',
        'ΔY': '+1.00 … +7.00 µm',
        'θ': '+0.11 … +0.46 mdeg',
    }
    assert dict(series(0)._summary()) == {'estimates': '0'}


def test_loads_are_held_and_references_stand_once() -> None:
    samples = np.zeros(4, sample_dtype(2))
    samples['t_ns'] = START + MS * np.arange(4)
    loads = [AppliedLoad(START + 2 * MS, 1.0, 2.0, 3.0), AppliedLoad(START + MS, 0.0, -1.0, 0.0)]
    references = [ReferencePose(START - MS, 1e-3, 2e-3, 3e-3), ReferencePose(START + MS + 1, 4e-3, 5e-3, 6e-3)]
    references.append(ReferencePose(START + 3 * MS + 1, 9.0, 9.0, 9.0))
    made = samples_table(samples, 2, loads, [TemperatureReading(START + 3 * MS, 21.5)], references, 'x')
    columns = {c.name: np.asarray(c.values) for c in made.columns}
    np.testing.assert_array_equal(columns['load_fy'], [np.nan, -1.0, 2.0, 2.0])
    np.testing.assert_array_equal(columns['load_tz'], [np.nan, 0.0, 3.0, 3.0])
    np.testing.assert_array_equal(columns['ref_dx'], [1e-3, np.nan, 4e-3, np.nan])
    assert [c for c in columns if c.startswith('temp')]
    (warm,) = [columns[c] for c in columns if c.startswith('temp')]
    np.testing.assert_array_equal(warm, [np.nan, np.nan, np.nan, 21.5])


def test_digest_is_that_of_the_bytes_of_all_files(tmp_path: Path) -> None:
    content = bytes(range(256)) * 5000
    for name, part in (('b', content[1000:]), ('a', content[:1000])):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'file').write_bytes(part)
    assert digest_of(tmp_path) == hashlib.sha256(content).hexdigest()
    assert digest_of(tmp_path / 'a' / 'file') == hashlib.sha256(content[:1000]).hexdigest()
    with pytest.raises(RecordingError, match='gone: cannot be read'):
        digest_of(tmp_path / 'gone')


def test_repeated_mark_is_the_first_after_the_start() -> None:
    marks = [Mark(START + t, text) for t, text in ((5, 'on'), (9, 'off'), (20, 'on'), (30, 'off'))]
    recording = cast(Any, SimpleNamespace(path=Path('x'), marks=lambda: marks))
    assert span_ns(recording, START, ('mark:on', 'mark:on')) == (START + 5, START + 20)
    assert span_ns(recording, START, (None, 'mark: off')) == (START, START + 9)
    assert span_ns(recording, START, (1e-8, 'mark:off')) == (START + 10, START + 30)
    assert span_ns(recording, START, ('mark:off', None)) == (START + 9, np.iinfo(np.int64).max)
    with pytest.raises(RecordingError, match=r"x: has no mark 'gone'; its marks are off, on"):
        span_ns(recording, START, ('mark:gone', None))
    with pytest.raises(ConfigError, match='must be s from the first sample'):
        span_ns(recording, START, ('soon', None))


CLEAN = ROOT / 'bags' / 'clean'


def test_a_recording_has_length_duration_and_start() -> None:
    recording = psd_deflection.open(CLEAN)
    assert recording
    assert 'samples' not in recording.__dict__
    assert (len(recording), recording.start) == (4000, datetime(2026, 1, 1, tzinfo=UTC))
    assert recording.duration == pytest.approx(3.999)
    assert (recording['x1'] == recording.samples['x1']).all()
    with pytest.raises(KeyError, match="no column 'x3'; there are t, seq, t_ns, x1"):
        recording['x3']


def test_times_that_do_not_count_from_the_epoch_have_no_start() -> None:
    assert psd_deflection.simulate(None, (0, 0, 0), seconds=0.1).start is None


def test_estimates_have_duration_columns_and_times_of_day() -> None:
    estimates = psd_deflection.replay(CLEAN)
    assert estimates.duration == pytest.approx(3.98)
    assert (estimates['dx'] == estimates.dx).all()
    with pytest.raises(KeyError, match="no column 'dz'"):
        estimates['dz']
    times = estimates.to_pandas(clock=True).index
    assert (times.view(np.int64) == estimates.t_ns).all()
    assert str(times.tz) == 'UTC'


@pytest.mark.parametrize(
    ('recording', 'rig', 'words'),
    [
        ('bag', None, 'the parameters in the recording'),
        ('csv', None, 'the nominal rig: there is none in the recording'),
        ('csv', 'file', str(ROOT / 'config' / 'thesis_rig.yaml')),
        ('csv', 'object', 'the rig that was given'),
    ],
)
def test_an_answer_names_where_its_rig_is_from(tmp_path: Path, recording: str, rig: str | None, words: str) -> None:
    path = CLEAN
    if recording == 'csv':
        path = tmp_path / 'a.csv'
        rows = [f'{i * 1e-3:.3f},0,0,5,0,0,5' for i in range(40)]
        path.write_text('\n'.join(['t,x1,y1,sum1,x2,y2,sum2', *rows]))
    given = {None: None, 'file': ROOT / 'config' / 'thesis_rig.yaml', 'object': psd_deflection.load_rig()}[rig]
    assert opened(open_recording(path), given, notify=lambda _: None).sources['rig'] == words
    with warnings.catch_warnings(action='ignore'):
        assert psd_deflection.watch(path, given).sources['rig'] == words


def test_every_channel_is_drawn_with_the_marks() -> None:
    samples = np.zeros(3, sample_dtype(2))
    samples['t_ns'] = [5_000_000_000, 5_500_000_000, 6_000_000_000]
    samples['t'] = [0.0, 0.5, 1.0]
    samples['seq'] = [0, 1, 2]
    samples['y2'] = [1.0, 2.0, 3.0]
    chart = samples_chart(samples, 2, moments([Mark(5_250_000_000, 'bump')], 5_000_000_000))
    assert [panel.y_label for panel in chart.panels] == [f'{n} / V' for n in ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')]
    assert [panel.curves[0].colour for panel in chart.panels] == [*['blue'] * 3, *['orange'] * 3]
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
