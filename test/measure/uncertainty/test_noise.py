# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Noise of the stream: right in size and colour, deaf to motion; the fit through one block, exact and honest."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest

from blind.coverage import Row, coarse, louder, motion, volts_of
from psd_deflection.measure.averaging import SEGMENT_BLOCKS
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.uncertainty.block_estimator import ConverterSteps
from psd_deflection.measure.uncertainty.block_fit import BlockFit, basis
from psd_deflection.measure.uncertainty.combinations import combinations_of
from psd_deflection.measure.uncertainty.noise import StreamNoise, undithered
from psd_deflection.records import DeflectionEstimate, FloatArray, IntArray, RawChunk
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
    rough = coloured(3 * SEGMENT, 0.0, 24).reshape(-1, SIZE, 4)
    rough[few, :, 0] *= 10.0
    for block, dots in enumerate(rough + ringing(3 * SEGMENT).reshape(-1, SIZE, 4)):
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
    # The least noise of a sample, q^2/12, and what no mean removes, as much.
    assert noise.mean_sd()[3] == pytest.approx(1e-6 * (1.05 / 12.0) ** 0.5, rel=3e-3)
    # If all are dead, nothing moves.
    noise = stream(step=1e-6)
    feed(noise, np.zeros((SEGMENT, 4)))
    assert rested(noise)


def test_another_one_goes_on_from_the_state_to_the_bit() -> None:
    first, other = stream(), stream()
    feed(first, coloured(5 * SEGMENT + 7 * SIZE, 0.3, 18))
    other.set_state(first.state())
    other.set_segment(first.segment())
    # Of whole segments each lag has all its pairs.
    np.testing.assert_allclose(first.state()[-SIZE:], 1.0 - np.arange(SIZE) / SEGMENT)
    more = coloured(3 * SEGMENT, 0.3, 19, 1.2 * SIGMA)
    for noise in (first, other):
        feed(noise, more, 5 * SEGMENT_BLOCKS + 7)
    assert (first.gamma == other.gamma).all()
    with pytest.raises(ValueError, match='346 values, not 5'):
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
    autocorrelation = noise.gamma[range(4), range(4)].mean(axis=0) / SIGMA**2
    # What is sure alone has 5 % too much at lag 0: the rest of it is as it is.
    assert abs(autocorrelation[0] / hum[0] - 1.0) < 0.015
    np.testing.assert_allclose(autocorrelation, hum, atol=0.07)


def test_what_remembers_nothing_goes_on_as_from_the_start() -> None:
    first, other = stream(), stream()
    other.set_state(first.state())
    assert first.state() == other.state() == (0.0,) * 6
    np.testing.assert_array_equal(first.gamma, other.gamma)


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
    'one in motion counts by what does not move': ([1.0, 1.0, 9.0, 9.0, -9.0], 9.0),
    'two louder ones in motion wait': ([1.0, 1.0, -9.0, -9.0], 1.0),
    'the third quieter one in motion is believed': ([1.0, 1.0, *[-0.25] * 3], 0.25),
    'less than 1.4 times is chance': ([1.0, 1.0, *[-1.35] * 3, *[-0.73] * 3], 1.0),
    'above 1.4 times is none': ([1.0, 1.0, *[-1.45] * 3], 1.45),
    'nor is below 0.71 times': ([1.0, 1.0, *[-0.7] * 3], 0.7),
    'what is as before begins the count again': ([1.0, 1.0, -9.0, -9.0, -1.0, -9.0, -9.0], 1.0),
    'after a change in motion rest is believed anew': ([1.0, 1.0, *[-9.0] * 3, 8.0], 8.5),
    'the mean is of twenty': ([*[1.0] * 40, 1.4], 1.0 + 0.4 / 20.0),
}
"""Variances of segments, negative where the plate rings besides; the variance that is used in the end."""


def test_segments_follow_the_rules() -> None:
    segment, wrong = coloured(SEGMENT, 0.0, 30), {}
    for rule, (segments, want) in RULES.items():
        noise = stream()
        for k, times in enumerate(segments):
            feed(noise, abs(times) ** 0.5 * segment + (ringing(SEGMENT) if times < 0.0 else 0.0), k * SEGMENT_BLOCKS)
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
    reported = [(b, of.measured) for b in range(20, 130) if of.add(b, ALL, SIGMA * rng.normal(size=(SIZE, 4)))]
    assert reported == [(49, False), (99, True)]
    # A block of a later segment closes one whose end was lost; too little of one changes nothing.
    of = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, 0.0)
    closed = [b for b in [*range(40), 51, *range(52, 60), 130] if of.add(b, ALL, SIGMA * rng.normal(size=(SIZE, 4)))]
    assert closed == [51]


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
    # First every fourth level, then what lies between: none of it fits the steps so far.
    steps = np.concatenate((4.0 * np.arange(500), 2.0 * np.arange(500) + 1.0))
    np.testing.assert_allclose(fed(np.tile(TEN * steps[:, None], 6).astype(np.float32)).steps, TEN, rtol=1e-5)


@pytest.mark.parametrize('noise', [1.0, 0.0])
def test_what_is_coarser_than_the_coarsest_converter_is_no_step(noise: float) -> None:
    """Volts that lie on multiples of 20 V / 2^7, and toggle or stand still."""
    for step, estimated in ((2.0 * COARSEST, 0.0), (COARSEST, COARSEST)):
        steps = ConverterSteps.of_rig(load_rig())
        steps.add(volts(step, noise))
        np.testing.assert_allclose(steps.steps, estimated, rtol=1e-5)


def test_a_coarse_channel_beside_fine_ones_is_that_channel() -> None:
    samples = volts(FILE, 2e-3)
    samples[:, 4] = volts(TEN, 0.05)[:, 4]
    np.testing.assert_allclose(fed(samples).steps, [0.0, 0.0, 0.0, 0.0, TEN, 0.0], rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('step', 'noise', 'file'),
    [
        *((FILE, 2e-3, FILE), (FILE, 2e-4, FILE), (FILE / 4.0, 2e-3, FILE), (20.0 / 2**24, 2e-3, 20.0 / 2**24)),
        *((TEN, 2e-3, TEN), (0.0, 2e-3, FILE), (0.0, 1e-7, FILE)),
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


GAPS = [ALL, np.delete(ALL, [3, 11]), np.arange(8, 20), np.array([0, 1, 2, 3, 4, 5, 6, 13, 14, 15, 16, 19])]


def white(size: int = SIZE, sigma: float = SIGMA) -> FloatArray:
    gamma = np.zeros((4, 4, size))
    gamma[range(4), range(4), 0] = sigma**2
    return gamma


def fitter(gamma: FloatArray | None = None) -> BlockFit:
    out = BlockFit(SIZE, PLACES, PLACES)
    out.set_noise(white() if gamma is None else gamma)
    return out


def dots_of(pose: FloatArray) -> FloatArray:
    """Flat plate, (n, 4): m = R(-theta)(l - d) - c."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    out = []
    for x, y in PLACES:
        u, v = x - pose[:, 0], y - pose[:, 1]
        out += [c * u + s * v - x, -s * u + c * v - y]
    return np.stack(out, axis=1)


@pytest.mark.parametrize('size', [1, 2, 3, 4, 5, 9, 11, 12, 20, 64, 100])
def test_the_polynomials_are_orthonormal_and_start_with_the_mean(size: int) -> None:
    q = basis(size)
    np.testing.assert_allclose(q.T @ q, np.eye(q.shape[1]), atol=1e-13)
    np.testing.assert_allclose(q[:, 0], size**-0.5)
    orders = {1: 1, 2: 2, 3: 3, 4: 3, 5: 3, 9: 5, 11: 5, 12: 5, 20: 5, 64: 5, 100: 5}
    assert q.shape[1] == orders[size]


def test_last_combination_is_base_line_length() -> None:
    """Over the root of 2, without that of the beams; and the way back is the way there."""
    rng = np.random.default_rng(4)
    for _ in range(5):
        beams = PLACES + 5e-3 * rng.normal(size=(2, 2))
        of, dots = combinations_of(PLACES, beams), 1e-3 * rng.normal(size=(6, 4))
        at = PLACES + dots.reshape(6, 2, 2)
        length = np.linalg.norm(at[:, 0] - at[:, 1], axis=1)
        np.testing.assert_allclose(of.of(dots)[3], (length - np.linalg.norm(beams[0] - beams[1])) / 2**0.5, atol=1e-15)
        np.testing.assert_allclose(of.fixed(dots), of.of(dots)[3], atol=1e-15)
        for row, z in zip(dots, of.of(dots).T, strict=True):
            np.testing.assert_allclose(of.back(z[None], np.eye(4)[None])[0][0], row, atol=1e-15)


@pytest.mark.parametrize('slots', GAPS, ids=lambda s: f'{len(s)} samples')
def test_ringing_plate_with_lost_samples_is_followed(slots: IntArray) -> None:
    """14 and 21 Hz of some tenths of a millimetre, without noise: the mean is tens of micrometres off."""
    fit = fitter()
    t = (ALL - 9.5) * 1e-3
    worst = worst_of_mean = 0.0
    for block in range(60):
        at = t + 0.02 * block
        pose = np.stack((1e-4 * np.sin(88.0 * at), 5e-4 * np.cos(88.0 * at), 2e-3 * np.cos(132.0 * at + 0.3)), axis=1)
        when = 0.02 * block
        truth = dots_of(
            np.array([[1e-4 * np.sin(88.0 * when), 5e-4 * np.cos(88.0 * when), 2e-3 * np.cos(132.0 * when + 0.3)]])
        )[0]
        here = slots if block % 4 == 3 else ALL
        dots = dots_of(pose)[here]
        fitted = fit.fit(here, dots)
        sd = np.sqrt(fitted.covariance.diagonal())
        worst = max(worst, float((abs(fitted.dots - truth) / sd).max()))
        worst_of_mean = max(worst_of_mean, float(abs(dots.mean(axis=0) - truth).max()))
    assert worst < 2.5
    assert worst_of_mean > 3e-5


@pytest.mark.slow
def test_what_is_stated_of_a_dying_motion_is_its_error() -> None:
    """A mode of 14 Hz with 2 % of damping, from 0.1 mm to nothing: motion that is over is stated no longer."""
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(24):
        fit, phase = fitter(), rng.uniform(0.0, 6.28)
        for block in range(180):
            t = 0.02 * block + (ALL - 9.5) * 1e-3
            where, truth = (
                1e-4 * np.exp(-1.76 * at) * np.cos(88.0 * at + phase) for at in (t, np.array([0.02 * block]))
            )
            fitted = fit.fit(ALL, rng.normal(0.0, SIGMA, (SIZE, 4)) + where[:, None] * [1.0, 0.0, 1.0, 0.0])
            if block >= 60:
                squares.append((fitted.dots[0] - truth[0]) ** 2 / fitted.covariance[0, 0])
    assert 0.85 < np.mean(squares) < 1.05


class Dense:
    """The fit as its text says it, with whole matrices: Gaussian coefficients, posterior mean, noise of any colour."""

    def __init__(self, gamma: FloatArray, beams: FloatArray) -> None:
        self.of = combinations_of(PLACES, beams)
        rotated = np.einsum('ac,cdl,bd->abl', self.of.matrix, gamma, self.of.matrix)
        size = gamma.shape[2]
        later = np.subtract.outer(np.arange(size), np.arange(size)).T
        back = rotated.transpose(1, 0, 2)
        self.noise_covariance = np.where(later >= 0, rotated[:, :, np.abs(later)], back[:, :, np.abs(later)])
        self.q = basis(size)
        orders = self.q.shape[1]
        powers = np.polynomial.polynomial.polyvander(np.arange(size) - 0.5 * (size - 1), orders - 1)
        self.middle = np.linalg.lstsq(powers, self.q, rcond=None)[0][0]
        self.size, self.orders = size, orders
        self.usual_v = np.array([np.diag(self.information(a, np.arange(size), orders)) for a in range(4)])
        self.squares, self.weight = np.zeros((4, orders)), np.ones((4, orders))
        self.long, self.blocks = np.zeros((4, orders)), np.full((4, orders), 12.0)

    def information(self, a: int, slots: IntArray, reported: int) -> FloatArray:
        """Covariance (told, told) of the coefficients by generalised least squares."""
        q = self.q[slots, :reported]
        return np.asarray(np.linalg.inv(q.T @ np.linalg.inv(self.noise_covariance[a, a][np.ix_(slots, slots)]) @ q))

    def usual(self) -> FloatArray:
        gaps = 0.15 * (np.maximum(self.weight, 1e-12) ** -0.5 - 1.0)
        usual = np.maximum(self.late() + (gaps - 0.5) * self.usual_v, 1e-9 * self.usual_v)
        return np.asarray(np.maximum(usual, self.long - 0.03 * self.usual_v))

    def late(self) -> FloatArray:
        return np.asarray(self.squares / np.maximum(self.weight, 1e-12))

    def last(self, a: int, excess: FloatArray, sure: FloatArray) -> None:
        """The mean of what goes on alike; where that is over, it begins anew."""
        reported, v = slice(len(excess)), self.usual_v[a, : len(excess)]
        self.blocks[a, reported] = np.minimum(self.blocks[a, reported] + sure, 250.0)
        self.long[a, reported] += sure * (excess - self.long[a, reported]) / self.blocks[a, reported]
        late = self.late()[a, reported]
        least = (0.35 + self.blocks[a, reported] * 0.65 / 250.0) * (v + np.maximum(late, 0.0))
        over = self.long[a, reported] - late > least
        self.long[a, reported] = np.where(over, late, self.long[a, reported])
        self.blocks[a, reported] = np.where(over, 12.0, self.blocks[a, reported])

    def fit(self, slots: IntArray, dots: FloatArray) -> tuple[tuple[float, ...], FloatArray, bool]:
        z, n = self.of.of(dots), len(slots)
        reported = self.orders if n == self.size else min(self.orders, (n + 1) // 2)
        before, q = self.usual(), self.q[slots]
        weights, more, value, poor_fit = np.zeros((4, self.size)), np.zeros(4), np.zeros(4), False
        for a in range(4):
            precision = np.linalg.inv(self.noise_covariance[a, a][np.ix_(slots, slots)])
            noise_covariance = self.information(a, slots, reported)
            c = noise_covariance @ q[:, :reported].T @ precision @ (z[a] - z[a].mean())
            excess = c * c - np.diag(noise_covariance)
            sure = np.minimum(self.usual_v[a, :reported] / np.diag(noise_covariance), 1.0) ** 2
            self.squares[a, :reported] += (sure * excess - self.squares[a, :reported]) / 12.0
            self.weight[a, :reported] += (sure - self.weight[a, :reported]) / 12.0
            self.last(a, excess, sure)
            tau = self.usual()[a]
            sudden = c * c > 16.0 * (np.diag(noise_covariance) + before[a, :reported])
            tau[:reported] = np.where(sudden, np.maximum(excess, tau[:reported]), tau[:reported])
            if reported > 1 and n < self.size:
                expected = noise_covariance[1:, 1:] + np.diag(tau[1:reported])
                if c[1:] @ np.linalg.inv(expected) @ c[1:] > reported - 1 + 3.0 * (2.0 * (reported - 1)) ** 0.5:
                    tau[1:reported] = np.maximum(tau[1:reported], (c * c + np.diag(noise_covariance))[1:])
            if a == 3:
                # The length of the base line: what it does in one block is noise.
                tau = before[a]
            prior = np.diag(np.r_[0.0, 1.0 / tau[1:reported]])
            inverted = np.linalg.inv(q[:, :reported].T @ precision @ q[:, :reported] + prior)
            w = precision @ q[:, :reported] @ inverted @ self.middle[:reported]
            weights[a, slots] = w
            value[a] = w @ z[a]
            more[a] = float((self.middle - w @ q)[1:] ** 2 @ tau[1:])
            residual = z[a] - z[a].mean() - q[:, :reported] @ c
            free = n - reported
            limit = free * (1.0 - 2.0 / 9.0 / free + 3.5 * (2.0 / 9.0 / free) ** 0.5) ** 3 if free else np.inf
            more[a] += 8e-4 * tau[1] if self.size == 2 else 0.0
            if residual @ precision @ residual > limit:
                poor_fit = True
                more[a] += float(residual @ residual) / free
        covariance = np.einsum('as,abst,bt->ab', weights, self.noise_covariance, weights) + np.diag(more)
        dots, noise_covariance = self.of.back(value[None], covariance[None])
        return tuple(dots[0].tolist()), noise_covariance[0], poor_fit


@pytest.mark.parametrize('size', [2, 3, 4, 5, 12, 20])
def test_the_fit_is_the_posterior_of_gaussian_coefficients(size: int) -> None:
    """Through rest, motion, jumps and gaps, with noise that has colour and is common to readings."""
    rng = np.random.default_rng(8)
    now, before = SIGMA * rng.normal(size=(2, 4, 4))
    gamma = np.zeros((4, 4, size))
    gamma[:, :, 0] = now @ now.T + before @ before.T + SIGMA**2 * np.eye(4)
    gamma[:, :, 1] = now @ before.T
    beams = PLACES + 1e-3 * rng.normal(size=(2, 2))
    fit, dense = BlockFit(size, PLACES, beams), Dense(gamma, beams)
    fit.set_noise(gamma)
    u = np.linspace(-1.0, 1.0, size)
    misfits = 0
    for block in range(190):
        e = rng.normal(size=(size + 1, 4))
        dots = e[1:] @ now.T + e[:-1] @ before.T + SIGMA * rng.normal(size=(size, 4))
        dots += (beams - PLACES).ravel()
        phase = block // 15
        if phase in (1, 4):
            dots += SIGMA * 10.0 ** (1 + block % 3) * np.sin(2.0 * u + block)[:, None] * [1.0, 0.5, 1.0, -0.3]
        if phase in (2, 5) and block % 5 == 0:
            dots[size // 3 :] += SIGMA * rng.choice([3.0, 8.0, 30.0]) * rng.normal(size=4)
        slots = np.arange(size)
        if block == 5:
            # Those of the mean that lasts are 250 at most.
            fit.memory.lasting[1] = dense.blocks[:] = 248.0
        if phase in (3, 4, 5):
            slots = np.sort(rng.choice(size, int(rng.integers(1, size + 1)), replace=False))
        if phase > 5:
            # So few at one end that nothing is learnt of motion, and what was is forgotten.
            slots = np.arange(size - size // 3 - 1, size)
        got = fit.fit(slots, dots[slots])
        want, covariance, poor_fit = dense.fit(slots, dots[slots])
        sd = np.sqrt(np.diag(covariance))
        assert got.poor_fit == poor_fit, block
        np.testing.assert_allclose((np.array(got.dots) - want) / sd, 0.0, atol=1e-6, err_msg=str(block))
        np.testing.assert_allclose((got.covariance - covariance) / np.outer(sd, sd), 0.0, atol=1e-6, err_msg=str(block))
        misfits += poor_fit
    assert misfits > 0 or size < 4


def shaken(fit: BlockFit, hz: float, amplitude: float, blocks: int, seed: int = 5) -> tuple[FloatArray, FloatArray]:
    """Error over standard deviation (n,) of x1, and that (n,), of both plates' x that sway along with white noise."""
    rng = np.random.default_rng(seed)
    omega = 2.0 * np.pi * hz / 1000.0
    errors, sds = [], []
    for block in range(blocks):
        sway = amplitude * np.sin(omega * (block * SIZE + ALL) + 0.7)
        dots = np.outer(sway, [1.0, 0.0, 1.0, 0.0]) + rng.normal(0.0, SIGMA, (SIZE, 4))
        fitted = fit.fit(ALL, dots)
        sds.append(float(fitted.covariance[0, 0] ** 0.5))
        errors.append(fitted.dots[0] - amplitude * np.sin(omega * (block * SIZE + 9.5) + 0.7))
    return np.array(errors) / np.array(sds), np.array(sds)


@pytest.mark.slow
@pytest.mark.parametrize(('hz', 'amplitude'), [(5.0, 15e-6), (20.0, 15e-6), (30.0, 10e-6)])
def test_variance_covers_motion_curved_by_noise_level(hz: float, amplitude: float) -> None:
    z, _ = shaken(fitter(), hz, amplitude, 4000)
    assert 0.94 < np.mean(np.abs(z[500:]) < 1.959964) < 0.97


@pytest.mark.slow
def test_at_rest_the_memory_of_motion_adds_little_noise() -> None:
    z, sds = shaken(fitter(), 5.0, 0.0, 4000)
    assert np.std(z * sds) < 1.04 * SIGMA / SIZE**0.5 / 2.0**0.5 * 2.0**0.5
    assert np.mean(np.abs(z) < 1.959964) == pytest.approx(0.955, abs=0.012)


@pytest.mark.parametrize(('size', 'coloured'), [(64, True), (65, False)])
def test_colour_makes_the_weights_of_blocks_up_to_64_samples(size: int, coloured: bool) -> None:
    """Noise of the one lag: in motion the weights are those of generalised, or of ordinary, least squares."""
    gamma = np.zeros((4, 4, size))
    gamma[range(4), range(4), 0], gamma[range(4), range(4), 1] = SIGMA**2, 0.45 * SIGMA**2
    fit, rng = BlockFit(size, PLACES, PLACES), np.random.default_rng(7)
    fit.set_noise(gamma)
    powers = np.polynomial.polynomial.polyvander(np.linspace(-1.0, 1.0, size), 4)
    at = np.arange(size)
    for _ in range(100):
        dots = np.outer(1e-3 * powers @ rng.normal(size=5), [1.0, 0.0, 1.0, 0.0])
        dots += SIGMA * rng.normal(size=(size, 4))
        fit.fit(at, dots)
    toeplitz = np.eye(size) + 0.45 * (np.eye(size, k=1) + np.eye(size, k=-1))
    weight = np.linalg.inv(toeplitz) if coloured else np.eye(size)
    want = (np.linalg.inv(powers.T @ weight @ powers) @ powers.T @ weight @ dots)[0]
    got = fit.fit(at, dots).dots
    assert got[0] + got[2] == pytest.approx(want[0] + want[2], abs=2e-9)


def swaying(size: int, lost: tuple[int, ...] = ()) -> FloatArray:
    """Errors of ΔY over their standard deviations: 14 Hz of 0.3 mm, blocks of ``size``, of which slots are ``lost``."""
    rng, n = np.random.default_rng(1), 30_000
    seq = np.arange(n)
    volts = np.tile([0.0, 0.0, 5.0], (n, 2))
    volts[:, 1::3] -= 0.6 * np.sin(88.0 * 1e-3 * seq + 0.3)[:, None]
    volts += 2e-3 * rng.normal(size=volts.shape)
    seq = seq[~np.isin(seq % size, lost)]
    pipeline = Pipeline(load_rig(overrides={'block_size': size, 'min_samples': 5, 'solvers': ['exact']}))
    chunk = RawChunk(seq, seq * 1_000_000, volts[seq].astype(np.float32), np.zeros(len(seq), np.uint8))
    estimates = [r for r in pipeline.process(chunk) if isinstance(r, DeflectionEstimate) and r.t_ns > 5_000_000_000]
    return np.array([(r.dy - 3e-4 * np.sin(88.0e-9 * r.t_ns + 0.3)) / r.covariance[4] ** 0.5 for r in estimates])


def test_blocks_losing_their_end_cover_their_error() -> None:
    """Weights of some 1e-5 a block are weights: 0.93 were within three deviations, and the rms error was 6 um."""
    assert np.mean(np.abs(swaying(20, tuple(range(12, 20)))) < 3.0) > 0.99


@pytest.mark.parametrize('present', [range(10, 20), range(7, 20), range(11)])
def test_motion_that_begins_in_lost_samples_is_in_the_intervals(present: Sequence[int]) -> None:
    """After rest: coefficients far apart, each of which might be noise, are no noise together (200 um off at 0.6)."""
    rng, slots = np.random.default_rng(5), np.array(present)
    z = []
    for _ in range(60):
        fit = fitter()
        for _ in range(20):
            fit.fit(ALL, SIGMA * rng.normal(size=(SIZE, 4)))
        size, phase = 10.0 ** rng.uniform(-4.5, -2.8), rng.uniform(0.0, 2.0 * np.pi, size=2)
        t = np.append(ALL - 9.5, 0.0) * 1e-3
        y, theta = size * np.cos(88.0 * t + phase[0]), 4.0 * size * np.cos(132.0 * t + phase[1])
        dots = dots_of(np.stack((0.0 * t, y, theta), axis=1))
        fitted = fit.fit(slots, dots[slots] + SIGMA * rng.normal(size=(len(slots), 4)))
        z.append((np.array(fitted.dots) - dots[-1]) / np.sqrt(np.diag(fitted.covariance)))
    assert np.mean(np.abs(z) < 3.0) > 0.97


@pytest.mark.slow
@pytest.mark.parametrize('times', [0.5, 2.0])
def test_noise_that_changes_while_loads_do_is_learnt(times: float) -> None:
    """A load every 4 s. Of the doubled noise 0.91 of the regions held the truth, of the halved 1.00."""
    got = louder(times, 4)
    assert 0.93 < min(*got.axes, got.joint) <= max(*got.axes, got.joint) < 0.975
