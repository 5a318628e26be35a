# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Combinations of the readings of more than two PSDs, against what linear algebra says of them."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.measure.uncertainty.combinations import combinations_of
from psd_deflection.records import FloatArray

CENTERS = np.array([[0.1, 0.0], [-0.05, 0.087], [-0.04, -0.087], [0.02, 0.03]])
ZEROS = np.array([[1e-3, 2e-3], [0.0, 1e-3], [-1e-3, 0.0], [2e-3, -1e-3]])
RNG = np.random.default_rng(1)


@pytest.mark.parametrize('psds', [3, 4])
@pytest.mark.parametrize('unknowns', [3, 5])
def test_the_first_ones_move_with_the_link_and_the_others_do_not(psds: int, unknowns: int) -> None:
    count, slopes = 2 * psds, RNG.normal(size=(2 * psds, unknowns))
    centers = CENTERS[:psds]
    of = combinations_of(centers, centers + ZEROS[:psds], slopes)
    assert (of.moving, of.still) == (unknowns, count)
    np.testing.assert_allclose(of.turn @ of.turn.T, np.eye(count), atol=1e-14)
    np.testing.assert_allclose(of.turn[unknowns:] @ slopes, 0.0, atol=1e-13)
    dots = 1e-3 * RNG.normal(size=(7, count))
    np.testing.assert_allclose(of.of(dots), (dots @ of.turn.T).T, rtol=1e-12)
    np.testing.assert_allclose(of.fixed(dots), dots @ of.turn[unknowns], rtol=1e-12)
    mixed = RNG.normal(size=(count, count))
    covariance = mixed @ mixed.T
    for row, z in zip(dots, of.of(dots).T, strict=True):
        back, back_covariance = of.back(z[None], covariance[None])
        np.testing.assert_allclose(back[0], row, atol=1e-17)
        np.testing.assert_allclose(back_covariance[0], of.turn.T @ covariance @ of.turn, rtol=1e-12)
    # What does not move is of what the model leaves, if it is asked.
    half = combinations_of(centers, centers, slopes, lambda d: np.asarray(0.5 * d))
    np.testing.assert_allclose(half.fixed(dots), 0.5 * of.fixed(dots), rtol=1e-12)


def test_a_flat_plate_is_meant_unless_slopes_are_given() -> None:
    """dX moves each x back, theta moves x by l_y and y by -l_x: of beams, not of centres."""
    centers = CENTERS[:3]
    beams = centers + ZEROS[:3]
    of = combinations_of(centers, beams)
    slopes = np.array([row for x, y in beams for row in ([-1.0, 0.0, y], [0.0, -1.0, -x])])
    assert of.moving == 3
    np.testing.assert_allclose(of.turn[3:] @ slopes, 0.0, atol=1e-15)


def test_near_dependent_slopes_leave_no_rounding() -> None:
    """Unit vectors that the first rows span to 1e-7 are left out; those that are 1e-5 apart are taken."""
    for off, spanned in ((1e-7, True), (1e-5, False)):
        slopes = np.zeros((6, 3))
        slopes[[0, 2, 4], [0, 1, 2]] = 1.0
        slopes[1, 0] = off
        of = combinations_of(CENTERS[:3], CENTERS[:3], slopes)
        np.testing.assert_allclose(of.turn @ of.turn.T, np.eye(6), atol=1e-14)
        # The first that is not of the slopes: of x1 what is left of it, or y1.
        assert abs(of.turn[3, 1]) == pytest.approx(1.0, abs=1e-9)
        np.testing.assert_allclose(of.turn[3:] @ slopes, 0.0, atol=1e-12)
        assert (of.turn[3, 1] > 0.0) == spanned


def base_line_back(value: list[float], covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    of = combinations_of(CENTERS[:2], CENTERS[:2] + ZEROS[:2])
    dots, back_covariance = of.back(np.array([value]), covariance[None])
    return dots[0], back_covariance[0]


def test_the_covariance_of_two_psds_goes_back_as_the_dots_do() -> None:
    """J C J^T, J by differences of the way back, at a twist of some degrees."""
    value = [1e-3, -2e-3, 4e-3, 2e-4]
    mixed = RNG.normal(size=(4, 4))
    covariance = mixed @ mixed.T
    columns = [
        (
            base_line_back([v + e for v, e in zip(value, step, strict=True)], covariance)[0]
            - base_line_back([v - e for v, e in zip(value, step, strict=True)], covariance)[0]
        )
        / 2e-6
        for step in (1e-6 * np.eye(4)).tolist()
    ]
    slopes = np.stack(columns, axis=1)
    back_covariance = base_line_back(value, covariance)[1]
    np.testing.assert_allclose(back_covariance, slopes @ covariance @ slopes.T, rtol=1e-6, atol=1e-8)


def test_base_line_below_its_twist_keeps_a_hundredth() -> None:
    """What no plate can show: still a number."""
    apart = CENTERS[0] - CENTERS[1]
    beams = CENTERS[:2] + ZEROS[:2]
    of = combinations_of(CENTERS[:2], beams)
    for twist in (0.2, 5.0):
        dots = of.back(np.array([[0.0, 0.0, twist, 0.0]]), np.eye(4)[None])[0][0]
        # The length is that of the beams, and what is along the base line at rest a hundredth of it.
        length = np.hypot(*(beams[0] - beams[1]))
        way = (beams[0] - beams[1]) / length
        along = float((dots[:2] - dots[2:] + apart) @ way)
        assert along == pytest.approx(0.01 * length, rel=1e-9)
