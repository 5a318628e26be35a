# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A short form of ``python -m blind.coverage``: the truth is inside the published intervals as often as they say."""

import pytest

from blind.coverage import ROWS, UNEQUAL, Inside, fault, on_a_moving_base, over_the_bound, score, warming

pytestmark = pytest.mark.slow

LABELS = ('white', 'AR(1) 0.9', 'twice the noise', '1, 2, 4, 2 mV', 'unequal channels')


@pytest.mark.parametrize('label', LABELS)
def test_the_truth_is_inside(label: str) -> None:
    row = next(r for r in ROWS if r.label == label)
    s = score(row, '20 %' if label == 'white' else 'none', rest_s=24, steps=4, seed=3)
    for part in (s.rest, s.ringing):
        assert part.blocks >= 900
        # 0.95, give or take three standard deviations of a thousand blocks.
        assert covers(part)
    assert s.ringing.three > 0.99
    assert s.alarms == 0.0


def covers(part: Inside) -> bool:
    return all(0.92 < share < 0.98 for share in (*part.axes, part.joint))


def test_temperature_drift_in_rig_file_is_covered() -> None:
    assert covers(warming(rest_s=26, steps=2, seed=3).rest)
    assert warming(reported=False, rest_s=26, steps=2, seed=3).rest.joint < 0.8


def test_the_truth_is_inside_on_a_moving_base() -> None:
    assert covers(on_a_moving_base(30, seed=3))


def test_weights_from_the_stated_noise_reach_the_bound() -> None:
    ratios = over_the_bound(UNEQUAL, ('wls', 'ols'), rest_s=160)
    assert (ratios['wls'] < 1.02).all()
    assert ratios['ols'][0] > 1.4


@pytest.mark.parametrize(('kind', 'channel'), [('dead', 1), ('stuck', 3), ('inverted', 0), ('swapped', 1)])
def test_a_wrong_reading_keeps_the_truth_inside_8_sd(kind: str, channel: int) -> None:
    worst, _ = fault(kind, channel, (0.0, -30.0, -17.55))
    assert worst < 8.0
