# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Device clock to host time: the figures of docs/robustness.md, on a simulated USB line."""

import itertools

import numpy as np
import pytest

from psd_deflection.measure.timing import ClockMap, ClockState, lower_line

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
def test_stamps_are_within_50_us_after_three_minutes(skew: float) -> None:
    clock = ClockMap()
    stamps, truth = observe_usb(clock, 240, skew, 1)
    error = (stamps - truth)[180 * 50 :]
    assert error.std() < 50_000
    # What is left is the least delay of the line, which no one-way clock can see.
    assert 200_000 - 50_000 < error.mean() < 450_000
    assert clock.state().skew_ppm == pytest.approx(-skew, abs=2.0)
    assert clock.resets == 0


@pytest.mark.slow
@pytest.mark.parametrize('skew', [500.0, -500.0, 5000.0, -5000.0])
def test_clock_far_off_rate_is_followed_within_20_s(skew: float) -> None:
    clock = ClockMap()
    stamps, truth = observe_usb(clock, 40, skew, 1)
    error = stamps - truth
    assert abs(error).max() < 20 * MS
    assert abs(error[20 * 50 :]).max() < 1 * MS
    assert clock.resets == 0


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
    assert (clock.resets, clock.state().residual_ns) == (1, 0.0)
    assert clock.to_host_ns(np.array([device_us], np.int64))[0] == host_ms * MS


def test_an_uptime_of_years_loses_no_nanoseconds() -> None:
    clock = ClockMap()
    stamps, truth = observe_usb(clock, 15, 0.0, 5, start_us=10 * 365 * 86_400 * 1_000_000)
    assert abs(np.diff(stamps)[-100:] - 20 * MS).max() < 45_000
    assert (stamps - truth)[-100:].std() < 100_000


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
    at = clock.host_ns(up_us)
    clock.lay_anew(up_us, 50 * MS)
    assert (clock.resets, clock.stepped_ns, clock.host_ns(up_us)) == (2, -79_500_000 + (50 * MS - at), 50 * MS)


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


@pytest.mark.slow
@pytest.mark.parametrize('ppm', [50.0, -50.0])
def test_a_rate_that_wanders_costs_less_than_300_us(ppm: float) -> None:
    """By 50 ppm in 300 s, on a polled line, with three answers to pings a second."""
    rng, clock, errors, true = np.random.default_rng(8), ClockMap(), [], 0.0
    for k in range(500 * 50):
        true += 20 * MS * (1.0 + ppm * 1e-6 * min(max(k / 50 - 100, 0.0) / 300, 1.0))
        device_us, host = 20_000 * k, round(true)
        clock.observe(device_us, -(-host // MS) * MS + 200_000 + int(rng.exponential(50_000)))
        if k % 16 == 0:
            phase = int(rng.integers(0, 900))
            clock.observe_reply(device_us + phase, host, host + 1000 * phase + 200_000)
        errors.append(int(clock.to_host_ns(np.array([device_us], np.int64))[0]) - host)
    assert np.ptp(errors[90 * 50 :]) < 300_000


def test_the_last_five_minutes_count_and_no_more() -> None:
    """A clock that is right for ten minutes and then 50 ppm off, on a line without jitter."""
    clock = ClockMap()
    change = 600 * 10
    for k in range(change + 320 * 10):
        late = 0 if k < change else round((k - change) * 100 * MS * 50e-6)
        clock.observe(100_000 * k, 100 * MS * k + 200_000 + late)
        clock.to_host_ns(np.array([100_000 * k], np.int64))
        if k == change:
            assert clock.state().points == 300
            assert clock.state().skew_ppm == pytest.approx(0.0, abs=1e-3)
    assert clock.state().points == 300
    assert clock.state().skew_ppm == pytest.approx(50.0, abs=1e-3)


@pytest.mark.parametrize('up_us', [0, 3_600_000_000])
@pytest.mark.parametrize(('ppm', 'seconds'), [(600.0, 5), (-600.0, 5), (2000.0, 3), (150.0, 10), (-30.0, 10)])
def test_clock_off_by_two_milliseconds_is_fitted_early(ppm: float, seconds: int, up_us: int) -> None:
    """600 ppm take 4 s from the first of five minima to the last; fewer than three show no rate. Ten always do."""
    clock = ClockMap()
    for k in range(12 * 100):
        clock.observe(up_us + 10_000 * k, 2000 * up_us + round(10 * MS * k * (1.0 + ppm * 1e-6)) + 200_000)
        fitted = k >= seconds * 100
        assert clock.state().skew_ppm == pytest.approx(ppm if fitted else 0.0, abs=0.01), k
        assert abs(clock.state().residual_ns) <= 1000.0 * abs(ppm) * seconds + 1e6


@pytest.mark.parametrize(
    ('drift_ns', 'above_ns', 'fitted'),
    # 7.8125 ms in 2 s are 1/256, which no rounding moves.
    [(1_999_999, 0, False), (2_000_000, 0, True), (7_812_500, 999_999, True), (7_812_500, 1_000_000, False)],
)
def test_two_milliseconds_in_three_seconds_are_a_rate(drift_ns: int, above_ns: int, fitted: bool) -> None:
    """Three least delays, half a second after each first sample, which is 9 ms late; the middle one is off the line."""
    clock = ClockMap()
    for half in range(7):
        late = 9 * MS if half % 2 == 0 else (drift_ns * (half // 2) + 1) // 2 + (above_ns if half == 3 else 0)
        clock.observe(500_000 * half, 500 * MS * half + late)
    assert clock.state().points == 3
    assert (clock.state().skew_ppm != 0.0) == fitted


@pytest.mark.parametrize(
    ('early_ns', 'late_share', 'step'),
    [(21 * MS, share, 21 * MS if abs(share) < 0.1 else 0) for share in (0.099, 0.101, -0.099, -0.101)]
    + [(2 * MS, 0.0, 0), (2 * MS + 1, 0.0, 2 * MS + 1)],
)
def test_a_line_that_drains_steps_by_two_milliseconds(early_ns: int, late_share: float, step: int) -> None:
    """After a step samples come early again, faster than their clock goes by: 3 ms of it in 1 ms, or 21 ms in none."""
    clock = ClockMap()
    clock.observe(0, 1000 * MS)
    assert not clock.observe(100_000, 1000 * MS, passed_us=100_000.0)
    assert clock.drains
    assert clock.stepped_ns == -100 * MS
    passed_us = 21_000 if early_ns == 21 * MS else 3000
    clock.observe(100_000 + passed_us, 1000 * MS + 1000 * passed_us - early_ns, passed_us * (1.0 + late_share))
    assert clock.stepped_ns == -100 * MS - step


def test_a_map_that_was_shown_nothing_is_the_identity() -> None:
    clock = ClockMap()
    assert (clock.state(), clock.host_ns(7)) == (ClockState(0.0, 0, 0.0, 0, 0, None), 7000)
    clock.observe_reply(7, 5000, 6000)
    assert clock.state().round_trip_ns is None
    clock.observe(5, 123_456)
    assert clock.state() == ClockState(0.0, 123_456 - 5000, 0.0, 0, 0, None)


@pytest.mark.parametrize(
    ('second_us', 'slope'),
    [
        # The first delay may have grown by 1e-4 of the time since: so much is missing, to be made up in 1 s.
        (9_999_990, 1e-4 * 9.99999),
        # After 10 s in 5 s, up to a millisecond.
        (10_000_000, 1e-4 * 10.0 / 5.0),
        (10_000_010, 1e-4 * 10.00001),
        # By 2 ms a second at most.
        (19_000_000, 1.9e-3),
        (21_000_000, 2e-3),
    ],
)
@pytest.mark.parametrize('up_us', [0, 3_600_000_000])
def test_how_fast_a_map_draws_near(second_us: int, slope: float, up_us: int) -> None:
    clock = ClockMap()
    clock.observe(up_us, 7 * MS)
    clock.observe(up_us + second_us, 1000 * second_us + 17 * MS)
    assert clock.state().residual_ns == pytest.approx(0.1 * second_us, rel=1e-8)
    assert clock.host_ns(up_us + 20_000_000) == pytest.approx(20_007 * MS + slope * 20e9, abs=2, rel=0)


def test_repeated_time_is_no_jump_unless_early() -> None:
    clock = ClockMap()
    clock.observe(1000, 100 * MS)
    assert not clock.observe(1000, 110 * MS)
    # A clock that stands still is not in step with the numbers.
    assert clock.observe(1000, 40 * MS, passed_us=0.0)


def residual_of_the_next(clock: ClockMap, second: int) -> float:
    """ns, as a late sample at the beginning of ``second`` leaves it."""
    clock.observe(1_000_000 * second, 1000 * MS * second + MS)
    return clock.state().residual_ns


def test_the_pair_with_which_a_map_is_laid_anew_counts() -> None:
    clock = ClockMap()
    clock.observe(0, 0)
    clock.lay_anew(3_000_000, 3000 * MS - 5 * MS)
    assert residual_of_the_next(clock, 4) == pytest.approx(1e-4 * 1000 * MS)


@pytest.mark.parametrize(('delay_ns', 'after_ns', 'delay'), [(-1000, 500 * MS, -1000), (0, 0, 0), (1000, 0, 0)])
def test_an_answer_counts_if_it_is_less_late_than_the_samples(delay_ns: int, after_ns: int, delay: int) -> None:
    clock = ClockMap()
    clock.observe(7_000_000, 7000 * MS)
    clock.observe_reply(7_500_000, 7499 * MS, 7500 * MS + delay_ns)
    assert clock.state().round_trip_ns == MS + delay_ns
    assert residual_of_the_next(clock, 8) == pytest.approx(delay + 1e-4 * (1000 * MS - after_ns))
    # One of a second that is over changes nothing but the trip.
    clock.observe_reply(7_500_000, 7500 * MS - 5000, 7500 * MS - 2000)
    assert clock.state().round_trip_ns == 3000
    assert residual_of_the_next(clock, 9) == pytest.approx(delay + 1e-4 * (2000 * MS - after_ns))


@pytest.mark.parametrize(('off_ns', 'believed'), [(50_000_000, True), (50_000_001, False)])
def test_an_answer_fifty_milliseconds_off_is_believed(off_ns: int, believed: bool) -> None:
    for sign in (1, -1):
        clock = ClockMap()
        clock.observe(0, 1000 * MS)
        clock.observe_reply(1000, 900 * MS, 1001 * MS + sign * off_ns)
        assert clock.state().round_trip_ns == (101 * MS + sign * off_ns if believed else None)


@pytest.mark.parametrize(
    ('by_us', 'before_us', 'last_us'), [(0, 0, 20_000), (5000, 20_000, 25_000), (5000, 9000, 20_000)]
)
def test_the_map_turns_at_the_last_stamp(by_us: int, before_us: int, last_us: int) -> None:
    """Also if the clock was found to have jumped, after that stamp or before it."""
    clock = ClockMap()
    clock.observe(0, MS)
    clock.observe(1000, MS)
    # A millisecond too late: it draws near by 1 us a ms.
    stamps = clock.to_host_ns(np.arange(1000, 21_000, 1000, dtype=np.int64))
    assert stamps.tolist() == [MS + k * (MS - 1000) for k in range(1, 21)]
    # And by 2 us from here on.
    clock.shift(by_us, before_us)
    own_us = last_us - by_us
    clock.observe(last_us + 500, 1000 * (own_us + 500) - 9 * MS)
    last = int(stamps[own_us // 1000 - 1])
    assert [clock.host_ns(last_us + us) for us in (0, 1000)] == [last, last + MS - 2000]


def test_a_clock_whose_jump_is_known_goes_on_as_one_without() -> None:
    plain, jumped = ClockMap(), ClockMap()
    for second in range(20):
        us, host = 1_000_000 * second, 1001 * MS * second
        by_us = 700_000 if second > 14 else 0
        if second == 15:
            jumped.shift(by_us, us - 1)
        plain.observe(us, host)
        jumped.observe(us + by_us, host)
        assert (jumped.host_ns(us + by_us), jumped.state().skew_ppm) == (plain.host_ns(us), plain.state().skew_ppm)


def test_lower_line_is_closest_of_lines_below_points() -> None:
    rng = np.random.default_rng(8)
    for _ in range(100):
        x = rng.choice(50, int(rng.integers(2, 9)), replace=False)
        points = [(int(a), int(b)) for a, b in zip(x, rng.integers(-20, 20, len(x)), strict=True)]
        sums = []
        for (a, y), (b, z) in itertools.combinations(points, 2):
            over = [q - y - (z - y) / (b - a) * (p - a) for p, q in points]
            if min(over) > -1e-9:
                sums.append(sum(over))
        slope, intercept = lower_line(points)
        over = [q - slope * p - intercept for p, q in points]
        assert min(over) > -1e-9
        assert sum(over) == pytest.approx(min(sums), abs=1e-9)
    # Of one abscissa there is no slope.
    assert lower_line([(5, 7), (5, 3)]) == lower_line([(5, 3)]) == (0.0, 3.0)


@pytest.mark.parametrize(('late_ns', 'jumped'), [(5000 * MS, False), (5000 * MS + 1, True)])
def test_a_second_that_is_five_seconds_late_is_a_jump(late_ns: int, jumped: bool) -> None:
    clock = ClockMap()
    for second in range(13):
        t_ns = 1000 * MS * second + (late_ns if second > 10 else 0)
        assert clock.observe(1_000_000 * second, t_ns, passed_us=1e6) == (jumped and second == 12)


@pytest.mark.parametrize(('early_ns', 'jumped'), [(50_000_000, False), (50_000_001, True)])
def test_a_sample_fifty_milliseconds_early_is_a_jump(early_ns: int, jumped: bool) -> None:
    clock = ClockMap()
    clock.observe(0, 1000 * MS)
    assert clock.observe(20_000, 1020 * MS - early_ns) == jumped


@pytest.mark.parametrize(('off_ns', 'jumped'), [(49_999_999, False), (50_000_000, True)])
def test_clock_within_50_ms_of_numbers_has_not_jumped(off_ns: int, jumped: bool) -> None:
    for sign in (1, -1):
        clock = ClockMap()
        clock.observe(0, 1000 * MS)
        # A second later by the device, and 60 ms less by the host.
        assert clock.observe(1_000_000, 1940 * MS, (1000 * MS + sign * off_ns) / 1000.0) == jumped
        assert clock.state().resets == jumped
