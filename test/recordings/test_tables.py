# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables and series of a recording, row by row, by hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.sample_table import sample_dtype, samples_table
from psd_deflection.recordings.spans import span_ns
from psd_deflection.records import AppliedLoad, Mark, ReferencePose, TemperatureReading

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
    # The last one comes after the last sample.
    np.testing.assert_array_equal(columns['ref_dx'], [1e-3, np.nan, 4e-3, np.nan])
    assert [c for c in columns if c.startswith('temp')]
    (warm,) = [columns[c] for c in columns if c.startswith('temp')]
    np.testing.assert_array_equal(warm, [np.nan, np.nan, np.nan, 21.5])


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
