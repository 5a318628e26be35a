"""Device clock to host time: the figures of docs/robustness.md, on a simulated USB line."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.timing import ClockMap, lower_line

MS = 1_000_000


def observe_usb(
    clock: ClockMap, seconds: int, skew_ppm: float, seed: int, start_us: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Samples at 1 kHz through 1 ms USB polling with random delays; stamps and truth, ns."""
    rng = np.random.default_rng(seed)
    stamps, truth = [], []
    for k in range(seconds * 1000):
        device_us = start_us + 1000 * k
        true = round(1000 * 1000 * k * (1.0 - skew_ppm * 1e-6)) + 12345
        frame = -(-true // MS) * MS
        delay = 200_000 + int(rng.exponential(50_000)) + (5 * MS if rng.random() < 0.02 else 0)
        clock.observe(device_us, frame + delay)
        if k % 20 == 19:
            block = np.arange(device_us - 19_000, device_us + 1, 1000, dtype=np.int64)
            stamps.append(clock.to_host_ns(block)[0])
            truth.append(true - round(19 * MS * (1.0 - skew_ppm * 1e-6)))
    return np.array(stamps), np.array(truth)


@pytest.mark.parametrize('skew', [30.0, -83.0])
def test_stamps_follow_the_truth_within_50_us_after_three_minutes(skew: float) -> None:
    clock = ClockMap()
    stamps, truth = observe_usb(clock, 240, skew, 1)
    error = (stamps - truth)[180 * 50 :]
    assert error.std() < 50_000
    # What is left is the least delay of the line, which no one-way clock can see.
    assert 200_000 - 50_000 < error.mean() < 450_000
    assert clock.state().skew_ppm == pytest.approx(-skew, abs=2.0)
    assert clock.resets == 0


@pytest.mark.parametrize('skew', [500.0, -500.0, 5000.0, -5000.0])
def test_a_clock_far_off_its_rate_is_followed_within_twenty_seconds(skew: float) -> None:
    clock = ClockMap()
    stamps, truth = observe_usb(clock, 40, skew, 1)
    error = stamps - truth
    assert abs(error).max() < 20 * MS
    assert abs(error[20 * 50 :]).max() < 1 * MS
    assert clock.resets == 0


def test_a_late_start_or_a_stall_is_no_rate() -> None:
    clock = ClockMap()
    for k in range(5000):
        late = 40 * MS if k < 1000 or 3000 <= k < 3990 else 0
        clock.observe(1000 * k, k * MS + 200_000 + late)
    assert clock.state().skew_ppm == 0.0


def test_stamps_rise_evenly_from_the_first_second_on() -> None:
    stamps, _ = observe_usb(ClockMap(), 30, 30.0, 2)
    spacing = np.diff(stamps)
    assert abs(spacing - 20 * MS).max() < 45_000


def test_a_stall_of_the_host_does_not_move_the_clock() -> None:
    clock = ClockMap()
    observe_usb(clock, 20, 0.0, 3)
    before = clock.to_host_ns(np.array([20_000_000], np.int64))[0]
    # Three seconds of samples arrive at once, late.
    for k in range(20_000, 23_000):
        assert not clock.observe(1000 * k, 23_500 * MS)
    after = clock.to_host_ns(np.array([20_000_000], np.int64))[0]
    assert abs(after - before) < 1 * MS


@pytest.mark.parametrize(('device_us', 'host_ms'), [(500, 20_001), (90_000_000, 20_001)])
def test_a_clock_that_jumps_is_laid_anew_and_counted(device_us: int, host_ms: int) -> None:
    clock = ClockMap()
    observe_usb(clock, 20, 0.0, 4)
    assert clock.observe(device_us, host_ms * MS)
    assert clock.resets == 1
    assert clock.state().residual_ns == 0.0
    assert clock.to_host_ns(np.array([device_us], np.int64))[0] == host_ms * MS


def test_an_uptime_of_years_loses_no_nanoseconds() -> None:
    clock = ClockMap()
    stamps, truth = observe_usb(clock, 15, 0.0, 5, start_us=10 * 365 * 86_400 * 1_000_000)
    assert abs(np.diff(stamps)[-100:] - 20 * MS).max() < 45_000
    assert (stamps - truth)[-100:].std() < 100_000


def test_the_lower_line_touches_from_below() -> None:
    points = [(0, 10), (10, 5), (20, 30), (30, 7), (40, 50)]
    slope, intercept = lower_line(points)
    assert slope == pytest.approx(0.1)
    assert all(y >= slope * x + intercept - 1e-9 for x, y in points)


@pytest.mark.parametrize('up_us', [0, 3_600_000_000])
def test_a_start_that_came_late_is_no_jump_of_the_clock(up_us: int) -> None:
    clock = ClockMap()
    # The host was busy: the first sample is seen 80 ms late, the next ones in time.
    clock.observe(up_us, 80 * MS)
    assert not clock.observe(up_us + 20_000, 20 * MS + 500_000, passed_us=20_000.0)
    assert clock.resets == 0
    assert abs(int(clock.to_host_ns(np.array([up_us + 20_000], np.int64))[0]) - 20 * MS) < 1 * MS
    # By the same arrival, but a clock that does not agree with the numbers, it did jump.
    assert clock.observe(up_us + 200_000, 41 * MS, passed_us=20_000.0)
    assert clock.resets == 1
    # Who knows that it cannot be followed says so, and it counts.
    clock.lay_anew(up_us, 50 * MS)
    assert clock.resets == 2
    assert clock.host_ns(up_us) == 50 * MS


def test_pings_at_random_phase_take_off_what_beats() -> None:
    rng = np.random.default_rng(6)
    plain, asked = ClockMap(), ClockMap()
    for k in range(40_000):
        # In step with the polling: every sample waits 0.9 ms.
        host = k * MS + 900_000 + int(rng.exponential(20_000))
        for clock in (plain, asked):
            clock.observe(1000 * k, host)
        if k % 100 == 99:
            phase = int(rng.integers(0, 1000))
            sent = k * MS + phase * 1000 - 150_000
            asked.observe_reply(1000 * k + phase, sent, -(-(k * MS + phase * 1000) // MS) * MS + 30_000)
        if k % 20 == 19:
            for clock in (plain, asked):
                clock.to_host_ns(np.array([1000 * k], np.int64))
    last = np.array([39_999_000], np.int64)
    assert int(plain.to_host_ns(last)[0]) - 39_999 * MS > 850_000
    assert int(asked.to_host_ns(last)[0]) - 39_999 * MS < 200_000
    trip = asked.state().round_trip_ns
    assert trip is not None
    assert 100_000 < trip < 500_000
    assert plain.state().round_trip_ns is None


def test_while_warming_up_a_clock_that_runs_away_is_followed() -> None:
    rng = np.random.default_rng(7)
    clock = ClockMap()
    error = 0
    for k in range(9000):
        true = round(k * MS * (1.0 + 83e-6))
        clock.observe(1000 * k, true + 300_000 + int(rng.exponential(50_000)))
        error = int(clock.to_host_ns(np.array([1000 * k], np.int64))[0]) - true
    # The least delay of nine seconds ago alone would be stale by 750 us.
    assert abs(error - 300_000) < 250_000


def test_the_last_five_minutes_count_and_no_more() -> None:
    """A clock that is right for ten minutes and then 50 ppm off, on a line without jitter."""
    clock = ClockMap()
    turn = 600 * 10
    for k in range(turn + 320 * 10):
        late = 0 if k < turn else round((k - turn) * 100 * MS * 50e-6)
        clock.observe(100_000 * k, 100 * MS * k + 200_000 + late)
        clock.to_host_ns(np.array([100_000 * k], np.int64))
        if k == turn:
            assert clock.state().points == 300
            assert clock.state().skew_ppm == pytest.approx(0.0, abs=1e-3)
    assert clock.state().points == 300
    assert clock.state().skew_ppm == pytest.approx(50.0, abs=1e-3)


def test_a_map_that_is_off_draws_near_within_seconds_and_evenly() -> None:
    """From the eleventh second on by a fifth of what is missing a second: blocks stay even within 4 us."""
    clock = ClockMap()
    stamps = []
    for k in range(60 * 50):
        # From second 30 on a shorter line: 0.8 ms less.
        host = 20 * MS * k + (1_000_000 if k < 30 * 50 else 200_000)
        clock.observe(20_000 * k, host)
        stamps.append(int(clock.to_host_ns(np.array([20_000 * k], np.int64))[0]))
    uneven = np.abs(np.diff(stamps) - 20 * MS)
    assert uneven[: 30 * 50].max() <= 1
    # A sixth would be 3.2 us in 20 ms.
    assert 3_600 < uneven.max() < 4_100


@pytest.mark.parametrize('ahead', [0, 3_600_000 * MS])
@pytest.mark.parametrize(('ppm', 'seconds'), [(600.0, 5), (-600.0, 5), (2000.0, 3), (150.0, 10), (-30.0, 10)])
def test_a_clock_is_fitted_early_as_soon_as_it_has_run_off_by_two_milliseconds(
    ppm: float, seconds: int, ahead: int
) -> None:
    """600 ppm take 4 s from the first of five minima to the last; fewer than three show no rate. Ten always do."""
    clock = ClockMap()
    for k in range(12 * 100):
        clock.observe(10_000 * k, ahead + round(10 * MS * k * (1.0 + ppm * 1e-6)) + 200_000)
        fitted = k >= seconds * 100
        assert clock.state().skew_ppm == pytest.approx(ppm if fitted else 0.0, abs=0.01), k


def test_the_map_draws_near_within_a_second_at_first() -> None:
    clock = ClockMap()
    clock.observe(0, 500_000)
    for k in range(1, 100):
        clock.observe(10_000 * k, 10 * MS * k + 200_000)
        clock.to_host_ns(np.array([10_000 * k], np.int64))
    # 300 us too late at first, 1 s later not: but for what the clock may have drifted meanwhile.
    assert clock.host_ns(990_000) - 990 * MS == pytest.approx(200_000, abs=20_000)


@pytest.mark.parametrize(('drift_ns', 'fitted'), [(1_999_999, False), (2_000_000, True)])
def test_two_milliseconds_are_what_shows_a_rate(drift_ns: int, fitted: bool) -> None:
    """Three minima, a second apart: the clock has run off by this much from the first to the last."""
    clock = ClockMap()
    for second in range(4):
        # The one between is no less late than the line.
        clock.observe(1_000_000 * second, 1000 * MS * second + (drift_ns * second + 1) // 2)
    assert clock.state().points == 3
    assert (clock.state().skew_ppm != 0.0) == fitted


@pytest.mark.parametrize(('early_ns', 'jumped'), [(50_000_000, False), (50_000_001, True)])
def test_a_sample_fifty_milliseconds_early_is_a_jump(early_ns: int, jumped: bool) -> None:
    clock = ClockMap()
    clock.observe(0, 1000 * MS)
    assert clock.observe(20_000, 1020 * MS - early_ns) == jumped


@pytest.mark.parametrize(('off_ns', 'jumped'), [(49_999_999, False), (50_000_000, True)])
def test_a_clock_that_agrees_with_the_numbers_within_fifty_milliseconds_has_not_jumped(
    off_ns: int, jumped: bool
) -> None:
    for sign in (1, -1):
        clock = ClockMap()
        clock.observe(0, 1000 * MS)
        # A second later by the device, and 60 ms less by the host.
        assert clock.observe(1_000_000, 1940 * MS, (1000 * MS + sign * off_ns) / 1000.0) == jumped
        assert clock.state().resets == jumped


def test_a_second_has_one_minimum_after_a_jump_too() -> None:
    clock = ClockMap()
    clock.observe(0, 0)
    clock.lay_anew(5_000_000, 7000 * MS)
    points = []
    for k in range(1, 35):
        clock.observe(5_000_000 + 100_000 * k, 7000 * MS + 100 * MS * k)
        points.append(clock.state().points)
    assert points == [k // 10 for k in range(1, 35)]
