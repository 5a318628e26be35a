# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""When the link moved last, as the daemon finds it in the last minute."""

import numpy as np
import pytest

import psd_deflection
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.replay.engine import replayed
from psd_deflection.records import BlockStatus, SpotMeans
from psd_deflection.rig.config import load_rig
from psd_deflection.run.last_load_change import REACH_S, RecentDots

RIG = load_rig()


def observed(loads: list[tuple[float, float, float]], seconds: float, lost: range = range(0)) -> RecentDots:
    """The dots under ``loads``, each held for so many s; some blocks ``lost``."""
    recent = RecentDots(RIG)
    for records in replayed(psd_deflection.simulate(RIG, loads, seconds=seconds), Pipeline(RIG)):
        for record in records:
            if isinstance(record, SpotMeans) and record.index not in lost:
                recent.put(record)
    return recent


@pytest.mark.slow
@pytest.mark.parametrize('lost', [range(0), range(60, 80)])
def test_the_last_step_is_found_to_a_tenth_of_a_block(lost: range) -> None:
    found = observed([(0, 0, 0), (0, -10, 0), (5, -10, 0)], 4.0, lost).step_ns()
    assert found is not None
    assert found * 1e-9 == pytest.approx(8.0, abs=0.002)


def test_a_link_at_rest_has_no_step() -> None:
    assert observed([(0, -10, 0)], 5.0).step_ns() is None
    assert RecentDots(RIG).step_ns() is None


def test_only_the_last_minute_is_kept() -> None:
    recent = RecentDots(RIG)
    noise = np.random.default_rng(0)
    period_ns = 20_000_000
    for index in range(10_000):
        dots = tuple((1e-3 * (index > 6_000) + 2e-7 * noise.standard_normal(4)).tolist())
        recent.put(SpotMeans(index * period_ns, index, dots, (5.0, 5.0), np.zeros((4, 4)), 20, 0, BlockStatus.OK, ''))
    assert REACH_S / 0.02 < 4_000
    assert recent.step_ns() is None
