# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The load that suits a rig, against the linear formula of a dot written by hand."""

from __future__ import annotations

import math

import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.studies.budget.budget import BudgetProblem, budget
from psd_deflection.studies.budget.load import default_load

RIG = load_rig()


def _by_hand(rig: Rig) -> float:
    """N, before it is cut to two figures: half of the way of the first dot to its edge.

    A force of 1 N and a torque of 1 N x L, both negative, move the tip by dY and theta. A dot at l on a plate at height
    h then moves by x: theta ly, y: -theta lx - dY (1 + k h/L), to first order.
    """
    link = rig.link
    area = math.pi / 4.0 * (link.outer_radius**4 - link.inner_radius**4)
    dy = -(link.length**3) / (3.0 * link.youngs_modulus * area)
    theta = -link.length * link.length / (link.shear_modulus * 2.0 * area)
    ways = []
    for psd in rig.psds:
        lx, ly = psd.center[0] + psd.zero[0], psd.center[1] + psd.zero[1]
        moves = (theta * ly, -theta * lx - dy * (1.0 + link.slope_ratio * psd.height / link.length))
        for move, zero, size in zip(moves, psd.zero, psd.active_area, strict=True):
            room = size / 2.0 - zero if move > 0.0 else size / 2.0 + zero
            ways += [0.5 * room / abs(move)] if move else []
    return min(ways)


@pytest.mark.parametrize(
    'changes',
    [
        {'link.length': 0.8},
        {'link.length': 1.7, 'psd_1.height': 0.2, 'psd_2.height': -0.3},
        {'psd_1.center': [0.0, 0.065]},
        {'psd_2.center': [-0.3, 0.01]},
        {'psd_2.center': [0.3, 0.01]},
        {'psd_1.center': [0.02, 0.6], 'link.shear_modulus': 5e9},
        {'psd_1.center': [0.02, -0.6], 'link.shear_modulus': 5e9, 'psd_1.zero': [2e-3, 0.0]},
        {'psd_1.center': [0.02, -0.6], 'link.shear_modulus': 5e9, 'psd_1.zero': [-2e-3, 0.0]},
        {'psd_1.active_area': [0.02, 0.01]},
        {'psd_1.active_area': [0.01, 0.02], 'psd_2.active_area': [0.01, 0.02]},
        {'psd_1.height': 0.01},
        {'psd_2.height': 0.01},
        {'psd_2.active_area': [0.01, 0.004]},
        {'psd_2.active_area': [0.001, 0.01], 'psd_2.center': [-0.1, 0.09]},
        {'link.length': 0.9, 'psd_1.zero': [0.0, 4e-3]},
        {'link.length': 0.9, 'psd_1.zero': [0.0, -4e-3]},
        {'link.youngs_modulus': 2e11, 'link.shear_modulus': 8e10},
    ],
    ids=str,
)
def test_a_load_moves_the_first_dot_half_of_its_way(changes: dict[str, object]) -> None:
    rig = replace_values(RIG, changes)
    fx, fy, tz = default_load(rig)
    wanted = _by_hand(rig)
    # Two figures of it, cut off.
    figures = float(f'{wanted:.8e}'[:3] + 'e' + f'{wanted:.8e}'.partition('e')[2])
    assert fx == 0.0
    assert -fy == pytest.approx(figures, rel=1e-9)
    assert tz == fy * rig.link.length
    # No digits beyond these two.
    assert len(f'{-fy:.12g}'.replace('.', '').strip('0')) <= 2


@pytest.mark.parametrize('length', [30.0, 100.0, 1000.0])
def test_a_soft_link_is_loaded_with_two_figures_as_well(length: float) -> None:
    soft = {'link.length': length, 'link.outer_radius': 2e-3, 'link.inner_radius': 1e-3}
    rig = replace_values(RIG, soft)
    wanted = _by_hand(rig)
    assert 0.0 < wanted - -default_load(rig)[1] <= 0.1 * wanted


def test_the_links_of_the_thesis_have_its_50_newtons() -> None:
    assert list(default_load(RIG)) == pytest.approx([0.0, -50.0, -29.25], rel=1e-12)
    # What is no part of the layout does not count.
    assert default_load(replace_values(RIG, {'amplifier.noise': 1e-3, 'psd_1.zero': [1e-4, 0.0]}))[1] == -50.0


def test_without_room_there_is_no_load() -> None:
    rig = replace_values(RIG, {'psd_1.active_area': [0.004, 0.004], 'psd_1.zero': [0.0, 0.003]})
    assert [abs(v) for v in default_load(rig)] == [0.0, 0.0, 0.0]


def test_a_rig_of_three_detectors_is_rejected_in_words() -> None:
    three = replace_values(RIG, {'psd_3.center': [0.1, 0.0]})
    with pytest.raises(ConfigError, match='two PSDs'):
        budget(BudgetProblem(three))
