# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The correction of dots by formulas written again: what stands for what is not given, order, passes."""

from __future__ import annotations

import cmath

import numpy as np
import pytest

from psd_deflection.measure.correction import Correction
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig

REST = np.zeros((2, 4))


def correction(*effects: dict[str, object]) -> Correction:
    named = {f'effects.e{i}.{k}': v for i, values in enumerate(effects) for k, v in values.items()}
    return Correction.from_rig(load_rig(overrides=named))


def test_without_a_temperature_and_a_time_nothing_has_drifted() -> None:
    warm = correction({'name': 'thermal_drift', 'psd': 2, 'x': 3e-6, 'y': -1e-6})
    assert (warm.uses_temperature, warm.uses_time) == (True, False)
    np.testing.assert_array_equal(warm.apply(REST), REST)
    np.testing.assert_allclose(warm.apply(REST, None, 2.0), [[0.0, 0.0, -6e-6, 2e-6]] * 2, rtol=1e-12)
    late = correction({'name': 'laser_pointing_drift', 'psd': 1, 'rate_x': 2e-6, 'rate_y': 1e-6})
    assert (late.uses_temperature, late.uses_time) == (False, True)
    np.testing.assert_allclose(late.apply(REST), REST, atol=1e-18)
    # The beam of PSD 1 has gone so far, and the dot with it.
    got = late.apply(REST, t=np.array([0.0, 3.0]))
    np.testing.assert_allclose(got, [[0.0] * 4, [-6e-6, -3e-6, 0.0, 0.0]], rtol=1e-4, atol=1e-18)


@pytest.mark.parametrize('psd', [1, 2])
def test_ambient_light_is_removed_with_sum_of_its_psd(psd: int) -> None:
    """Of S + level at the centroid (S m + level c)/(S + level); without a sum S + level is the nominal 5 V."""
    light = correction({'name': 'ambient_light', 'psd': psd, 'level': 0.5, 'x': 1e-3, 'y': -2e-3})
    dots = np.array([[1e-4, 2e-4, 3e-4, 4e-4]])
    column = 2 * psd - 2
    for sums, own in ((None, 5.0), (np.array([[4.0, 3.0]]), 5.0 - psd)):
        wanted = dots.copy()
        read = dots[0, column : column + 2]
        wanted[0, column : column + 2] = (own * read - 0.5 * np.array([1e-3, -2e-3])) / (own - 0.5)
        np.testing.assert_allclose(light.apply(dots, sums), wanted, rtol=1e-12)


def test_what_came_last_is_taken_off_first() -> None:
    """A PSD is turned, then its axes mix, then it is scaled: three that do not commute."""
    c, s = np.cos(0.3), np.sin(0.3)
    rotated, mixed, scaled = np.array([[c, s], [-s, c]]), np.array([[1.0, 0.2], [-0.1, 1.0]]), np.diag([1.5, 0.8])
    true = np.array([1e-3, -0.4e-3])
    dots = np.array([[*(scaled @ mixed @ rotated @ true), 0.0, 0.0]])
    of_all = correction(
        {'name': 'sensor_gain', 'psd': 1, 'x': 0.5, 'y': -0.2},
        {'name': 'sensor_rotation', 'psd': 1, 'angle': 0.3},
        {'name': 'axis_crosstalk', 'psd': 1, 'xy': 0.2, 'yx': -0.1},
    )
    np.testing.assert_allclose(of_all.apply(dots), [[*true, 0.0, 0.0]], rtol=1e-12, atol=1e-18)


def test_the_pose_is_found_in_three_passes() -> None:
    """PSD 1 and its laser are 6 mm off. With plane vectors as complex numbers, m = exp(-i theta)(l - d) - c."""
    centers, off = np.array([0.07j, -0.1]), np.array([5e-3 + 3e-3j, 0.0])

    def shown(theta: float, d: complex, at: FloatArray) -> FloatArray:
        return np.asarray(cmath.exp(-1j * theta) * (at - d) - at)

    theta, d = 0.04, 2e-3 - 1e-3j
    read = shown(theta, d, centers + off)
    dots = read
    for _ in range(3):
        points = centers + dots
        from_middle = points - points.mean(), centers - centers.mean()
        turn = cmath.phase(np.sum(from_middle[0].conj() * from_middle[1]))
        moved = centers.mean() - cmath.exp(1j * turn) * points.mean()
        dots = read - (shown(turn, moved, centers + off) - shown(turn, moved, centers))
    given = np.column_stack([read.real, read.imag]).reshape(1, 4)
    got = correction({'name': 'sensor_position', 'psd': 1, 'x': 5e-3, 'y': 3e-3}).apply(given)
    np.testing.assert_allclose(got, np.column_stack([dots.real, dots.imag]).reshape(1, 4), atol=1e-13)
    # Each pass leaves some per cent of the error of the one before.
    true = shown(theta, d, centers)
    assert 1e-10 < np.abs(dots - true).max() < 1e-7
