# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The parts of the noise estimate and of the fit, each against the definition written with dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.uncertainty import noise
from psd_deflection.measure.uncertainty.block_fit import BlockFit, basis
from psd_deflection.measure.uncertainty.noise import SEGMENT_BLOCKS, StreamNoise
from psd_deflection.records import DeflectionEstimate, FloatArray, IntArray, RawChunk
from psd_deflection.rig.config import load_rig

PLACES = np.array([[0.0, 0.070], [-0.100, 0.0]])
SIZE = 20
SIGMA = 1e-6
ALL = np.arange(SIZE)


def white(times: float) -> FloatArray:
    gamma = np.zeros((4, 4, SIZE))
    gamma[range(4), range(4), 0] = times * SIGMA**2
    return gamma


@pytest.mark.parametrize('size', [1, 2, 20])
def test_the_variance_of_a_mean_is_that_of_the_toeplitz_matrix(size: int) -> None:
    lags = np.random.default_rng(0).normal(size=size)
    whole = lags[np.abs(np.subtract.outer(np.arange(size), np.arange(size)))]
    assert lags @ noise._mean_weights(size) == pytest.approx(whole.mean(), rel=1e-12)


def put_back(lags: FloatArray) -> FloatArray:
    """(c, c), or a number: what mean and slope took off, from the covariances (100, c, c) at the first 100 lags.

    They take 2 of the 10 degrees of freedom of the means over 100 samples, a tenth of a segment.
    """
    apart = np.subtract.outer(np.arange(100), np.arange(100))
    later = np.where((apart >= 0)[..., None, None], lags[np.abs(apart)], lags[np.abs(apart)].swapaxes(2, 3))
    return np.asarray(2.0 * later.mean(axis=(0, 1)) / (10 - 2))


def test_an_autocovariance_is_the_mean_product_of_what_is_left_of_a_line() -> None:
    n = SEGMENT_BLOCKS * SIZE
    rng = np.random.default_rng(1)
    e = rng.normal(size=(n + 1, 3))
    series = e[1:] + 0.5 * e[:-1] + np.outer(np.arange(n), [1e-2, -2e-2, 0.0]) + [5.0, 0.0, -3.0]
    series[:, 1] += 0.3 * series[:, 0]
    left = series - np.column_stack([np.polyval(np.polyfit(np.arange(n), s, 1), np.arange(n)) for s in series.T])
    got, sure = noise._autocovariance(np.arange(n), series, n, SIZE)
    every = np.array([left[: n - lag].T @ left[lag:] / (n - lag) for lag in range(100)])
    for lag in (0, 1, 7, 19):
        want = every[lag] + put_back(every)
        np.testing.assert_allclose(got[:, :, lag], want, atol=3e-6)
    # Without gaps all but what the ends cost is sure.
    np.testing.assert_allclose(sure, 1.0 - np.arange(SIZE) / n)


def test_an_autocovariance_leaves_gaps_out() -> None:
    n = SEGMENT_BLOCKS * SIZE
    rng = np.random.default_rng(2)
    keep = np.sort(rng.choice(n, 7 * n // 10, replace=False))
    e = rng.normal(size=(n + 1, 1))
    series = np.tile(e[1:] + 0.5 * e[:-1], (1, 2))[keep]
    got, sure = noise._autocovariance(keep, series, n, SIZE)
    line = np.polyval(np.polyfit(keep, series[:, 0], 1), keep)
    here = np.full(n, np.nan)
    here[keep] = series[:, 0] - line
    every = np.array([np.nanmean(here[: n - lag] * here[lag:]) for lag in range(100)])
    for lag in (0, 1, 2, 13):
        assert got[0, 0, lag] == pytest.approx(every[lag] + put_back(every[:, None, None]).item(), abs=3e-6)
    # Times the share of pairs that are there, over the least of them.
    pairs = np.array([np.isin(keep + lag, keep).sum() / (n - lag) for lag in range(SIZE)])
    np.testing.assert_allclose(sure / (1.0 - np.arange(SIZE) / n), pairs / pairs.min(), rtol=1e-9)


def test_of_what_is_no_covariance_as_little_as_makes_it_one_is_taken_off() -> None:
    """A correlation of 0.8 with the next of three samples and none with the last: 0.707 is the most there may be."""
    each, sure = np.zeros((1, 1, 3)), np.array([1.0, 0.5, 1.0])
    each[0, 0, :2] = 1.0, 0.8
    root_half = 0.5**0.5
    made = noise._covariance(each, sure)[0, 0]
    # Three tenths of what is taken off if all is made sure.
    np.testing.assert_allclose(made, [1.001, 0.8 * 0.85, 0.0], rtol=1e-9)
    assert made[1] < root_half < 0.8 * 0.95
    for correlation, share in ((0.71, 0.03), (0.74, 0.1), (1.2, 1.0)):
        each[0, 0, 1] = correlation
        made = noise._covariance(each, sure)[0, 0]
        np.testing.assert_allclose(made, [1.001, correlation * (1.0 - 0.5 * share), 0.0], rtol=1e-9)
    # What is one is left as it is, but for a thousandth of its own.
    each[0, 0, 1] = 0.7
    np.testing.assert_allclose(noise._covariance(each, sure)[0, 0], [1.001, 0.7, 0.0], rtol=1e-9)


@pytest.mark.parametrize('hum', [0.0, 3.0])
def test_hum_is_not_taken_for_what_a_line_takes_off(hum: float) -> None:
    n = SEGMENT_BLOCKS * SIZE
    rng = np.random.default_rng(4)
    t = np.arange(100 * n).reshape(100, n)
    lines = hum * np.sin(2.0 * np.pi * 0.06 * t)
    found = np.mean(
        [
            noise._autocovariance(t[0], np.column_stack((r, r)), n, SIZE)[0][0, 0]
            for r in rng.normal(size=t.shape) + lines
        ],
        axis=0,
    )
    lags = np.arange(SIZE)
    want = 0.5 * hum**2 * np.cos(2.0 * np.pi * 0.06 * lags) + (lags == 0)
    # Of the variance of a block's mean, 0.05, four per cent.
    assert (found - want) @ noise._mean_weights(SIZE) == pytest.approx(0.0, abs=2e-3)


def test_roughness_is_the_median_over_blocks_of_what_a_polynomial_leaves() -> None:
    rng = np.random.default_rng(3)
    n = SEGMENT_BLOCKS * SIZE
    places = np.delete(np.arange(n), [3, 4, 111, *range(200, 214)])
    series = rng.normal(size=(len(places), 2)) + np.column_stack((places**2 * 1e-3, np.zeros(len(places))))
    q = basis(SIZE)
    each = []
    for block in range(SEGMENT_BLOCKS):
        at = places // SIZE == block
        # Six samples of a block that lost fourteen say too little: five orders leave one.
        if at.sum() < q.shape[1] + 2:
            continue
        used = q[places[at] % SIZE]
        left = series[at] - used @ np.linalg.lstsq(used, series[at], rcond=None)[0]
        each.append((left**2).sum(axis=0) / (at.sum() - q.shape[1]))
    assert len(each) == SEGMENT_BLOCKS - 1
    np.testing.assert_allclose(noise._roughness(places, series, q), np.median(each, axis=0), rtol=1e-6)


@pytest.mark.parametrize('sigma', [0.0, 0.2, 0.35])
def test_what_noise_does_not_dither_stays_as_an_error_of_rounding(sigma: float) -> None:
    """Mean square over all places of the mean of the rounded reading less the place, added up by hand."""
    step = 3.0
    place = (np.arange(2000) + 0.5) / 2000.0
    deviate = np.linspace(-7.0, 7.0, 4001)
    weight = np.exp(-0.5 * deviate**2) / np.exp(-0.5 * deviate**2).sum()
    mean = np.rint(place[:, None] + sigma * deviate) @ weight
    want = step**2 * float(np.mean((mean - place) ** 2))
    assert noise.undithered((sigma * step) ** 2, step) == pytest.approx(want, rel=5e-3)
    assert noise.undithered(1.0, 0.0) == 0.0


def test_a_segment_is_judged_by_its_roughness_and_that_of_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding to a step q adds q^2/12."""
    step, sigma = 4e-6, 1e-9
    of = StreamNoise(SIZE, PLACES, PLACES, sigma**2, step)
    seen: list[FloatArray] = []
    monkeypatch.setattr(of, '_judge', lambda gamma, sure, fixed, rough: seen.append(rough))
    monkeypatch.setattr(of, '_in_use', lambda: of.gamma)
    rng = np.random.default_rng(0)
    for block in range(2 * SEGMENT_BLOCKS):
        of.add(block, np.arange(SIZE), sigma * rng.normal(size=(SIZE, 4)))
    for rough in seen:
        np.testing.assert_allclose(rough, step**2 / 12.0, rtol=1e-3)
    assert seen


def stream() -> StreamNoise:
    out = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, 0.0)
    out._judge(white(1.0), np.ones(SIZE), white(1.0)[0, 0], np.full(8, SIGMA**2))
    out._seen = 5
    out.gamma = out._in_use()
    return out


def level(of: StreamNoise) -> float:
    # A thousandth is added as a reading's own.
    return float(of._in_use()[0, 0, 0]) / 1.001 / SIGMA**2


def judge(of: StreamNoise, times: float, rough: float | None = None) -> None:
    """A segment at rest with so much variance; ``rough``: of the combinations that move, if it is not that."""
    roughness = np.full(8, times * SIGMA**2)
    roughness[:3] *= 1.0 if rough is None else rough
    of._judge(white(times), np.ones(SIZE), white(times)[0, 0], roughness)


def test_a_segment_joins_the_mean_of_the_last_twenty() -> None:
    of = stream()
    judge(of, 1.5)
    assert level(of) == pytest.approx(1.25)
    for _ in range(40):
        judge(of, 1.25)
    judge(of, 1.45)
    assert level(of) == pytest.approx(1.25 + 0.2 / 20.0, abs=2e-4)


@pytest.mark.parametrize(('times', 'after'), [(1.9, 1.45), (2.1, 1.0), (0.45, 0.725), (0.35, 0.35)])
def test_noise_that_doubles_waits_and_noise_that_falls_below_two_fifths_is_believed(times: float, after: float) -> None:
    of = stream()
    judge(of, times)
    assert level(of) == pytest.approx(after)


def test_the_third_louder_segment_in_a_row_is_believed() -> None:
    of = stream()
    for k in range(3):
        assert level(of) == pytest.approx(1.0)
        judge(of, 9.0)
        assert level(of) == pytest.approx(9.0 if k == 2 else 1.0)
    # In a row: one as before in between begins the count again; so does one in motion.
    of = stream()
    for times, rough in ((9.0, None), (9.0, None), (1.0, None), (9.0, None), (9.0, 0.1), (9.0, None), (9.0, None)):
        judge(of, times, rough)
    assert level(of) == pytest.approx(1.0)
    judge(of, 9.0)
    assert level(of) == pytest.approx(9.0)


@pytest.mark.parametrize(('rough', 'rest'), [(0.26, True), (0.24, False)])
def test_motion_is_four_times_more_than_roughness_explains(rough: float, rest: bool) -> None:
    of = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, 0.0)
    judge(of, 1.0, rough)
    assert of.at_rest == rest


def test_half_a_segment_says_something_less_does_not() -> None:
    rng = np.random.default_rng(4)
    for blocks, seen in ((25, 1), (24, 0)):
        of = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, 0.0)
        for b in range(SEGMENT_BLOCKS - blocks, SEGMENT_BLOCKS):
            of.add(b, ALL, SIGMA * rng.normal(size=(SIZE, 4)))
        assert of._seen == seen


@pytest.mark.parametrize('slots', [ALL, np.delete(ALL, [3, 11, 12])], ids=['all', 'gaps'])
def test_in_motion_a_block_is_the_least_squares_polynomial_at_its_middle(slots: IntArray) -> None:
    """So much motion that nothing is known of the coefficients: weights by dense least squares of order 4."""
    gamma = white(1.0)
    fit = BlockFit(SIZE, PLACES, PLACES)
    fit.set_noise(gamma)
    rng = np.random.default_rng(5)
    u = (ALL - 9.5) / 9.5
    for _ in range(200):
        shape = np.polynomial.polynomial.polyvander(u, 4) @ rng.normal(size=(5, 4))
        fit.fit(ALL, 1e-4 * shape + SIGMA * rng.normal(size=(SIZE, 4)))
    dots = (1e-4 * shape + SIGMA * rng.normal(size=(SIZE, 4)))[slots]
    got = fit.fit(slots, dots)
    powers = np.polynomial.polynomial.polyvander(u[slots], 4)
    w = np.linalg.pinv(powers)[0]
    # The base line between the dots does not move, whatever the link does: there the mean may be better.
    moving = np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0]])
    # To second order in the motion: the length of the base line is taken exactly.
    np.testing.assert_allclose(moving @ got.dots, moving @ (w @ dots), atol=2e-8)
    want = SIGMA**2 * float(w @ w)
    np.testing.assert_allclose((moving @ got.covariance @ moving.T).diagonal(), 2.0 * want, rtol=5e-3)


def steps_of(stated: float, step: float) -> FloatArray:
    return np.asarray(StreamNoise(SIZE, PLACES, PLACES, stated, step).gamma[0, 0])


def test_the_least_noise_is_that_of_rounding_and_what_is_not_dithered_stays() -> None:
    """q^2/12 a sample, and at every lag sum_k q^2/(2 pi^2 k^2) exp(-4 pi^2 k^2 s^2/q^2) for noise s."""
    step = 2e-6
    k = np.arange(1, 100_000)
    for s in (0.0, 0.2e-6, 0.5e-6):
        # The rig file's noise has the rounding in it.
        stated = s**2 + step**2 / 12.0
        stays = step**2 / (2.0 * np.pi**2) * float(np.sum(np.exp(-4.0 * (np.pi * k * s / step) ** 2) / k**2))
        got = steps_of(stated, step)
        np.testing.assert_allclose(got[1:], stays, rtol=6e-3, atol=1e-20)
        assert got[0] - got[1] == pytest.approx(stated, rel=1e-9)
    # Less than rounding there is not.
    got = steps_of(0.0, step)
    assert got[0] - got[1] == pytest.approx(step**2 / 12.0, rel=1e-9)
    # Without a converter it is as stated.
    np.testing.assert_array_equal(steps_of(3e-12, 0.0), [3e-12, *(0.0,) * (SIZE - 1)])


def test_more_noise_than_the_rig_file_says_does_not_dither_for_sure() -> None:
    """Measured at ten times the rig file's: what stays of rounding is what the rig file's would leave."""
    step = 2e-6
    of = StreamNoise(SIZE, PLACES, PLACES, step**2 / 12.0, step)
    of._average, of._seen = white(100.0), 5
    got = of._in_use()[0, 0]
    assert got[5] == pytest.approx(noise.undithered(0.0, step), rel=1e-9)
    assert got[5] > 0.9 * step**2 / 12.0


def test_each_reading_has_its_own_steps_and_noise() -> None:
    of = StreamNoise(SIZE, PLACES, PLACES, 1e-12 * np.arange(1.0, 5.0), 1e-6 * np.arange(4.0))
    for c in range(4):
        alone = StreamNoise(SIZE, PLACES, PLACES, 1e-12 * (c + 1.0), 1e-6 * c).gamma[c, c]
        np.testing.assert_allclose(of.gamma[c, c], alone, rtol=1e-12)
    np.testing.assert_allclose(of.sample_sd(), np.sqrt([of.gamma[c, c, 0] for c in range(4)]))
    # Motion is judged with the largest step.
    assert of._step == 3e-6


def test_in_motion_each_reading_is_as_rough_as_it_is_and_coloured_like_the_base_line() -> None:
    fixed = np.array([2.0, 1.0, 0.5])
    got = noise._guess(fixed, np.array([1.0, 4.0]))
    np.testing.assert_array_equal(got, [[fixed, 0.0 * fixed], [0.0 * fixed, 4.0 * fixed]])


@pytest.mark.parametrize(('size', 'share'), [(64, 0.03), (65, 1.0)])
def test_of_long_blocks_only_what_is_sure_is_taken(size: int, share: float) -> None:
    """A correlation of 0.52 with the next of so many samples: a little more than there may be."""
    each, sure = np.zeros((1, 1, size)), np.full(size, 0.5)
    sure[0] = 1.0
    each[0, 0, :2] = 1.0, 0.505
    made = noise._covariance(each, sure)[0, 0]
    np.testing.assert_allclose(made[:2], [1.001, 0.505 * (1.0 - 0.5 * share)], rtol=1e-9)


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


def test_a_segment_need_not_be_whole_to_be_of_its_place() -> None:
    """Segments are of 50 blocks by their numbers: what begins in the middle of one ends with it."""
    of = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, 0.0)
    rng = np.random.default_rng(8)
    told = [b for b in range(20, 130) if of.add(b, ALL, SIGMA * rng.normal(size=(SIZE, 4)))]
    assert told == [49, 99]
    # A block of a later segment closes one whose end was lost; too little of one changes nothing.
    of = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, 0.0)
    told = [b for b in [*range(40), 51, *range(52, 60), 130] if of.add(b, ALL, SIGMA * rng.normal(size=(SIZE, 4)))]
    assert told == [51]


@pytest.mark.parametrize(('times', 'rest'), [(2.9, True), (3.1, False)])
def test_what_rounding_hides_is_no_motion(times: float, rest: bool) -> None:
    """Means that vary by so many times what rounding alone may; the base line stands still to the bit.

    Both have the rounding's share besides: 1 + 2.9 is less than four times 1.
    """
    step = 4e-6
    least = step**2 / 12.0
    of = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, step)
    # A thousandth is added as a reading's own.
    of._judge(white(times / 1.001 * least / SIGMA**2), np.ones(SIZE), np.zeros(SIZE), np.full(8, least))
    assert of.at_rest == rest


@pytest.mark.parametrize(('times', 'after'), [(2.9, 1.95), (3.1, 1.0), (-0.15, 0.425), (-0.25, -0.25)])
def test_rounding_counts_with_the_noise_that_rises_or_falls(times: float, after: float) -> None:
    """Of noise as large as rounding: (2.9 + 1)/(1 + 1) is not twice, and (1 - 0.15)/2 is not below two fifths."""
    of = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, 12.0**0.5 * SIGMA)
    of._judge(white(1.0), np.ones(SIZE), white(1.0)[0, 0], np.full(8, SIGMA**2))
    before = white(times)
    # A thousandth of the largest is added as a reading's own: of negative ones 1e-24 m^2.
    if times > 0.0:
        before /= 1.001
    of._judge(before, np.ones(SIZE), before[0, 0], np.full(8, SIGMA**2))
    assert of._average is not None
    assert of._average[0, 0, 0] / SIGMA**2 == pytest.approx(after, rel=2e-3)


def test_what_is_sure_of_the_lags_is_averaged_with_them() -> None:
    of = stream()
    for count, sure in ((2, 0.5), (3, 0.2)):
        before = of._sure.copy()
        of._judge(white(1.0), np.full(SIZE, sure), white(1.0)[0, 0], np.full(8, SIGMA**2))
        np.testing.assert_allclose(of._sure, before + (sure - before) / count)
        assert of._count == count


def test_lags_at_which_no_two_samples_are_apart_are_taken_as_independent() -> None:
    """Every other sample is lost: of odd lags nothing is known but what the line took off."""
    n = SEGMENT_BLOCKS * SIZE
    keep = np.arange(0, n, 2)
    series = np.random.default_rng(3).normal(size=(len(keep), 1))
    left = series[:, 0] - np.polyval(np.polyfit(keep, series[:, 0], 1), keep)
    every = np.zeros(100)
    every[::2] = [left[: len(left) - lag] @ left[lag:] / (len(left) - lag) for lag in range(50)]
    got, _ = noise._autocovariance(keep, series, n, SIZE)
    np.testing.assert_allclose(got[0, 0], every[:SIZE] + put_back(every[:, None, None]).item(), atol=3e-6)


def test_blocks_of_one_sample_have_no_roughness() -> None:
    places = np.arange(SEGMENT_BLOCKS) * SIZE
    np.testing.assert_array_equal(noise._roughness(places, np.ones((SEGMENT_BLOCKS, 3)), basis(SIZE)), np.zeros(3))


def test_one_pair_at_a_lag_says_something_of_it() -> None:
    """Of every other sample, and the last one: at each odd lag there is one pair."""
    n = SEGMENT_BLOCKS * SIZE
    keep = np.append(np.arange(0, n, 2), n - 1)
    series = np.random.default_rng(3).normal(size=(len(keep), 1))
    here = np.full(n, np.nan)
    here[keep] = series[:, 0] - np.polyval(np.polyfit(keep, series[:, 0], 1), keep)
    every = np.array([np.nanmean(here[: n - lag] * here[lag:]) for lag in range(100)])
    got, _ = noise._autocovariance(keep, series, n, SIZE)
    np.testing.assert_allclose(got[0, 0], every[:SIZE] + put_back(every[:, None, None]).item(), atol=3e-6)


def test_noise_is_measured_from_the_second_segment_on() -> None:
    of, rng = StreamNoise(SIZE, PLACES, PLACES, SIGMA**2, 0.0), np.random.default_rng(9)
    said = []
    for block in range(150):
        of.add(block, ALL, SIGMA * rng.normal(size=(SIZE, 4)))
        said.append(of.measured)
    assert said == [False] * 99 + [True] * 51


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
    found = [r for r in pipeline.process(chunk) if isinstance(r, DeflectionEstimate) and r.t_ns > 5_000_000_000]
    return np.array([(r.dy - 3e-4 * np.sin(88.0e-9 * r.t_ns + 0.3)) / r.covariance[4] ** 0.5 for r in found])


@pytest.mark.parametrize('size', [5, 6, 8, 11])
def test_small_blocks_follow_motion_and_say_how_well(size: int) -> None:
    """With one order for four samples 0.31 of the intervals of blocks of 8 held the truth."""
    z = np.abs(swaying(size))
    assert np.mean(z < 1.959964) == pytest.approx(0.95, abs=0.02)
    assert np.mean(z < 3.0) > 0.99


def test_blocks_that_always_lose_their_end_say_how_little_they_tell() -> None:
    """Weights of some 1e-5 a block are weights: 0.93 were within three deviations, and the rms error was 6 um."""
    assert np.mean(np.abs(swaying(20, tuple(range(12, 20)))) < 3.0) > 0.99
