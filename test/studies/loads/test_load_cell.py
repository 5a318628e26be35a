# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Loads that a load cell measured: noise goes, motion stays."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from psd_deflection.records import FloatArray
from psd_deflection.studies.loads.load_cell import MeasuredLoad, without_cell_noise


def measured_along_y(values: FloatArray, *, held: int = 2) -> tuple[FloatArray, tuple[MeasuredLoad, ...]]:
    """What becomes of ``values`` (k,) of a cell along Y, each held for so many samples."""
    loads = np.zeros((held * len(values), 3))
    loads[:, 1] = np.repeat(values, held)
    return without_cell_noise(loads)


def with_memory(count: int, wanted: float) -> FloatArray:
    """Values whose correlation with the next one is as ``wanted``."""
    white = np.random.default_rng(2).normal(size=count + 1)

    def mixed(share: float) -> FloatArray:
        return np.asarray(white[1:] + share * white[:-1])

    def memory(share: float) -> float:
        about = mixed(share) - mixed(share).mean()
        return float(about[1:] @ about[:-1] / (about @ about))

    return mixed(brentq(lambda share: memory(share) - wanted, -0.99, 0.99))


@pytest.mark.parametrize(
    ('count', 'memory', 'noise'),
    [
        (400, 0.19, True),
        (400, -0.19, True),
        (400, 0.21, False),
        (400, -0.21, False),
        (10_000, 0.145, True),
        (10_000, 0.155, False),
        (10_000, -0.155, False),
    ],
)
def test_noise_correlation_is_below_four_over_root_n(count: int, memory: float, noise: bool) -> None:
    values = with_memory(count, memory)
    loads, measured = measured_along_y(values)
    assert len(measured) == noise
    if noise:
        assert loads[:, 1] == pytest.approx(np.full(2 * count, values.mean()))
    # Whatever its unit.
    assert len(measured_along_y(1e-3 * values)[1]) == noise
    # And so it is of the part after a step.
    first = with_memory(count, 0.0)
    assert len(measured_along_y(np.concatenate((first, 1000.0 + values)))[1]) == 1 + noise
    # That along Y says all, whatever the others do.
    both = np.zeros((2 * count, 3))
    both[:, 1] = np.repeat(values, 2)
    both[:, 0] = np.repeat(np.random.default_rng(3).normal(size=count), 2)
    assert len(without_cell_noise(both)[1]) == noise


@pytest.mark.parametrize(
    ('changes', 'samples', 'reported'), [(49, 400, 0), (50, 400, 1), (99, 5000, 0), (100, 5000, 1)]
)
def test_loads_that_change_at_a_fiftieth_are_measured(changes: int, samples: int, reported: int) -> None:
    loads = np.zeros((samples, 3))
    at = np.arange(changes + 1) * (samples // (changes + 1))
    for first, value in zip(at.tolist(), np.random.default_rng(4).normal(size=changes + 1).tolist(), strict=True):
        loads[first:, 0] = value
    assert len(without_cell_noise(loads)[1]) == reported


@pytest.mark.parametrize(('times', 'parts'), [(7.9, 1), (8.1, 2), (-7.9, 1), (-8.1, 2)])
def test_load_step_is_above_eight_deviations_of_noise(times: float, parts: int) -> None:
    values = np.random.default_rng(5).normal(size=2001)
    steps = np.abs(np.diff(values))
    # The median of a normal law's absolute values is 0.6745 deviations; of a difference the deviation is root 2 larger.
    noise = float(np.median(steps)) / 0.67449 / 2.0**0.5
    assert steps.max() < 7.0 * noise
    # Back in two smaller ones.
    values[1000:1002] = values[999] + np.array([1.0, 0.5]) * times * noise
    assert len(measured_along_y(values)[1]) == parts


def test_a_step_of_1e_9_n_is_none() -> None:
    noise = np.random.default_rng(6).normal(size=600)
    for step, parts in ((0.5, 2), (2e-8, 2), (8.0 * 1e-9, 1), (5e-9, 1)):
        loads = np.zeros((600, 3))
        loads[:, 1] = noise
        loads[300:, 2] = step
        assert [m.first for m in without_cell_noise(loads)[1]] == [0, 300][:parts]
