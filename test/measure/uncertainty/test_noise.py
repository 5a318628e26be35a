# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Noise of the stream: right in size and colour, deaf to motion, not below the steps of the converter (found, too)."""

import numpy as np
import numpy.typing as npt
import pytest

from blind.coverage import Row, coarse, motion, volts_of
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.uncertainty.block_estimator import ConverterSteps
from psd_deflection.measure.uncertainty.noise import SEGMENT_BLOCKS, StreamNoise, undithered
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig
from test import streams

PLACES = np.array([[0.0, 0.070], [-0.100, 0.0]])
SIGMA = 1e-6
SIZE = 20
ALL = np.arange(SIZE)
SEGMENT = SEGMENT_BLOCKS * SIZE
STEP = 1e-9


def stream(step: float = STEP) -> StreamNoise:
    return StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, step)


def coloured(n: int, memory: float, seed: int, sigma: float = SIGMA) -> FloatArray:
    e = np.random.default_rng(seed).normal(size=(n, 4))
    out = np.empty_like(e)
    out[0] = e[0]
    for i in range(1, n):
        out[i] = memory * out[i - 1] + (1.0 - memory**2) ** 0.5 * e[i]
    return out * sigma


def feed(noise: StreamNoise, dots: FloatArray, first: int = 0, lost: tuple[int, ...] = ()) -> None:
    slots = np.delete(np.arange(SIZE), lost)
    for b in range(len(dots) // SIZE):
        noise.add(first + b, slots, dots[SIZE * b : SIZE * b + SIZE][slots])


def ringing(n: int) -> FloatArray:
    """A flat plate that swings by 0.2 mm and 1 mrad, (n, 4), m."""
    t = np.arange(n) * 1e-3
    y, theta = 2e-4 * np.sin(88.0 * t), 1e-3 * np.sin(132.0 * t)
    out = []
    for px, py in PLACES:
        c, s = np.cos(theta), np.sin(theta)
        out += [c * px + s * (py - y) - px, -s * px + c * (py - y) - py]
    return np.stack(out, axis=1)


def mean_variance(memory: float) -> float:
    lags = np.arange(SIZE)
    return float((memory ** abs(lags[:, None] - lags)).mean())


@pytest.mark.slow
@pytest.mark.parametrize('memory', [0.0, 0.3, 0.6, 0.9])
@pytest.mark.parametrize('lost', [(), (2, 3, 11)], ids=['all', 'gaps'])
def test_the_variance_of_a_mean_is_found_with_its_colour(memory: float, lost: tuple[int, ...]) -> None:
    noise = stream()
    feed(noise, coloured(15 * SEGMENT, memory, 4, 2.0 * SIGMA), lost=lost)
    assert noise.measured
    assert rested(noise)
    np.testing.assert_allclose(noise.mean_sd(), 2.0 * SIGMA * mean_variance(memory) ** 0.5, rtol=0.12)
    np.testing.assert_allclose(noise.sample_sd(), 2.0 * SIGMA, rtol=0.06)


def test_motion_is_not_taken_for_noise() -> None:
    noise = stream()
    feed(noise, coloured(5 * SEGMENT, 0.0, 6))
    before = noise.gamma.copy()
    feed(noise, coloured(5 * SEGMENT, 0.0, 7) + ringing(5 * SEGMENT), 5 * SEGMENT_BLOCKS)
    assert (noise.gamma == before).all()


def rested(noise: StreamNoise) -> bool:
    return noise.at_rest


def test_restless_rig_takes_noise_colour_of_base_line() -> None:
    noise = stream()
    feed(noise, coloured(10 * SEGMENT, 0.6, 8) + ringing(10 * SEGMENT))
    assert not rested(noise)
    np.testing.assert_allclose(noise.mean_sd(), SIGMA * mean_variance(0.6) ** 0.5, rtol=0.25)
    feed(noise, coloured(10 * SEGMENT, 0.6, 9), 10 * SEGMENT_BLOCKS)
    assert rested(noise)
    np.testing.assert_allclose(noise.mean_sd(), SIGMA * mean_variance(0.6) ** 0.5, rtol=0.12)


@pytest.mark.parametrize(('present', 'reported'), [(6, False), (7, True)])
def test_blocks_of_two_samples_beyond_orders_tell_roughness(present: int, reported: bool) -> None:
    """In motion, by five orders: x1 is ten times as noisy in three of five blocks, which have so many samples."""
    noise, few = stream(), np.arange(3 * SEGMENT_BLOCKS) % 5 > 1
    own = coloured(3 * SEGMENT, 0.0, 24).reshape(-1, SIZE, 4)
    own[few, :, 0] *= 10.0
    for block, dots in enumerate(own + ringing(3 * SEGMENT).reshape(-1, SIZE, 4)):
        slots = ALL[: 3 * present : 3] if few[block] else ALL
        noise.add(block, slots, dots[slots])
    x1, y1, *_ = noise.sample_sd()
    assert (x1 > 2.0 * y1) == reported


def test_one_spike_is_not_noise() -> None:
    noise = stream()
    feed(noise, coloured(5 * SEGMENT, 0.0, 14))
    before = noise.gamma.copy()
    dots = coloured(SEGMENT, 0.0, 15)
    dots[333, 2] += 1e-3
    feed(noise, dots, 5 * SEGMENT_BLOCKS)
    assert (noise.gamma == before).all()


@pytest.mark.slow
@pytest.mark.parametrize(('sigma', 'seeds'), [(0.0, 1), (0.3, 1), (0.6, 1)])
def test_mean_of_coarse_readings_is_within_reported_error(sigma: float, seeds: int) -> None:
    """Steps of 10 um: over all places between two steps, the rms error of the mean is what is stated, or less."""
    step = 10e-6
    rng = np.random.default_rng(16)
    errors, stated = [], []
    for place in np.linspace(0.0, 1.0, 40):
        noise = StreamNoise(SIZE, PLACES, PLACES, max(sigma * step, 1e-9) ** 2 + step**2 / 12.0, step)
        dots = step * np.round(place + rng.normal(0.0, sigma, (3 * SEGMENT, 4)))
        feed(noise, dots)
        errors.append(dots.reshape(-1, SIZE, 4).mean(axis=1) - step * place)
        stated.append(noise.mean_sd() ** 2)
    rms, message = float(np.mean(np.square(errors)) ** 0.5), float(np.mean(stated) ** 0.5)
    assert rms <= 1.05 * message
    assert message < 2.5 * rms


def test_a_dead_reading_is_no_better_than_a_converters_step() -> None:
    noise = stream(step=1e-6)
    dots = coloured(4 * SEGMENT, 0.0, 17)
    dots[:, 3] = 0.0
    feed(noise, dots)
    assert noise.mean_sd()[3] >= 1e-6 / 12.0**0.5
    # If all are dead, nothing moves.
    noise = stream(step=1e-6)
    feed(noise, np.zeros((SEGMENT, 4)))
    assert rested(noise)


def test_another_one_goes_on_from_the_state_to_the_bit() -> None:
    one, other = stream(), stream()
    feed(one, coloured(5 * SEGMENT + 7 * SIZE, 0.3, 18))
    other.set_state(one.state())
    other.set_segment(one.segment())
    more = coloured(3 * SEGMENT, 0.3, 19, 1.2 * SIGMA)
    for noise in (one, other):
        feed(noise, more, 5 * SEGMENT_BLOCKS + 7)
    assert (one.gamma == other.gamma).all()
    with pytest.raises(ValueError, match='344 values, not 5'):
        other.set_state((0.0,) * 5)


def test_gaps_take_nothing_off_the_colour_of_hum() -> None:
    """A fifth of the samples is lost, and of a segment alone the matrix is no covariance."""
    noise, rng = stream(), np.random.default_rng(22)
    t = np.arange(20 * SEGMENT)
    dots = coloured(len(t), 0.0, 23) + 2.5 * SIGMA * np.sin(0.12 * np.pi * t)[:, None]
    here = rng.random(len(t)).reshape(-1, SIZE) > 0.2
    for block, present in enumerate(here):
        slots = np.flatnonzero(present)
        noise.add(block, slots, dots[SIZE * block + slots])
    hum = 0.5 * 2.5**2 * np.cos(0.12 * np.pi * np.arange(SIZE))
    hum[0] += 1.0
    own = noise.gamma[range(4), range(4)].mean(axis=0) / SIGMA**2
    # What is sure alone has 5 % too much at lag 0: the rest of it is as it is.
    assert abs(own[0] / hum[0] - 1.0) < 0.015
    np.testing.assert_allclose(own, hum, atol=0.07)


def test_what_remembers_nothing_goes_on_as_from_the_start() -> None:
    one, other = stream(), stream()
    other.set_state(one.state())
    assert one.state() == other.state() == (0.0, 0.0, 0.0, 0.0)
    np.testing.assert_array_equal(one.gamma, other.gamma)


# Segments that are one and the same but for their size: its autocovariance goes with the variance exactly.
RULES = {
    'a segment joins the mean': ([1.0, 1.0, 1.5], 3.5 / 3.0),
    'below twice it joins': ([1.0, 1.0, 1.9], 3.9 / 3.0),
    'above twice it waits': ([1.0, 1.0, 2.1], 1.0),
    'above two fifths it joins': ([1.0, 1.0, 0.41], 2.41 / 3.0),
    'below two fifths it is believed': ([1.0, 1.0, 0.39], 0.39),
    'two louder ones wait': ([1.0, 1.0, 9.0, 9.0], 1.0),
    'the third louder one is believed': ([1.0, 1.0, 9.0, 9.0, 9.0], 9.0),
    'an old one in between begins the count again': ([1.0, 1.0, 9.0, 9.0, 1.0, 9.0, 9.0], 1.0),
    'so does one in motion': ([1.0, 1.0, 9.0, 9.0, -9.0, 9.0, 9.0], 1.0),
    'three after it are believed': ([1.0, 1.0, 9.0, -9.0, 9.0, 9.0, 9.0], 9.0),
    'the mean is of twenty': ([*[1.0] * 40, 1.4], 1.0 + 0.4 / 20.0),
}
"""Variances of segments, negative where the plate rings besides; the variance that is used in the end."""


def test_segments_follow_the_rules() -> None:
    one, wrong = coloured(SEGMENT, 0.0, 30), {}
    for rule, (segments, want) in RULES.items():
        noise = stream()
        for k, times in enumerate(segments):
            feed(noise, abs(times) ** 0.5 * one + (ringing(SEGMENT) if times < 0.0 else 0.0), k * SEGMENT_BLOCKS)
            if k == 1:
                first = noise.sample_sd()
        got = float(np.mean(np.square(noise.sample_sd() / first)))
        if got != pytest.approx(want, rel=1e-3):
            wrong[rule] = got
    assert wrong == {}


@pytest.mark.parametrize('sigma', [0.0, 0.2, 0.35])
def test_undithered_rounding_stays_as_error(sigma: float) -> None:
    """Mean square over all places of the mean of the rounded reading less the place, added up by hand."""
    step = 3.0
    place = (np.arange(2000) + 0.5) / 2000.0
    deviate = np.linspace(-7.0, 7.0, 4001)
    weight = np.exp(-0.5 * deviate**2) / np.exp(-0.5 * deviate**2).sum()
    mean = np.rint(place[:, None] + sigma * deviate) @ weight
    want = step**2 * float(np.mean((mean - place) ** 2))
    assert undithered((sigma * step) ** 2, step) == pytest.approx(want, rel=5e-3)
    assert undithered(1.0, 0.0) == 0.0


def test_each_reading_has_its_own_steps_and_noise() -> None:
    of = StreamNoise(SIZE, PLACES, PLACES, 1e-12 * np.arange(1.0, 5.0), 1e-6 * np.arange(4.0))
    for c in range(4):
        alone = StreamNoise(SIZE, PLACES, PLACES, 1e-12 * (c + 1.0), 1e-6 * c).gamma[c, c]
        np.testing.assert_allclose(of.gamma[c, c], alone, rtol=1e-12)
    np.testing.assert_allclose(of.sample_sd(), np.sqrt([of.gamma[c, c, 0] for c in range(4)]))


def test_a_segment_need_not_be_whole_to_be_of_its_place() -> None:
    """Segments are of 50 blocks by their numbers: what begins in the middle of one ends with it."""
    of = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, 0.0)
    rng = np.random.default_rng(8)
    reported = [b for b in range(20, 130) if of.add(b, ALL, SIGMA * rng.normal(size=(SIZE, 4)))]
    assert reported == [49, 99]
    # A block of a later segment closes one whose end was lost; too little of one changes nothing.
    of = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, 0.0)
    reported = [b for b in [*range(40), 51, *range(52, 60), 130] if of.add(b, ALL, SIGMA * rng.normal(size=(SIZE, 4)))]
    assert reported == [51]


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


@pytest.mark.parametrize('bits', [8, 10, 12, 14, 15])
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
