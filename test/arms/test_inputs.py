"""What is believed of messages of joints."""

from __future__ import annotations

import math

import pytest

from psd_deflection.arms.inputs import KNOWN_S, LONGEST_LIST, KnownJoints


def test_positions_are_known_for_a_while() -> None:
    known = KnownJoints()
    known.tell(1.0, ['a', 'b', 'c', 'd'], [0.1, math.nan, 1e300, -0.2])
    assert known.positions(1.0 + KNOWN_S) == {'a': 0.1, 'd': -0.2}
    assert known.positions(1.01 + KNOWN_S) == {}


@pytest.mark.parametrize('pause', [0.0, 2.0 * KNOWN_S])
def test_names_that_strangers_make_up_take_no_memory_and_no_place(pause: float) -> None:
    known, now = KnownJoints(), 0.0
    for n in range(300):
        known.tell(now, ['shoulder'], [0.5])
        known.tell(now, [f'{n}-{k}' for k in range(997)], [0.0] * 997)
        assert len(known) <= LONGEST_LIST
        assert known.positions(now)['shoulder'] == 0.5
        now += pause
