# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The converter's steps as the samples show them: found where they are coarse, never where they are not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from blind.coverage import Row, coarse, motion, volts_of
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.uncertainty.converter import ConverterSteps
from psd_deflection.rig.config import load_rig
from test import streams

FILE, COARSEST = 20.0 / 2**16, 20.0 / 2**8
TEN = 20.0 / 2**10


def volts(step: float, noise: float, seed: int = 1, n: int = 1000) -> npt.NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-3.0, 3.0, 6) + noise * rng.normal(size=(n, 6))
    return np.asarray(np.rint(levels / step) * step if step else levels, dtype=np.float32)


def fed(samples: npt.NDArray[np.float32], file: float = FILE) -> ConverterSteps:
    steps = ConverterSteps(6, file, COARSEST)
    for first in range(0, len(samples), 20):
        steps.add(samples[first : first + 20])
    return steps


@pytest.mark.parametrize('bits', [8, 10, 12, 14])
@pytest.mark.parametrize('offset', [0.0, 0.5])
@pytest.mark.parametrize('noise', [2e-3, 0.2])
def test_coarse_steps_are_found_on_every_channel(bits: int, offset: float, noise: float) -> None:
    step = 20.0 / 2**bits
    samples = volts(step, noise) + np.float32(offset * step)
    np.testing.assert_allclose(fed(samples).steps, step, rtol=1e-5)


def test_channels_that_never_change_report_by_their_levels() -> None:
    np.testing.assert_allclose(fed(volts(TEN, 0.0)).steps, TEN, rtol=1e-5)
    # A dead channel has no steps, and one level that is far off is none either.
    samples = volts(TEN, 0.0)
    samples[:, 0] = 0.0
    np.testing.assert_allclose(fed(samples).steps, [0.0, *[TEN] * 5], rtol=1e-5)
    assert not fed(np.full((1000, 6), 2.5, np.float32)).steps.any()


@pytest.mark.parametrize('noise', [1.0, 0.0])
def test_what_is_coarser_than_the_coarsest_converter_is_no_step(noise: float) -> None:
    """Volts that lie on multiples of 20 V / 2^7, and toggle or stand still."""
    for step, found in ((2.0 * COARSEST, 0.0), (COARSEST, COARSEST)):
        steps = ConverterSteps.of_rig(load_rig())
        steps.add(volts(step, noise))
        np.testing.assert_allclose(steps.steps, found, rtol=1e-5)


def test_a_coarse_channel_beside_fine_ones_is_that_channel() -> None:
    samples = volts(FILE, 2e-3)
    samples[:, 4] = volts(TEN, 0.05)[:, 4]
    np.testing.assert_allclose(fed(samples).steps, [0.0, 0.0, 0.0, 0.0, TEN, 0.0], rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('step', 'noise', 'file'),
    [
        (FILE, 2e-3, FILE),
        (FILE, 2e-4, FILE),
        (FILE / 4.0, 2e-3, FILE),
        (20.0 / 2**24, 2e-3, 20.0 / 2**24),
        (TEN, 2e-3, TEN),
        (0.0, 2e-3, FILE),
        (0.0, 1e-7, FILE),
    ],
)
def test_steps_that_are_no_coarser_than_the_files_are_none(step: float, noise: float, file: float) -> None:
    for seed in range(200):
        assert not fed(volts(step, noise, seed, 100), file).steps.any()


def test_converter_step_needs_30_samples_and_ends_on_finer() -> None:
    steps = ConverterSteps(1, FILE, COARSEST)
    level = np.zeros((20, 1))
    toggled = level.copy()
    toggled[:10] = TEN
    assert not steps.add(level)
    assert not steps.add(toggled)
    assert not steps.add(toggled)
    assert steps.add(toggled)
    assert steps.steps == pytest.approx([TEN])
    assert not steps.add(toggled)
    toggled[3] += FILE
    assert steps.add(toggled)
    assert not steps.steps.any()


@pytest.mark.slow
def test_ten_bits_untold_are_in_the_intervals() -> None:
    """The finding: 0.77 of the intervals of one axis held the truth."""
    s = coarse(24, reported=False)
    assert min(s.axes) > 0.93
    assert s.joint > 0.93


def test_diagnostics_name_the_steps() -> None:
    pipeline = Pipeline(load_rig())
    list(pipeline.process(streams.chunk(volts_of(Row('10 bit', bits=10), motion(1, 0)[0], 1))))
    assert dict(pipeline.estimator.words())['steps of the converter'] == (
        'x1 19.5 mV, y1 19.5 mV, sum1 19.5 mV, x2 19.5 mV, y2 19.5 mV, sum2 19.5 mV (rig file 0.305 mV)'
    )
