# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""From a recording to the poses of single samples; from samples to the method that suits them."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from psd_deflection.records import FloatArray
from psd_deflection.studies.identify import from_recordings
from psd_deflection.studies.identify.from_recordings import read_identify
from psd_deflection.studies.identify.modes import modes_of

RATE = 500.0


def test_each_sample_has_its_place_on_an_even_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """By its time, which scatters; NaN where there is none or where there is no answer."""
    start = 1_700_000_000_000_000_000
    places = np.array([0, 1, 2, 5, 6, 9])
    late_ns = np.array([0, 300_000, -900_000, 900_000, 0, -400_000])
    t_ns = start + places * 2_000_000 + late_ns
    pose = np.arange(18.0).reshape(6, 3) * 1e-6
    status = np.array([0, 0, 1, 0, 2, 0])
    dots = np.full((6, 4), 0.5)

    def solve_many(given: FloatArray, variances: FloatArray) -> Any:
        np.testing.assert_array_equal(given, dots)
        assert variances == 'variances'
        return SimpleNamespace(pose=pose, status=status)

    monkeypatch.setattr(from_recordings, 'read_run', lambda *a: SimpleNamespace(t_ns=t_ns, dots=dots))
    monkeypatch.setattr(from_recordings, 'Pipeline', lambda rig: None)
    monkeypatch.setattr(from_recordings, 'dot_noise_variances', lambda rig: 'variances')
    monkeypatch.setattr(from_recordings, 'solver_from_rig', lambda *a: SimpleNamespace(solve_many=solve_many))
    marks = [SimpleNamespace(t_ns=start + 1_500_000_000, text='knock')]
    recording = SimpleNamespace(blocks=list, marks=lambda: marks)
    rig: Any = SimpleNamespace(converter=SimpleNamespace(sample_rate_hz=RATE), estimator=SimpleNamespace(solver='any'))
    opened: Any = SimpleNamespace(recording=recording, rig=rig)
    found = read_identify(opened)
    expected = np.full((10, 3), math.nan)
    for place, row in ((0, 0), (1, 1), (5, 3), (9, 5)):
        expected[place] = pose[row]
    np.testing.assert_array_equal(found.poses, expected)
    assert found.rate == RATE
    assert found.opened is opened
    assert [(m.t, m.text) for m in found.marks] == [(1.5, 'knock')]


def swing(frequency: float, n: int, rate: float = RATE, zeta: float = 0.02, size: float = 1e-3) -> FloatArray:
    w = 2.0 * math.pi * frequency * np.arange(n) / rate
    return np.asarray(size * np.exp(-zeta * w) * np.cos(w))


def test_a_hundred_samples_are_enough() -> None:
    """A second of a mode of 12.5 Hz; one sample less is too little."""
    samples = swing(12.5, 101, 100.0) + 1e-6 * np.random.default_rng(1).normal(size=101)
    samples[50] = math.nan
    found = modes_of(samples, 100.0)
    assert found.how == 'ring-down'
    assert found.modes[0].frequency == pytest.approx(12.5, rel=1e-2)
    samples[10] = math.nan
    found = modes_of(samples, 100.0)
    assert (found.how, found.modes, found.stretches) == ('none', (), ())
    assert math.isnan(found.noise)
