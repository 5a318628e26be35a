"""What is believed of messages of joints."""

from __future__ import annotations

import math

import pytest

from psd_deflection.arms.inputs import KNOWN_S, LONGEST_LIST, KnownJoints


def test_positions_are_known_for_a_while() -> None:
    known = KnownJoints()
    known.tell(1.0, ['a', 'b', 'c', 'd'], [0.1, math.nan, 1e300, -0.2])
    assert {name: one.position for name, one in known.measured(1.0 + KNOWN_S).items()} == {'a': 0.1, 'd': -0.2}
    assert known.measured(1.01 + KNOWN_S) == {}


@pytest.mark.parametrize('period', [0.002, 0.01, 0.1, 0.3])
def test_a_speed_is_that_over_a_tenth_of_a_second(period: float) -> None:
    known, speeds = KnownJoints(), []
    for n in range(round(2.0 / period)):
        now = n * period
        # It moves at 0.2 for a second, then stands; its encoder shakes by 0.1 mrad.
        known.tell(now, ['a'], [0.2 * min(now, 1.0) + 1e-4 * (n % 2)])
        speeds.append(known.measured(now)['a'].speed)
    assert math.isnan(speeds[0])
    assert speeds[round(1.0 / period) - 1] == pytest.approx(0.2, abs=2e-3)
    assert speeds[-1] < 2e-3
    # Told again after a silence, its speed is not known.
    known.tell(10.0, ['a'], [0.2])
    assert math.isnan(known.measured(10.0)['a'].speed)


@pytest.mark.parametrize('pause', [0.0, 2.0 * KNOWN_S])
def test_names_that_strangers_make_up_take_no_memory_and_no_place(pause: float) -> None:
    known, now = KnownJoints(), 0.0
    for n in range(300):
        known.tell(now, ['shoulder'], [0.5])
        known.tell(now, [f'{n}-{k}' for k in range(997)], [0.0] * 997)
        assert len(known) <= LONGEST_LIST
        assert known.measured(now)['shoulder'].position == 0.5
        now += pause
