# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimates of rigs whose blocks do not coincide, at common times."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.arms.chains.joining import PATIENCE, Joined, Joiner
from psd_deflection.records import DeflectionEstimate

BLOCK_NS = 20_000_000
NOISE = (4e-12, 0.0, 0.0, 0.0, 9e-12, 0.0, 0.0, 0.0, 1e-10)


def estimate(t_ns: int, x: float) -> DeflectionEstimate:
    return DeflectionEstimate(t_ns, 0, 'exact', x, 2 * x, 3 * x, 0.0, 0.0, NOISE, 0.0, True)


def run(joiner: Joiner, stamps: dict[int, list[int]], x: float = 1e-3) -> list[Joined]:
    """Estimates of each link at its times, in order; each is ``x`` times its time in blocks."""
    events = sorted((t, link) for link, times in stamps.items() for t in times)
    return [j for t, link in events for j in joiner.put(link, estimate(t, x * t / BLOCK_NS))]


def every(start: int, count: int) -> list[int]:
    return [start + n * BLOCK_NS for n in range(count)]


def test_a_line_is_interpolated_at_the_stamps_of_the_first_link() -> None:
    joiner = Joiner([BLOCK_NS] * 3)
    got = run(joiner, {0: every(0, 10), 1: every(7_000_000, 10), 2: every(-5_000_000, 10)})
    # Before 7 ms link 1 had not begun, after 175 ms link 2 has ended.
    assert [j.t_ns for j in got] == every(BLOCK_NS, 8)
    for j in got:
        for tip in j.tips:
            assert tip.pose == pytest.approx(np.array([1, 2, 3]) * 1e-3 * j.t_ns / BLOCK_NS, rel=1e-12)
    assert joiner.joined == 8
    assert joiner.missing == [0, 0, 0]
    u = 13 / 20
    assert np.diag(got[-1].tips[1].covariance) == pytest.approx(
        (u**2 + (1 - u) ** 2) * np.array([4e-12, 9e-12, 1e-10]), rel=1e-9
    )
    assert np.diag(got[-1].tips[0].covariance) == pytest.approx([4e-12, 9e-12, 1e-10])


def test_blocks_that_coincide_are_taken_as_they_are() -> None:
    got = run(Joiner([BLOCK_NS] * 2), {0: every(0, 5), 1: every(0, 5)})
    assert [j.t_ns for j in got] == every(0, 5)
    assert np.array_equal(got[3].tips[1].covariance, np.reshape(NOISE, (3, 3)))


def test_interpolated_motion_widens_covariance() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    out: list[Joined] = []
    for n in range(200):
        out += joiner.put(0, estimate(n * BLOCK_NS, 0.0))
        t_ns = n * BLOCK_NS + BLOCK_NS // 2
        out += joiner.put(1, estimate(t_ns, 1e-3 * np.sin(2 * np.pi * 5.0 * t_ns / 1e9)))
    errors = np.array([j.tips[1].pose[0] - 1e-3 * np.sin(2 * np.pi * 5.0 * j.t_ns / 1e9) for j in out[3:]])
    stated = np.array([j.tips[1].covariance[0, 0] for j in out[3:]])
    # Much more than the noise, and as large as the error is.
    assert np.sqrt(np.mean(errors**2)) > 10 * 2e-6
    assert np.mean(errors**2) / np.mean(stated) == pytest.approx(1.0, abs=0.5)


def test_lost_block_of_other_link_leaves_gap_beside_it() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    kept = [t for t in every(7_000_000, 10) if t != 7_000_000 + 4 * BLOCK_NS]
    got = run(joiner, {0: every(0, 10), 1: kept})
    assert [j.t_ns // BLOCK_NS for j in got if j.missing] == [4, 5]
    assert all(j.missing == (1,) and j.tips == () for j in got if j.missing)
    assert joiner.missing == [0, 2]
    assert joiner.joined == 7


def test_ended_link_is_dropped_and_joins_on_return() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    got = run(joiner, {0: every(0, 40), 1: every(7_000_000, 5)})
    assert [j.t_ns // BLOCK_NS for j in got if j.missing] == list(range(5, 39 - PATIENCE))
    got = run(joiner, {0: every(40 * BLOCK_NS, 10), 1: every(40 * BLOCK_NS + 7_000_000, 10)})
    assert [j.t_ns // BLOCK_NS for j in got if j.tips] == list(range(41, 50))
    assert joiner.missing[1] == 36


def test_lost_blocks_of_first_link_are_counted_later() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    run(joiner, {0: every(0, 5) + every(8 * BLOCK_NS, 5), 1: every(7_000_000, 13)})
    assert joiner.missing == [3, 0]
    assert joiner.joined == 9


def test_a_clock_that_goes_back_begins_anew() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    run(joiner, {0: every(10**12, 5), 1: every(10**12 + 7_000_000, 5)})
    got = run(joiner, {0: every(0, 5), 1: every(7_000_000, 5)})
    assert [j.t_ns // BLOCK_NS for j in got if j.tips] == [1, 2, 3, 4]
    assert joiner.missing == [0, 0]
    assert joiner.joined == 8


def test_two_estimates_closer_than_a_block_miss_none() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    run(joiner, {0: [*every(0, 5), 4 * BLOCK_NS + 6_000_000], 1: every(7_000_000, 6)})
    assert joiner.missing == [0, 0]
