# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What each wiring explains of a push, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.rig.config import load_rig
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.wirings import (
    Difference,
    PushResponse,
    differences,
    fitting_wirings,
    fix_of,
    line,
    parameters,
    pattern,
    scales_of,
)

PLAIN = Wiring()
ROTATED = Wiring(True, (('-y', 'x'), ('x', 'y')))
"""PSD 1 is on input 2: its x is y2 turned, its y is x2. PSD 2 is on input 1 as it should be."""


def push(
    channels: list[float],
    expected: list[float] | None = None,
    loads: tuple[str, ...] = ('fx',),
    *,
    sd: list[float] | None = None,
    only_twist: bool = False,
    scales: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0),
) -> PushResponse:
    return PushResponse(
        loads,
        np.array(channels),
        np.array(sd or [1e-3] * 4),
        np.array(expected or channels),
        only_twist=only_twist,
        scales=scales,
    )


def test_a_pattern_is_unknown_for_psds_at_the_base() -> None:
    rig = load_rig(overrides={'psd_1.zero': [0.002, -0.01], 'psd_2.zero': [0.01, 0.004]})
    # x_i = -X + ly θ, y_i = -Y - lx θ, of beams at (0 + 2, 70 - 10) and (-100 + 10, 0 + 4) mm.
    wanted = np.array([[-1, 0, 0.06], [0, -1, -0.002], [-1, 0, 0.004], [0, -1, 0.09]])
    assert pattern(rig) == pytest.approx(wanted)
    base = load_rig(overrides={'solver': 'base_pair', 'psd_1.height': -0.5, 'psd_2.height': -0.4})
    with pytest.raises(ConfigError, match='PSDs at the base'):
        pattern(base)
    gains = load_rig(overrides={'psd_1.sensitivity': [4e-4, 6e-4], 'psd_2.sensitivity': [5e-4, 8e-4]})
    assert scales_of(gains) == pytest.approx((0.8, 1.2, 1.0, 1.6))


@pytest.mark.parametrize(
    ('channels', 'sd', 'only_twist', 'observed'),
    [
        # Six deviations; exactly six are not beyond. Of four channels their mean square counts: 4/4 = 1.
        ([6.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], False, False),
        ([6.01, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], False, True),
        ([0.0, 5.0, 0.0, 3.4], [1.0, 1.0, 1.0, 1.0], False, True),
        ([0.0, 5.0, 0.0, 3.3], [1.0, 1.0, 1.0, 1.0], False, False),
        # A difference of two has twice the variance: 36 + 36 is not beyond 36 * 2.
        ([6.0, 0.0, 0.0, 6.0], [1.0, 1.0, 1.0, 1.0], True, False),
        ([6.01, 0.0, 0.0, 6.0], [1.0, 1.0, 1.0, 1.0], True, True),
        # What both dots share does not count.
        ([100.0, 50.0, 100.0, 50.0], [1.0, 1.0, 1.0, 1.0], True, False),
    ],
)
def test_a_push_is_observed_beyond_six_deviations(
    channels: list[float], sd: list[float], only_twist: bool, observed: bool
) -> None:
    assert push(channels, sd=sd, only_twist=only_twist).observed is observed


def test_unexplained_share_is_square_outside_pattern() -> None:
    # (3, 4) along (2, 0): 1.5 times as large, and 16 of 25 are left.
    assert push([3.0, 4.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]).misfit(PLAIN) == pytest.approx((0.64, 1.5))
    assert push([-3.0, 0.0, 0.0, 4.0], [2.0, 0.0, 0.0, 0.0]).misfit(PLAIN) == pytest.approx((0.64, -1.5))
    # In metres of the PSD first: twice x1 and half y1 are (6, 2).
    scaled = push([3.0, 4.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], scales=(2.0, 0.5, 1.0, 1.0))
    assert scaled.misfit(PLAIN) == pytest.approx((4.0 / 40.0, 3.0))
    # Of a turn the difference of the dots: (3 - 1, 4 - 0) along (2 - 0, 0).
    turn = push([3.0, 4.0, 1.0, 0.0], [2.0, 0.0, 0.0, 0.0], only_twist=True)
    assert turn.misfit(PLAIN) == pytest.approx((16.0 / 20.0, 1.0))
    # With the wiring turned the PSDs see x1 = -y2, y1 = x2, x2 = x1, y2 = y1.
    assert push([7.0, 8.0, 3.0, 4.0], [-4.0, 3.0, 7.0, 8.0]).misfit(ROTATED) == pytest.approx((0.0, 1.0), abs=1e-12)


def of_plate(*rows: tuple[str, float], lean: float = 0.0) -> list[PushResponse]:
    """Pushes of so many m or rad that a plate answers to; ``lean``: share of a right angle's other axis."""
    plate = {'fx': [-1.0, 0.0, -1.0, 0.0], 'fy': [0.0, -1.0, 0.0, -1.0], 'tz': [0.07, 0.0, 0.0, 0.1]}
    other = {'fx': 'fy', 'fy': 'fx', 'tz': 'fx'}
    out = []
    for load, size in rows:
        moved = size * (np.array(plate[load]) + lean * np.array(plate[other[load]]))
        out.append(PushResponse((load,), moved, np.full(4, 1e-6), np.array(plate[load])))
    return out


def test_three_pushes_leave_one_wiring_and_two_leave_several() -> None:
    found = fitting_wirings(of_plate(('fx', 1.0), ('fy', 1.0), ('tz', 10.0)))
    assert [(f.wiring, f.reversed_loads) for f in found] == [(PLAIN, ())]
    assert found[0].misfit == pytest.approx(0.0, abs=1e-12)
    # Along X and Y both PSDs move alike: they may be exchanged.
    both = fitting_wirings(of_plate(('fx', 1.0), ('fy', 1.0)))
    assert [f.wiring for f in both] == [PLAIN, Wiring(exchanged=True)]
    assert fitting_wirings([]) != []
    # The one load that went the other way, of two and of three.
    for rows in ([('fx', 1.0), ('tz', -10.0)], [('fx', 1.0), ('fy', 1.0), ('tz', -10.0)]):
        assert {f.reversed_loads for f in fitting_wirings(of_plate(*rows))} <= {('tz',), ('fx',), ('fx', 'fy')}


def test_each_difference_has_the_line_that_puts_it_right() -> None:
    right = parameters(ROTATED, PLAIN)
    assert [fix_of(d, ROTATED, right) for d in differences(ROTATED, PLAIN)] == [
        'psds_exchanged: true',
        'psd_1.axes: [-y, x]',
        'psd_1.axes: [-y, x]',
    ]
    # The file has x1 turned for PSD 1, and PSDs are exchanged: PSD 2, which is on input 1, is right as it is.
    now, file = Wiring(exchanged=True), Wiring(False, (('-x', 'y'), ('x', 'y')))
    assert differences(now, file) == [Difference('psd_swap', 'psd_1 psd_2'), Difference('channel_sign', 'x1')]
    assert fix_of(Difference('channel_sign', 'x1'), now, parameters(now, file)) == "psd_2.axes: [x, 'y']"
    assert fix_of(Difference('channel_sign', 'y2'), now, {}) == "psd_1.axes: [x, 'y']"
    other = Wiring(True, (('x', '-y'), ('y', 'x')))
    assert fix_of(Difference('channel_sign', 'x1'), other, {}) == "psd_2.axes: ['y', x]"
    assert fix_of(Difference('channel_sign', 'x2'), other, {}) == 'psd_1.axes: [x, -y]'
    assert line('a', 0.5) == 'a: 0.5'
    assert line('a', False) == 'a: false'
