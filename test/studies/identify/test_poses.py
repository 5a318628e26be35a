# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""From a recording to the poses of single samples; from samples to the method that suits them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from psd_deflection.records import FloatArray
from psd_deflection.studies.identify import from_recordings
from psd_deflection.studies.identify import modes as module
from psd_deflection.studies.identify.from_recordings import read_identify
from psd_deflection.studies.identify.modes import modes_of
from psd_deflection.studies.identify.spectra import ColouredNoise

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


def resonance(frequency: float, n: int, seed: int) -> FloatArray:
    w = 2.0 * math.pi * frequency / RATE
    pole = np.exp(-0.02 * w + 1j * w)
    out = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], np.random.default_rng(seed).normal(size=n))
    return np.asarray(out / out.std())


def test_of_two_driven_modes_the_louder_one_is_the_answer() -> None:
    samples = 2e-4 * resonance(14.0, 10_000, 1) + 1e-5 * resonance(60.0, 10_000, 2)
    samples += 2e-6 * np.random.default_rng(3).normal(size=10_000)
    found = modes_of(samples, RATE)
    assert found.how == 'operation'
    assert found.stretches == ()
    assert np.all(np.isnan(found.fitted))
    assert found.noise == pytest.approx(2e-6, rel=0.2)
    (mode,) = found.modes
    assert abs(mode.frequency - 14.0) < 4.0 * mode.frequency_sd < 0.6


@pytest.mark.parametrize(('peaks', 'above'), [((14.0, 40.0, 90.0, 150.0), (14.0, 40.0)), ((), ()), ((14.0,), ())])
def test_what_stands_above_the_noise_is_looked_for(
    peaks: Sequence[float], above: Sequence[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three peaks at most; the search begins with a damping ratio of a hundredth and the noise above a third."""
    sought: list[Any] = []
    beside: list[list[float]] = []
    driven: list[float] = []

    def loudest(filled: FloatArray, rate: float, white: float, taken: Sequence[float]) -> float | None:
        beside.append(list(taken))
        return peaks[len(taken)] if len(taken) < len(peaks) else None

    def stretches(samples: FloatArray, filled: FloatArray, rate: float, modes: Any, level: float) -> Any:
        sought.append((list(modes), level))
        return [], modes

    noise = ColouredNoise(3e-15, 0.0)
    monkeypatch.setattr(module, 'loudest_peak', loudest)
    monkeypatch.setattr(module, 'coloured_noise', lambda *a: noise)
    monkeypatch.setattr(module, 'exceeds_noise', lambda filled, rate, f, noise: f in above)
    monkeypatch.setattr(module, 'find_stretches', stretches)
    monkeypatch.setattr(module, 'mode_in_operation', lambda filled, rate, f: driven.append(f))
    samples = 2e-6 * np.random.default_rng(4).normal(size=2000)
    found = modes_of(samples, RATE)
    assert (found.how, found.modes) == ('none', ())
    assert found.noise == pytest.approx(2e-6, rel=0.1)
    assert beside == [list(peaks[:k]) for k in range(min(len(peaks) + 1, 3))]
    assert driven == list(above[:1])
    if above:
        ((modes, level),) = sought
        assert modes == [(f, 0.01) for f in above]
        # White noise of that density, from 14/3 Hz to half of the rate.
        assert level == pytest.approx(math.sqrt(3e-15 * (250.0 - 14.0 / 3.0)))
    else:
        assert sought == []
