# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the clock map is shown of a stream, with times that the test owns."""

import numpy as np
import pytest

from psd_deflection.devices.protocol.frames import BadFrame, SampleFrame
from psd_deflection.devices.source import Sample
from psd_deflection.run.clock_watch import ClockWatch

COUNTS = (0, 0, 16384, 0, 0, 16384)
MS = 1_000_000
BOOT = 5_000 * MS
"""The host's clock when the device's is at zero, ns."""


def sample(seq: int, t_us: int | None = None) -> SampleFrame:
    return SampleFrame(0, seq % 2**32, seq * 1000 if t_us is None else t_us, COUNTS)


@pytest.fixture
def watched() -> ClockWatch:
    return ClockWatch(1000.0, regressed=True)


def host_of(watched: ClockWatch, t_us: int) -> int:
    return int(watched.to_host_ns(np.array([t_us], np.int64))[0])


def test_only_newest_sample_of_read_sets_the_clock(watched: ClockWatch) -> None:
    assert not watched.newest([sample(0), sample(1), BadFrame('x', 3), sample(2), BadFrame('y', 1)], BOOT + 2 * MS)
    assert (host_of(watched, 0), host_of(watched, 2000)) == (BOOT, BOOT + 2 * MS)


def test_a_read_without_a_sample_says_nothing(watched: ClockWatch) -> None:
    assert not watched.newest([BadFrame('x', 3)], BOOT)
    assert not watched.newest([], BOOT)
    assert watched.state().points == 0
    watched.newest([sample(7)], BOOT + 7 * MS)
    assert host_of(watched, 7000) == BOOT + 7 * MS


def test_samples_of_a_plug_in_count_as_frames_do(watched: ClockWatch) -> None:
    watched.newest([Sample(0, 3, 3000, COUNTS)], BOOT + 3 * MS)
    assert host_of(watched, 3000) == BOOT + 3 * MS


def test_repeated_or_implausible_sample_is_ignored(watched: ClockWatch) -> None:
    watched.newest([sample(100)], BOOT + 100 * MS)
    before = watched.state()
    # Shown, both would be a jump of the clock.
    assert not watched.newest([sample(99)], BOOT + 101 * MS)
    assert not watched.newest([sample(101, t_us=10**9)], BOOT + 101 * MS)
    assert watched.state() == before


def test_a_jump_is_observed_sample_by_sample(watched: ClockWatch) -> None:
    for k in range(5):
        assert not watched.torn(k, k * 1000)
        assert not watched.observe(k, k * 1000, BOOT + k * MS)
    assert watched.torn(5, 10**9)
    assert watched.observe(5, 10**9, BOOT + 5 * MS)
    assert (host_of(watched, 10**9), watched.state().resets) == (BOOT + 5 * MS, 1)
    assert not watched.torn(6, 10**9 + 1000)


@pytest.mark.parametrize('jump_us', [2000, 5000, 30_000, 45_000, -2000, -5000])
@pytest.mark.parametrize('rate', [1.0, 1.0 + 500e-6])
def test_a_jump_of_two_milliseconds_is_followed_within_a_second(watched: ClockWatch, jump_us: int, rate: float) -> None:
    rng, late, steps = np.random.default_rng(1), {}, []
    for k in range(24_000):
        t_us = round(k * 1000 * rate) + (jump_us if k >= 20_507 else 0)
        now = BOOT + k * MS + 200_000 + int(rng.exponential(50_000))
        if k % 10 == 0:
            assert not watched.newest([sample(k, t_us)], now)
        assert not watched.torn(k, t_us)
        if step := watched.stepped(k, t_us):
            steps.append((k, step))
        late[k] = host_of(watched, t_us) - BOOT - k * MS
    ((k, step),) = steps
    assert k < 21_000
    assert step == pytest.approx(jump_us, abs=100)
    assert watched.take_step_ns() == -1000 * step
    assert max(abs(late[n] - late[20_500]) for n in range(k, 24_000)) < 800_000
    assert abs(late[23_999] - late[20_500]) < 500_000


def test_stamps_that_jitter_show_no_step(watched: ClockWatch) -> None:
    rng = np.random.default_rng(2)
    for k in range(5000):
        watched.torn(k, k * 1000)
        assert not watched.stepped(k, k * 1000 + int(rng.choice([0, 3000])))


def test_a_gap_in_the_numbers_is_not_a_clock_jump(watched: ClockWatch) -> None:
    assert not watched.torn(0, 0)
    assert not watched.torn(5000, 5_000_000)
    assert watched.torn(5001, 5_001_000 + 60_000)


def test_numbers_may_wrap(watched: ClockWatch) -> None:
    last = 2**32 - 1
    assert not watched.newest([sample(last, t_us=1000)], BOOT)
    assert not watched.newest([sample(0, t_us=2000)], BOOT + MS)
    assert (host_of(watched, 2000), watched.state().resets) == (BOOT + MS, 0)


@pytest.mark.parametrize(('answered_us', 'next_us', 'found_ns'), [(1000, 1000, MS), (500, 10**9, None)])
def test_an_answer_to_a_ping_bounds_the_delay_not_across_a_jump(
    watched: ClockWatch, answered_us: int, next_us: int, found_ns: int | None
) -> None:
    watched.newest([sample(0)], BOOT + 3 * MS)
    watched.torn(0, 0)
    watched.reply(answered_us, BOOT + 3 * MS, BOOT + 4 * MS)
    assert (watched.torn(1, next_us), watched.state().round_trip_ns) == (found_ns is None, found_ns)


@pytest.mark.parametrize(('claimed_us', 'believed'), [(100_400, True), (145_400, False), (55_000, False)])
def test_ping_answer_lies_between_the_samples_around_it(watched: ClockWatch, claimed_us: int, believed: bool) -> None:
    for k in range(101):
        watched.newest([sample(k)], BOOT + k * MS)
        watched.torn(k, k * 1000)
    before = host_of(watched, 100_000)
    watched.reply(claimed_us, BOOT + 99 * MS, BOOT + 101 * MS)
    watched.torn(101, 101_000)
    assert (watched.state().round_trip_ns == 2 * MS) is believed
    watched.newest([sample(102)], BOOT + 102 * MS)
    assert abs(host_of(watched, 100_000) - before) < 10_000


def stamped(clock_us: list[int]) -> list[int]:
    """How late the stamp of each of these samples is, ns: one a millisecond, each read as it comes."""
    watched = ClockWatch(1000.0, regressed=True)
    late = []
    for k, t_us in enumerate(clock_us):
        now = BOOT + k * MS
        watched.newest([sample(k, t_us)], now)
        if watched.torn(k, t_us):
            watched.observe(k, t_us, now)
        elif watched.lags(k, t_us, now):
            watched.lay_anew(k, k, t_us, now)
        late.append(now - host_of(watched, t_us))
    return late


@pytest.mark.slow
@pytest.mark.parametrize('share', [0.0, 0.5, 0.98])
def test_a_clock_that_stands_still_or_crawls_is_laid_anew(share: float) -> None:
    late = stamped([min(k, 500) * 1000 + round(max(k - 500, 0) * 1000 * share) for k in range(12_000)])
    assert max(late) < 60 * MS


def test_a_line_that_was_held_up_is_no_lag(watched: ClockWatch) -> None:
    for k in range(1000):
        # What the host has not read for a second comes at once.
        now = BOOT + max(k, 999) * MS
        assert not watched.torn(k, k * 1000)
        assert not watched.lags(k, k * 1000, now)


def test_a_device_that_is_faster_than_it_says_does_not_lag(watched: ClockWatch) -> None:
    for k in range(3000):
        t_us, now = k * 900, BOOT + k * 900_000
        watched.newest([sample(k, t_us)], now)
        assert not watched.torn(k, t_us)
        assert not watched.lags(k, t_us, now)


@pytest.mark.parametrize('t', [0, 123_456_789])
def test_times_that_need_no_map_go_through_as_they_are(t: int) -> None:
    watched = ClockWatch(1000.0, regressed=False)
    assert not watched.newest([sample(5)], BOOT)
    assert not watched.torn(5, 5000)
    assert not watched.torn(6, 10**9)
    watched.reply(1000, BOOT, BOOT + MS)
    assert host_of(watched, t) == t
    assert watched.state().round_trip_ns is None


def test_clock_recovers_from_burst_of_tenfold_rate(watched: ClockWatch) -> None:
    """Against the contract: the numbers run ahead of the time, a little at each sample."""
    seq = t_us = 0

    def read(samples: int, step_us: int, late_ns: int) -> None:
        nonlocal seq, t_us
        events = [sample(seq + n, t_us + n * step_us) for n in range(1, samples + 1)]
        seq, t_us = seq + samples, t_us + samples * step_us
        watched.newest(events, BOOT + t_us * 1000 + late_ns)
        for event in events:
            watched.torn(event.seq, event.t_device_us)

    read(20, 1000, 0)
    watched.lay_anew(seq, seq, t_us, BOOT + t_us * 1000 + 40 * MS)
    for _ in range(3):
        read(200, 100, 40 * MS)
    for _ in range(1500):
        read(20, 1000, 0)
        watched.to_host_ns(np.array([t_us], np.int64))
    assert abs(host_of(watched, t_us) - BOOT - t_us * 1000) < MS
