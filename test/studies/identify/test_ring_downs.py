# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The parts of the search for ring-downs, with motion that is known: dense least squares, limits and counts by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.signal import periodogram

from psd_deflection.records import FloatArray
from psd_deflection.studies.identify import modes as module
from psd_deflection.studies.identify.modes import (
    Modes,
    RingFit,
    Stretch,
    ends_well,
    find_stretches,
    fit_modes,
    fit_ring_downs,
    fit_trimmed,
    grow_stretch,
    hints_at_pair,
    is_good,
    mode_columns,
    mode_sizes,
    ringing_levels,
    rms_of,
    scan_windows,
    seed_windows,
    split_mode,
    trim,
    variance_at,
    variance_of,
    with_right_order,
)

RATE = 1024.0
"""A power of two: times of samples have no error."""


def ring(
    t: FloatArray, frequency: float = 16.0, damping: float = 0.02, size: float = 1e-3, phase: float = 0.3
) -> FloatArray:
    """From t = 0 on; nothing before."""
    w = 2.0 * math.pi * frequency
    angle = w * math.sqrt(1.0 - damping**2) * t + phase
    return np.where(t >= 0.0, size * np.exp(-damping * w * np.maximum(t, 0.0)) * np.cos(angle), 0.0)


def times(n: int) -> FloatArray:
    return np.arange(n) / RATE


def stretch(samples: FloatArray) -> Stretch:
    return Stretch(samples, 0, len(samples), RATE)


def columns(t: FloatArray, modes: Modes) -> FloatArray:
    """1, t, and the real and imaginary part of each mode's pole."""
    out = [np.ones(len(t)), t - t[-1] / 2.0]
    for frequency, damping in modes:
        pole = 2.0 * math.pi * frequency * complex(-damping, math.sqrt(max(1.0 - damping**2, 0.0)))
        out += [np.exp(pole * t).real, np.exp(pole * t).imag]
    return np.column_stack(out)


def test_the_columns_are_a_line_and_damped_turns() -> None:
    t = times(100)[3:]
    modes = [(16.0, 0.02), (40.0, 0.3), (9.0, 1.0)]
    np.testing.assert_allclose(mode_columns(t, modes), columns(t, modes), rtol=1e-12, atol=1e-14)
    # Beyond critical damping it does not turn.
    assert np.all(mode_columns(t, [(9.0, 1.4)])[:, 3] == 0.0)


def test_what_a_stretch_leaves_is_that_of_dense_least_squares() -> None:
    rng = np.random.default_rng(1)
    samples = 1e-4 + 1e-3 * rng.normal(size=400)
    samples[[120, 121, 200]] = math.nan
    s = Stretch(samples, 100, 300, RATE)
    there = np.array([k for k in range(100, 300) if k not in {120, 121, 200}])
    np.testing.assert_array_equal(s.t, (there - 100) / RATE)
    np.testing.assert_array_equal(s.y, samples[there])
    modes = [(16.0, 0.02), (40.0, 0.05)]
    a = columns(s.t, modes)
    terms = np.linalg.lstsq(a, s.y, rcond=None)[0]
    residual, found = s.solved(modes)
    np.testing.assert_allclose(found, terms, rtol=1e-7)
    np.testing.assert_allclose(residual, s.y - a @ terms, atol=1e-12)
    assert s.loud(modes) == pytest.approx(max(math.hypot(*terms[2:4]), math.hypot(*terms[4:6])), rel=1e-7)
    assert s.loud(modes[:1]) > 0.0
    t = times(600)
    s = stretch(ring(t, size=1e-3) + ring(t, 40.0, 0.01, 9e-4) + ring(t, 90.0, 0.01, 8e-4))
    for order in itertools.permutations([(16.0, 0.02), (40.0, 0.01), (90.0, 0.01)]):
        assert s.loud(list(order)) == pytest.approx(1e-3, rel=1e-6)


def test_the_root_of_the_mean_square() -> None:
    assert rms_of(np.array([3.0, -4.0])) == pytest.approx(math.sqrt(12.5))
    assert rms_of(np.zeros(0)) == 0.0
    assert RingFit([(16.0, 0.02)], np.array([3.0, -4.0]), np.eye(2)).deviation == pytest.approx(math.sqrt(12.5))


def test_the_scatter_of_a_fit_is_that_of_its_slopes() -> None:
    """Of all that is fitted, the linear terms of each stretch too, by differences of the motion."""
    rng = np.random.default_rng(2)
    t = times(700)
    both = [ring(t) + 1e-5 * rng.normal(size=700), ring(t[:500], size=5e-4) + 1e-5 * rng.normal(size=500)]
    fit = fit_modes([stretch(y) for y in both], [(16.0, 0.01)])
    (frequency, damping) = fit.modes[0]
    assert frequency == pytest.approx(16.0, rel=1e-3)
    assert damping == pytest.approx(0.02, rel=0.03)
    blocks, slopes = [], []
    for y in both:
        s = t[: len(y)]
        a = columns(s, fit.modes)
        terms = np.linalg.lstsq(a, y, rcond=None)[0]
        d = [
            (columns(s, [(frequency + df, damping + dz)]) - a) @ terms / (df + dz)
            for df, dz in ((1e-6, 0.0), (0.0, 1e-7))
        ]
        slopes.append(np.column_stack(d))
        blocks.append(a)
    jacobian = np.zeros((1200, 10))
    jacobian[:700, 2:6], jacobian[700:, 6:] = blocks
    jacobian[:, :2] = np.vstack(slopes)
    expected = np.linalg.inv(jacobian.T @ jacobian)[:2, :2]
    np.testing.assert_allclose(fit.covariance.diagonal(), expected.diagonal(), rtol=0.02)
    residual = np.concatenate([s.solved(fit.modes)[0] for s in (stretch(y) for y in both)])
    np.testing.assert_allclose(fit.residual, residual)
    # Least squares: along its slopes nothing is left to gain.
    along = jacobian[:, :2] / np.linalg.norm(jacobian[:, :2], axis=0)
    assert np.max(np.abs(along.T @ fit.residual)) < 1e-3 * np.linalg.norm(fit.residual)


@pytest.mark.parametrize(('start', 'end'), [(11.2, 15.68), (23.5, 16.45), (11.5, 16.0), (22.8, 16.0)])
def test_a_fit_stays_within_thirty_percent_below_and_forty_above(start: float, end: float) -> None:
    t = times(100)
    fit = fit_modes([stretch(ring(t, damping=0.1))], [(start, 0.05)])
    assert fit.modes[0][0] == pytest.approx(min(max(16.0, 0.7 * start), 1.4 * start), rel=1e-4)
    assert min(max(16.0, 0.7 * start), 1.4 * start) == pytest.approx(end, abs=0.05)


@pytest.mark.parametrize('damping', [0.0, 1.0])
def test_a_start_outside_of_the_bounds_is_put_inside(damping: float) -> None:
    fit = fit_modes([stretch(ring(times(300)))], [(16.1, damping)])
    np.testing.assert_allclose(fit.modes, [(16.0, 0.02)], rtol=1e-5)


@pytest.mark.parametrize('apart', [0.02, 0.05, 0.12])
def test_one_mode_is_split_into_two(apart: float) -> None:
    t = np.arange(300) / 128.0
    pair = [(16.0 * (1.0 - apart / 2.0), 0.01), (16.0 * (1.0 + apart / 2.0), 0.012)]
    samples = ring(t, *pair[0], 1e-3) + ring(t, *pair[1], 7e-4, -1.0) + ring(t, 50.0, 0.01, 1e-4)
    fit = split_mode([Stretch(samples, 0, 300, 128.0)], [(50.0, 0.01), (16.0, 0.02)])
    np.testing.assert_allclose(sorted(fit.modes), [*pair, (50.0, 0.01)], rtol=1e-5)


@pytest.mark.parametrize(('apart', 'observed'), [(0.01, True), (0.025, True), (0.06, True), (0.04, False)])
@pytest.mark.parametrize(('damping', 'of_pair'), [(0.002, 0.01), (0.03, 0.03)])
def test_a_pair_beside_a_mode_is_hinted_at(apart: float, observed: bool, damping: float, of_pair: float) -> None:
    """Whether it takes off all that is left but a millionth."""
    t = times(1500)
    places = (16.0 * (1.0 - apart), 16.0 * (1.0 + apart))
    samples = [ring(t, places[0], of_pair, size) + ring(t, places[1], of_pair, 1e-3, 1.0) for size in (1e-3, -5e-4)]
    both = [stretch(y) for y in samples]
    modes = [(50.0, 0.02), (16.0, damping)]
    residual = np.concatenate([s.solved(modes)[0] for s in both])
    fit = RingFit(modes, residual, np.eye(4))
    squares = float(np.sum(residual**2))
    assert hints_at_pair(both, fit, 0.99999999 * squares) is observed
    assert not hints_at_pair(both, fit, 1.0001 * squares)


def test_how_loud_the_ringing_is_is_reported_by_dense_least_squares() -> None:
    """Three damping ratios of each mode, and each of these times t, beside a line."""
    rng = np.random.default_rng(3)
    samples = 1e-3 + ring(times(900) - 0.3) + 1e-4 * rng.normal(size=900)
    window, modes = 300, [(15.0, 0.5), (40.0, 0.5)]
    t = times(window)
    every = [columns(t, [(f, z)])[:, 2:] for f, _ in modes for z in (0.003, 0.02, 0.06)]
    line = columns(t, [])
    shapes = np.hstack([*every, *(t[:, None] * c for c in every)])
    shapes -= line @ np.linalg.lstsq(line, shapes, rcond=None)[0]
    shapes /= np.linalg.norm(shapes, axis=0)
    found = ringing_levels(samples, RATE, modes, [0, 250, 500], window)
    for first, (loud, rest) in zip((0, 250, 500), found, strict=True):
        y = samples[first : first + window]
        y = y - line @ np.linalg.lstsq(line, y, rcond=None)[0]
        assert loud == pytest.approx(math.sqrt(2.0 * np.mean(y**2)), rel=1e-9)
        residual = y - shapes @ np.linalg.lstsq(shapes, y, rcond=1e-6)[0]
        assert rest == pytest.approx(math.sqrt(np.mean(residual**2)), rel=1e-6)


def test_windows_to_begin_with_ring_do_not_overlap_by_half_and_are_there() -> None:
    """Two blows; after the second every fourth sample is lost. Noise of 1 um, so that 8 um is loud."""
    rng = np.random.default_rng(4)
    t = times(4000)
    samples = ring(t) + ring(t - t[2000]) + 1e-6 * rng.normal(size=4000)
    filled = samples.copy()
    samples[2000::4] = math.nan
    window, hop = 384, 32
    found = seed_windows(samples, filled, RATE, [(16.0, 0.01)], 1e-6, window, hop)
    firsts = [s.first for s in found]
    assert found[0].first == 0
    assert all(s.last - s.first == window and s.first % hop == 0 for s in found)
    assert min(abs(a - b) for a, b in itertools.combinations(firsts, 2)) == window // 2
    assert max(firsts) < 2000 - window + 0.8 * window
    samples[2000::4] = filled[2000::4]
    samples[2000::6] = math.nan
    firsts = [s.first for s in seed_windows(samples, filled, RATE, [(16.0, 0.01)], 1e-6, window, hop)]
    assert any(first >= 2000 for first in firsts)
    # Down to 8 um at most: later than ln(1000/8)/(zeta w) = 2.4 s after a blow it is too quiet.
    assert max(firsts) > 2900


def test_at_most_thirty_windows_are_tried() -> None:
    t = times(9000)
    samples = 1e-3 * np.cos(2.0 * math.pi * 16.0 * t)
    assert len(seed_windows(samples, samples, RATE, [(16.0, 0.01)], 1e-6, 100, 50)) == 30


@pytest.mark.parametrize('early', [False, True])
def test_half_a_window_at_the_end_fits_by_itself(early: bool) -> None:
    """To 1.875 times the noise and a hundredth of the swing of that half: 1.875 um and 0.5 um."""
    samples = np.zeros(300)
    order = slice(None, None, -1 if early else 1)
    samples[order][-50:] = 50e-6 * (np.arange(50) % 2)
    # Swings before that half are none of its business.
    samples[order][:-50] = 1e-3 * (np.arange(250) % 2)
    s = stretch(samples)
    for size, fits in ((2.36e-6, True), (2.39e-6, False)):
        residual = np.zeros(300)
        residual[order][-50:] = size
        residual[order][:-50] = 1.0
        assert ends_well(s, residual, 100, 1e-6, early) is fits
        assert early or ends_well(s, residual, 100, 1e-6) is fits
        assert not ends_well(s, residual, 100, 1e-6, not early)
    residual = np.zeros(300)
    residual[order][-50] = 2.36e-6 * math.sqrt(50.0)
    assert ends_well(s, residual, 100, 1e-6, early)
    residual[order][-50] *= 1.02
    assert not ends_well(s, residual, 100, 1e-6, early)


def test_a_stretch_grows_by_half_a_window_or_a_third_until_a_blow() -> None:
    """From 384 forward to 576, 768 and 1024 samples, then back to 1365; more would reach into the blows."""
    n = 3000
    rng = np.random.default_rng(5)
    samples = ring(times(n) - 400.0 / RATE) + 1e-6 * rng.normal(size=n)
    samples[2300:] += 1e-3
    window = 384
    seed = Stretch(samples, 1000, 1000 + window, RATE)
    start = fit_modes([seed], [(16.0, 0.01)])
    grown, fit = grow_stretch(samples, seed, start, window, 1e-6)
    first, last = 1000, 1000 + window
    while last + max(window // 2, (last - first) // 3) <= 2300:
        last += max(window // 2, (last - first) // 3)
    while first - max(window // 2, (last - first) // 3) >= 400:
        first -= max(window // 2, (last - first) // 3)
    assert (first, last) == (659, 2024)
    assert (grown.first, grown.last) == (first, last)
    np.testing.assert_allclose(fit.modes, [(16.0, 0.02)], rtol=2e-3)
    # To the first and the last sample of a recording, not beyond.
    for low, high, expected in ((659, 2024, (659, 2024)), (660, 2024, (1000, 2024)), (659, 2023, (659, 1768))):
        cut = samples[low:high]
        grown, _ = grow_stretch(cut, Stretch(cut, 1000 - low, 1384 - low, RATE), start, window, 1e-6)
        assert grown.first + low == max(expected[0], low) or expected[0] < 1000
        assert grown.last + low == expected[1]


@pytest.mark.parametrize('split', [True, False])
def test_a_small_blow_that_is_lost_in_the_mean_ends_a_stretch(split: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A buzz of 5 um for 192 samples: 2.4 um in the mean of all, 4 um at the end. Two modes do not help."""
    n = 3000
    samples = ring(times(n) - 400.0 / RATE) + 1e-6 * np.random.default_rng(5).normal(size=n)
    samples[1832:] += 5e-6 * (-1.0) ** np.arange(n - 1832)
    seed = Stretch(samples, 1000, 1384, RATE)
    longer = Stretch(samples, 1000, 2024, RATE)
    bad = fit_modes([longer], [(16.0, 0.02)])
    assert is_good(longer, bad, 1e-6)
    asked: list[float] = []

    def hints(stretches: Sequence[Stretch], fit: RingFit, enough: float) -> bool:
        asked.append(enough)
        return split

    monkeypatch.setattr(module, 'hints_at_pair', hints)
    monkeypatch.setattr(module, 'split_mode', lambda stretches, modes: fit_modes(stretches, modes))
    grown, _ = grow_stretch(samples, seed, fit_modes([seed], [(16.0, 0.01)]), 384, 1e-6)
    assert grown.last == 1768
    # Two modes are tried if they may take off a quarter of the squares.
    assert asked[0] == pytest.approx(0.25 * float(np.sum(bad.residual**2)), rel=1e-3)
    # Not if there are three modes already.
    asked.clear()
    three = fit_modes([seed], [(16.0, 0.02), (40.0, 0.02), (90.0, 0.02)])
    grow_stretch(samples, seed, three, 384, 1e-9)
    assert asked == []


def test_two_modes_come_apart_while_a_stretch_grows() -> None:
    t = times(4000)
    rng = np.random.default_rng(6)
    samples = ring(t, 15.6, 0.01, 5e-4) + ring(t, 16.4, 0.01, 5e-4) + 1e-6 * rng.normal(size=4000)
    seed = Stretch(samples, 0, 384, RATE)
    start = fit_modes([seed], [(16.0, 0.01)])
    grown, fit = grow_stretch(samples, seed, start, 384, 5e-6)
    assert grown.last > 2500
    np.testing.assert_allclose(sorted(fit.modes), [(15.6, 0.01), (16.4, 0.01)], rtol=0.01)


def blows(n: int, firsts: Sequence[int], noise: float = 1e-6) -> FloatArray:
    """A link that is struck at these samples, each time as if it had rested."""
    samples = noise * np.random.default_rng(7).normal(size=n)
    for first, end in zip(firsts, [*firsts[1:], n], strict=True):
        samples[first:end] += ring(times(end - first))
    return samples


def test_stretches_begin_after_a_blow_and_end_before_the_next() -> None:
    """Windows of 384 each 32; then half windows are added, to 384 + 192 k."""
    samples = blows(3500, [650, 2000])
    found = scan_windows(samples, RATE, [(16.0, 0.02)], 1e-6, 384, 32)
    first = 672
    last = first + 384 + 192 * ((2000 - first - 384) // 192)
    assert (found[0].first, found[0].last) == (first, last)
    second = last + 32 * math.ceil((2000 - last) / 32)
    assert found[1].first == second
    assert found[1].last == second + 384 + 192 * ((3500 - second - 384) // 192)
    assert len(found) == 2
    # The end of the recording may be the end of a stretch.
    end = found[1].last
    assert scan_windows(samples[:end], RATE, [(16.0, 0.02)], 1e-6, 384, 32)[1].last == end
    assert scan_windows(samples[: end - 1], RATE, [(16.0, 0.02)], 1e-6, 384, 32)[1].last == end - 192


@pytest.mark.parametrize(('share', 'fits'), [(0.98, True), (1.02, False)])
def test_a_window_may_leave_a_hundredth_of_the_ringing_in_its_middle(share: float, fits: bool) -> None:
    """And 1.25 of the noise. Three turns after its start the ringing has decayed by exp(-6 pi zeta)."""
    t = times(500)
    samples = ring(t[:385])
    allowed = 1.25 * 1e-6 + 0.01 * 1e-3 * math.exp(-6.0 * math.pi * 0.02)
    samples += share * allowed * (-1.0) ** np.arange(385)
    found = scan_windows(samples, RATE, [(16.0, 0.02)], 1e-6, 384, 32)
    assert [(s.first, s.last) for s in found] == ([(0, 384)] if fits else [])


@pytest.mark.parametrize(('level', 'fits'), [(1e-3 / 8.1, True), (1e-3 / 7.9, False)])
def test_a_window_is_eight_times_as_loud_as_the_noise(level: float, fits: bool) -> None:
    assert bool(scan_windows(ring(times(385)), RATE, [(16.0, 0.02)], level, 384, 32)) is fits


def test_of_a_window_half_is_there_and_twelve_samples() -> None:
    samples = ring(times(385), damping=0.001)
    samples[1:384:2] = math.nan
    assert len(scan_windows(samples, RATE, [(16.0, 0.001)], 1e-6, 384, 32)) == 1
    samples[0] = math.nan
    assert scan_windows(samples, RATE, [(16.0, 0.001)], 1e-6, 384, 32) == []
    for there, observed in ((12, True), (11, False)):
        few = ring(times(17), 200.0, damping=0.001)
        few[[3, 6, 8, 10, 13][: 16 - there]] = math.nan
        assert bool(scan_windows(few, RATE, [(200.0, 0.001)], 1e-6, 16, 2)) is observed


def test_the_search_finds_the_ring_downs_and_their_mode() -> None:
    samples = blows(4000, [650, 2000])
    found, modes = find_stretches(samples, samples, RATE, [(15.5, 0.01)], 1e-6)
    # Windows of six periods each half a period, of the frequency that is known at first.
    window, hop = round(6.0 * RATE / 15.5), round(0.5 * RATE / 15.5)
    firsts = [hop * math.ceil(650 / hop)]
    assert found[0].first == firsts[0]
    assert (found[0].last - found[0].first - window) % (window // 2) == 0
    assert found[0].last <= 2000 < found[0].last + window // 2
    assert 2000 <= found[1].first < 2000 + hop
    np.testing.assert_allclose(modes, [(16.0, 0.02)], rtol=2e-3)
    noise = 1e-6 * np.random.default_rng(8).normal(size=3000)
    assert find_stretches(noise, noise, RATE, [(15.5, 0.01)], 1e-6) == ([], [(15.5, 0.01)])


@pytest.mark.parametrize(('level', 'reported'), [(1e-6, 3e-6), (4e-6, 4e-6)])
def test_of_three_windows_that_grow_the_longest_gives_the_modes(
    level: float, reported: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what it leaves is noise, if it is more than was thought."""
    samples = blows(6000, [100, 2000, 4000])
    lengths = [500, 900, 700, 5000]
    observed: list[Modes] = []
    scanned: list[tuple[Modes, float, int, int]] = []

    def grown(samples: FloatArray, seed: Stretch, start: RingFit, window: int, level: float) -> tuple[Stretch, RingFit]:
        length, first = lengths[len(observed)], (100, 200, 4000)[len(observed)]
        observed.append(start.modes)
        return Stretch(samples, first, first + length, RATE), RingFit(
            [(float(length), 0.02)], np.full(4, 3e-6), np.eye(2)
        )

    def scan(samples: FloatArray, rate: float, modes: Modes, level: float, window: int, hop: int) -> list[Stretch]:
        scanned.append((modes, level, window, hop))
        return []

    monkeypatch.setattr(module, 'grow_stretch', grown)
    monkeypatch.setattr(module, 'scan_windows', scan)
    assert find_stretches(samples, samples, RATE, [(16.0, 0.01)], level) == ([], [(900.0, 0.02)])
    assert len(observed) == 3
    np.testing.assert_allclose(np.reshape(observed, (3, 2)), [(16.0, 0.02)] * 3, rtol=0.02)
    # Six periods, and half a one.
    ((modes, noise, *sizes),) = scanned
    assert modes == [(900.0, 0.02)]
    assert noise == pytest.approx(reported)
    assert sizes == [384, 32]


@pytest.mark.parametrize(('fits', 'splits'), [(2, 5), (99, 10)])
def test_if_no_window_fits_the_first_ten_are_split(fits: int, splits: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Until three of them fit as two modes."""
    samples = blows(6000, [100, 2000, 4000])
    count = 0

    def split(stretches: Sequence[Stretch], modes: Modes) -> RingFit:
        nonlocal count
        count += 1
        assert modes == [(16.0, 0.01)]
        return RingFit([(16.0, 0.02)], np.full(4, 1e-9 if count > fits else 1.0), np.eye(2))

    def grown(samples: FloatArray, seed: Stretch, start: RingFit, window: int, level: float) -> tuple[Stretch, RingFit]:
        return seed, start

    monkeypatch.setattr(
        module, 'fit_modes', lambda stretches, start, steps=100: RingFit([(16.0, 0.02)], np.ones(4), np.eye(2))
    )
    monkeypatch.setattr(module, 'split_mode', split)
    monkeypatch.setattr(module, 'grow_stretch', grown)
    found, modes = find_stretches(samples, samples, RATE, [(16.0, 0.01)], 1e-6)
    assert count == splits
    assert bool(found) is (fits == 2)
    assert modes == ([(16.0, 0.02)] if found else [(16.0, 0.01)])


def test_the_largest_ringing_of_each_mode() -> None:
    t = times(600)
    first = ring(t, size=1e-3) + ring(t, 50.0, 0.01, 1e-4)
    second = ring(t, size=6e-4) + ring(t, 50.0, 0.01, 3e-4)
    np.testing.assert_allclose(
        mode_sizes([stretch(first), stretch(second)], [(16.0, 0.02), (50.0, 0.01)]), [1e-3, 3e-4], rtol=1e-6
    )


def test_a_mode_stays_if_it_saves_30_variances_and_4_each_stretch(monkeypatch: pytest.MonkeyPatch) -> None:
    t = times(800)
    rng = np.random.default_rng(9)
    both = [stretch(ring(t, size=s) + ring(t, 50.0, 0.01, 5e-6) + 1e-6 * rng.normal(size=800)) for s in (1e-3, -7e-4)]
    two = fit_modes(both, [(50.0, 0.01), (16.0, 0.02)])
    one = fit_modes(both, [(16.0, 0.02)])
    saved = float(np.sum(one.residual**2) - np.sum(two.residual**2))
    for factor, count in ((37.9, 1), (38.1, 2)):
        asked: list[float] = []

        def variance(
            fit: RingFit, stretches: Sequence[Stretch], rate: float, frequency: float, value: float = saved / factor
        ) -> float:
            asked.append(frequency)  # noqa: B023
            return value

        monkeypatch.setattr(module, 'variance_at', variance)
        fit = with_right_order(both, two, RATE)
        assert len(fit.modes) == count
        assert fit.modes[-1][0] == pytest.approx(16.0, rel=1e-3)
        # The noise at the frequency of the mode in question.
        assert asked[0] == pytest.approx(50.0, rel=1e-3)


def test_modes_that_beat_are_added_until_nothing_is_left() -> None:
    t = times(2500)
    rng = np.random.default_rng(10)
    pair = ring(t, 15.7, 0.01, 1e-3) + ring(t, 16.3, 0.01, 6e-4, 1.0) + 1e-6 * rng.normal(size=2500)
    fit = with_right_order([stretch(pair)], fit_modes([stretch(pair)], [(16.0, 0.01)]), RATE)
    np.testing.assert_allclose(sorted(fit.modes), [(15.7, 0.01), (16.3, 0.01)], rtol=0.01)


@pytest.mark.parametrize(
    ('size', 'saves', 'count'), [(0.98e-5, 1e9, 1), (1.02e-5, 1e9, 2), (1e-4, 33.9, 1), (1e-4, 34.1, 2)]
)
def test_a_further_mode_has_a_hundredth_of_the_loudest_and_saves_enough(
    size: float, saves: float, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one stretch 34 variances; three tenths of that are a hint to try it."""
    t = times(600)
    s = stretch(ring(t, size=1e-3) + ring(t, 50.0, 0.01, size) + 1e-9 * np.random.default_rng(11).normal(size=600))
    one, two = fit_modes([s], [(16.0, 0.02)]), fit_modes([s], [(16.0, 0.02), (50.0, 0.01)])
    variance = float(np.sum(one.residual**2) - np.sum(two.residual**2)) / saves
    asked: list[float] = []

    def hints(stretches: Sequence[Stretch], fit: RingFit, enough: float) -> bool:
        asked.append(enough)
        return len(fit.modes) == 1

    monkeypatch.setattr(module, 'hints_at_pair', hints)
    monkeypatch.setattr(module, 'split_mode', lambda stretches, modes: two)

    def variance_at(fit: RingFit, stretches: Sequence[Stretch], rate: float, frequency: float) -> float:
        assert frequency == pytest.approx(16.0, rel=1e-3)
        return variance

    monkeypatch.setattr(module, 'variance_at', variance_at)
    assert len(with_right_order([s], one, RATE).modes) == count
    np.testing.assert_allclose(asked, 0.3 * 34.0 * variance)
    assert len(asked) == count


def trimmed(
    scatter: Sequence[float],
    monkeypatch: pytest.MonkeyPatch,
    pattern: Sequence[float] = (1.0, -1.0),
    piece: int = 16,
) -> tuple[int, int] | None:
    """What is kept of pieces of so many samples, a quarter of a period, that leave so much."""
    samples = np.zeros(3000)
    s = Stretch(samples, 100, 100 + piece * len(scatter), RATE)
    residual = np.repeat(scatter, piece) * np.resize(pattern, piece * len(scatter))
    monkeypatch.setattr(Stretch, 'solved', lambda self, modes: (residual, np.zeros(4)))
    kept = trim(s, samples, RATE, [(RATE / (4.0 * piece), 0.02), (40.0, 0.02)])
    return None if kept is None else (kept.first, kept.last)


def test_the_ends_that_fit_worse_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of alternating errors each of 16 counts: worse than 1 + 4 / sqrt(32) times the usual."""
    limit = 1.0 + 4.0 / math.sqrt(32.0)
    usual = [1.0] * 40
    assert trimmed(usual, monkeypatch) == (100, 740)
    assert trimmed([limit * 0.99, *usual[2:], limit * 0.99], monkeypatch) == (100, 740)
    assert trimmed([limit * 1.01, *usual[2:], limit * 0.99], monkeypatch) == (116, 740)
    assert trimmed([limit * 0.99, *usual[2:], limit * 1.01], monkeypatch) == (100, 724)
    # The bad one nearest to the middle counts; the one in the middle is of the second half.
    assert trimmed([1.0, 9.0, 1.0, 9.0, *usual[7:], 9.0, 1.0, 1.0], monkeypatch) == (100 + 64, 740 - 48)
    assert trimmed([*usual[:20], 9.0, *usual[21:]], monkeypatch) == (100, 420)
    assert trimmed([*usual[:19], 9.0, *usual[20:]], monkeypatch) == (420, 740)


def test_however_errors_remember_a_fortieth_of_the_samples_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a memory of 0.95 there are 0.05/1.95; of 64 samples that is 1.64."""
    limit = 1.0 + 4.0 / math.sqrt(2.0 * 64.0 * 0.05 / 1.95)
    assert trimmed([*[1.0] * 39, limit * 0.98], monkeypatch, (1.0,), 64) == (100, 2660)
    assert trimmed([*[1.0] * 39, limit * 1.03], monkeypatch, (1.0,), 64) == (100, 2596)


def test_of_fast_modes_a_piece_has_four_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = np.zeros(200)
    s = Stretch(samples, 0, 200, RATE)
    residual = np.ones(200) * np.resize((1.0, -1.0), 200)
    residual[197] = 50.0
    monkeypatch.setattr(Stretch, 'solved', lambda self, modes: (residual, np.zeros(4)))
    kept = trim(s, samples, RATE, [(128.0, 0.02)])
    assert kept is not None
    assert (kept.first, kept.last) == (0, 196)


def test_a_piece_of_one_sample_counts_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = np.zeros(400)
    s = Stretch(samples, 10, 10 + 16 * 20 + 1, RATE)
    residual = np.resize((1.0, -1.0), 321)
    monkeypatch.setattr(Stretch, 'solved', lambda self, modes: (residual, np.zeros(4)))
    for size, last in ((1.65, 331), (1.75, 330)):
        residual[-1] = size
        kept = trim(s, samples, RATE, [(16.0, 0.02)])
        assert kept is not None
        assert (kept.first, kept.last) == (10, last)


def test_the_ends_are_cut_three_times_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = blows(3000, [0])
    both = [Stretch(samples, 0, 1000, RATE), Stretch(samples, 1000, 1500, RATE)]

    def cut(s: Stretch, samples: FloatArray, rate: float, modes: Modes) -> Stretch | None:
        return Stretch(samples, s.first + 10, s.last, rate) if s.last == 1000 else None

    monkeypatch.setattr(module, 'trim', cut)
    kept, fit = fit_trimmed(samples, RATE, both, [(16.0, 0.02)])
    assert [(s.first, s.last) for s in kept] == [(30, 1000)]
    assert len(fit.residual) == 970
    # If nothing would be left, all is.
    kept, fit = fit_trimmed(samples, RATE, both[1:], [(16.0, 0.02)])
    assert [(s.first, s.last) for s in kept] == [(1000, 1500)]


def test_four_periods_are_left_at_least(monkeypatch: pytest.MonkeyPatch) -> None:
    """A period has four pieces."""
    assert trimmed([1.0] * 16, monkeypatch) == (100, 356)
    assert trimmed([1.0] * 15, monkeypatch) is None
    assert trimmed([*[1.0] * 16, 9.0, *[1.0] * 3], monkeypatch) == (100, 356)
    assert trimmed([*[1.0] * 15, 9.0, *[1.0] * 4], monkeypatch) is None


def test_the_variance_of_what_is_left_is_for_its_freedom() -> None:
    """A mode and a line of each of two stretches are eight, the mode two more."""
    s = stretch(np.zeros(20))
    one = RingFit([(16.0, 0.02)], np.full(40, 3.0), np.eye(2))
    assert variance_of(one, [s, s]) == pytest.approx(9.0 * 40 / 30)
    two = RingFit([(16.0, 0.02), (40.0, 0.02)], np.full(40, 3.0), np.eye(4))
    assert variance_of(two, [s, s]) == pytest.approx(9.0 * 40 / 24)
    assert variance_of(two, [s] * 5) == pytest.approx(9.0 * 40 / 6)
    assert variance_of(two, [s] * 6) == pytest.approx(9.0 * 40)


@pytest.mark.parametrize(
    ('n', 'rate', 'frequency', 'half_width', 'count', 'close'),
    [(1000, 1000.0, 20.0, 6.0, 11, 1), (1000, 1000.0, 20.0, 6.0, 11, 2), (1000, 1000.0, 10.0, 5.0, 9, 1)],
)
def test_the_variance_at_a_mode_is_that_of_white_noise_of_its_density(
    n: int, rate: float, frequency: float, half_width: float, count: int, close: int
) -> None:
    """Within 30 % of it, or five lines; the modes there have taken a line each, and another each stretch."""
    rng = np.random.default_rng(13)
    residual = np.cumsum(rng.normal(size=n))
    modes = [(frequency * 1.01, 0.02), *[(frequency * 0.72, 0.02)] * (close - 1), (frequency * 1.31, 0.02)]
    fit = RingFit(modes, residual, np.eye(2 * len(modes)))
    f, p = periodogram(residual, rate)
    near = [v for k, v in zip(f, p, strict=True) if abs(k - frequency) < half_width]
    assert len(near) == count
    s = stretch(np.zeros(20))
    for stretches in (1, 2, 3, 4, 6):
        free = max(2 * count - 2 * close * (stretches + 1), 2)
        expected = sum(near) * rate / free
        # More than the mean, as this noise remembers.
        assert variance_at(fit, [s] * stretches, rate, frequency) == pytest.approx(
            max(expected, variance_of(fit, [s] * stretches)), rel=1e-9
        )
    assert variance_at(fit, [s], rate, 300.0) == pytest.approx(variance_of(fit, [s]))


def test_the_fit_goes_through_the_samples_of_each_stretch() -> None:
    samples = blows(3500, [650, 2000])
    found = fit_ring_downs(
        samples, RATE, [(16.1, 0.01)], [Stretch(samples, *ends, RATE) for ends in ((660, 1900), (2010, 3400))]
    )
    assert found.stretches == ((660, 1900), (2010, 3400))
    assert found.how == 'ring-down'
    (mode,) = found.modes
    assert abs(mode.frequency - 16.0) < 4.0 * mode.frequency_sd
    assert abs(mode.damping - 0.02) < 4.0 * mode.damping_sd
    assert found.noise == pytest.approx(1e-6, rel=0.1)
    # At the start of the stretches, ten samples after the blows.
    assert mode.amplitude == pytest.approx(1e-3 * math.exp(-0.02 * 2.0 * math.pi * 16.0 * 10.0 / RATE), rel=2e-3)
    assert np.isfinite(found.fitted).sum() == 1240 + 1390
    for first, last, blow in ((660, 1900, 650), (2010, 3400, 2000)):
        t = (np.arange(first, last) - blow) / RATE
        np.testing.assert_allclose(found.fitted[first:last], ring(t), atol=4e-7)
    # The scatter of a damped swing in white noise (Cramer and Rao), each ring-down by itself: dense slopes.
    information = np.zeros((2, 2))
    for first, last, blow in ((660, 1900, 650), (2010, 3400, 2000)):
        t = (np.arange(first, last) - blow) / RATE
        a = columns(t - t[0], [(16.0, 0.02)])
        slopes = np.column_stack(((ring(t, 16.001) - ring(t)) / 1e-3, (ring(t, damping=0.02001) - ring(t)) / 1e-5))
        slopes -= a @ np.linalg.lstsq(a, slopes, rcond=None)[0]
        information += slopes.T @ slopes
    expected = 1e-6 * np.sqrt(np.linalg.inv(information).diagonal())
    assert mode.frequency_sd == pytest.approx(expected[0], rel=0.25)
    assert mode.damping_sd == pytest.approx(expected[1], rel=0.25)


def test_each_mode_has_its_own_scatter_and_the_loudest_is_first(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = np.zeros(1000)
    fit = RingFit([(16.0, 0.02), (50.0, 0.03)], np.full(1000, 2e-6), np.diag([4.0, 9.0, 16.0, 25.0]))
    s = Stretch(samples, 0, 1000, RATE)
    asked: list[float] = []

    def variance(fit: RingFit, stretches: Sequence[Stretch], rate: float, frequency: float) -> float:
        asked.append(frequency)
        return 1e-4 * frequency

    monkeypatch.setattr(module, 'fit_trimmed', lambda *a: ([s], fit))
    monkeypatch.setattr(module, 'mode_sizes', lambda *a: np.array([1e-4, 1e-3]))
    monkeypatch.setattr(module, 'variance_at', variance)
    found = fit_ring_downs(samples, RATE, fit.modes, [s])
    assert asked == [16.0, 50.0]
    assert found.noise == pytest.approx(2e-6)
    loud, quiet = found.modes
    assert (loud.frequency, loud.damping, loud.amplitude) == (50.0, 0.03, 1e-3)
    assert (quiet.frequency, quiet.damping, quiet.amplitude) == (16.0, 0.02, 1e-4)
    deviations = (quiet.frequency_sd, quiet.damping_sd, loud.frequency_sd, loud.damping_sd)
    np.testing.assert_allclose(deviations, (0.04 * 2, 0.04 * 3, math.sqrt(5e-3) * 4, math.sqrt(5e-3) * 5))


@pytest.mark.parametrize(
    ('scans', 'lengths'),
    [
        # The second scan finds as little as the first, which is kept.
        ((700, 700), [700]),
        ((500,), []),
        ((600, 700, 800, 900), [600, 700, 800]),
    ],
)
def test_the_stretches_are_sought_again_with_the_mode_that_was_missing(
    scans: tuple[int, ...], lengths: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three times at most, as long as there are more samples in them. Windows are of the first mode."""
    samples = np.zeros(3000)
    fit = RingFit([(16.0, 0.02), (50.0, 0.03)], np.full(1000, 2e-6), np.eye(4))
    residual = list(scans)
    settled: list[int] = []

    def settle(
        samples: FloatArray, rate: float, stretches: list[Stretch], start: Modes
    ) -> tuple[list[Stretch], RingFit]:
        settled.append(stretches[0].last - stretches[0].first)
        return stretches, fit

    def scan(samples: FloatArray, rate: float, modes: Modes, level: float, window: int, hop: int) -> list[Stretch]:
        assert (modes, window, hop) == (fit.modes, 384, 32)
        assert level == pytest.approx(2e-6)
        return [Stretch(samples, 100, 100 + residual.pop(0), RATE)]

    monkeypatch.setattr(module, 'fit_trimmed', settle)
    monkeypatch.setattr(module, 'scan_windows', scan)
    monkeypatch.setattr(module, 'mode_sizes', lambda *a: np.array([1e-3, 1e-4]))
    found = fit_ring_downs(samples, RATE, fit.modes[:1], [Stretch(samples, 300, 800, RATE)])
    assert settled == [500, *lengths]
    assert found.stretches == (((100, 100 + lengths[-1]),) if lengths else ((300, 800),))
    # With the modes that were known nothing is sought again.
    residual[:] = [999]
    fit_ring_downs(samples, RATE, fit.modes, [Stretch(samples, 300, 800, RATE)])
    assert residual == [999]


def test_ends_that_reach_into_a_blow_are_cut_before_the_fit() -> None:
    samples = blows(3500, [650, 2000])
    reaching = [Stretch(samples, 640, 1900, RATE), Stretch(samples, 2010, 3400, RATE)]
    kept, fit = fit_trimmed(samples, RATE, reaching, [(16.1, 0.01)])
    assert 650 <= kept[0].first < 1000
    assert (kept[0].last, kept[1].first, kept[1].last) == (1900, 2010, 3400)
    np.testing.assert_allclose(fit.modes, [(16.0, 0.02)], rtol=2e-3)
    assert fit.deviation == pytest.approx(1e-6, rel=0.1)


def test_with_the_mode_that_was_missing_the_stretches_are_longer() -> None:
    t = times(3000)
    rng = np.random.default_rng(14)
    samples = ring(t, 15.7, 0.01, 1e-3) + ring(t, 16.3, 0.01, 6e-4, 1.0) + 1e-6 * rng.normal(size=3000)
    found = fit_ring_downs(samples, RATE, [(16.0, 0.01)], [Stretch(samples, 0, 1000, RATE)])
    assert len(found.modes) == 2
    assert found.modes[0].amplitude > found.modes[1].amplitude
    assert sum(last - first for first, last in found.stretches) > 2000
