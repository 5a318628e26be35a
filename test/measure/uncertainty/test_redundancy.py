# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The check of three and more PSDs, against least squares with dense matrices of numpy."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import pytest
from scipy.stats import chi2

from psd_deflection.measure.uncertainty.consistency import ConsistencyCheck
from psd_deflection.measure.uncertainty.redundancy import CONTRADICTS, DOUBTFUL, HOLD, Redundancy, survival
from psd_deflection.records import FloatArray

RNG = np.random.default_rng(7)
PSDS, UNKNOWNS = 4, 3
SLOPES = RNG.normal(size=(2 * PSDS, UNKNOWNS))
MIXED = RNG.normal(size=(2 * PSDS, 2 * PSDS))
COVARIANCE = 1e-12 * (MIXED @ MIXED.T + np.eye(2 * PSDS))
LIMIT = float(chi2.isf(CONTRADICTS, 2 * PSDS - UNKNOWNS))


def fitted(readings: FloatArray, slopes: FloatArray, covariance: FloatArray) -> tuple[FloatArray, float]:
    """Unknowns of the least squares with this covariance, and its chi-square."""
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    found = np.linalg.lstsq(root @ slopes, root @ readings, rcond=None)[0]
    left = root @ (readings - slopes @ found)
    return np.asarray(found, dtype=np.float64), float(left @ left)


def unexplained(slopes: FloatArray) -> FloatArray:
    weights = np.linalg.inv(COVARIANCE)
    return np.asarray(weights - weights @ slopes @ np.linalg.inv(slopes.T @ weights @ slopes) @ slopes.T @ weights)


def with_error(psd: int, error: tuple[float, float], chi_square: float | None = None) -> FloatArray:
    """Readings of some pose of which PSD ``psd`` (from 1) is wrong, so much that they have that chi-square."""
    wrong = np.zeros(2 * PSDS)
    wrong[2 * psd - 2 : 2 * psd] = error
    if chi_square is not None:
        wrong *= (chi_square / fitted(wrong, SLOPES, COVARIANCE)[1]) ** 0.5
    return SLOPES @ [1e-5, -2e-5, 3e-5] + wrong


def check(
    of: Redundancy, readings: FloatArray, blamed: Collection[int] | None = None, times: float = 1.0
) -> ConsistencyCheck:
    """``blamed``: PSDs without which the others agree; None: none may be left out."""
    without = None if blamed is None else lambda psd: psd in blamed
    return of.check(tuple(readings.tolist()), SLOPES, COVARIANCE, times, without)


@pytest.mark.parametrize('psd', range(1, PSDS + 1))
def test_the_error_of_one_psd_alone_is_that_of_least_squares_with_two_unknowns_more(psd: int) -> None:
    readings = with_error(psd, (2e-4, -3e-4)) + 1e-6 * np.random.default_rng(psd).normal(size=2 * PSDS)
    got = check(Redundancy(PSDS, UNKNOWNS), readings)
    assert got.chi_square == pytest.approx(fitted(readings, SLOPES, COVARIANCE)[1], rel=1e-9)
    assert got.freedom == 5
    for other in range(PSDS):
        more = np.eye(2 * PSDS)[:, 2 * other : 2 * other + 2]
        found, _ = fitted(readings, np.column_stack((SLOPES, more)), COVARIANCE)
        np.testing.assert_allclose(got.errors[2 * other : 2 * other + 2], found[-2:], rtol=1e-6)


@pytest.mark.parametrize('unknowns', [6, 7])
def test_with_one_or_two_degrees_of_freedom_each_reading_has_its_own_error(unknowns: int) -> None:
    slopes = np.random.default_rng(unknowns).normal(size=(2 * PSDS, unknowns))
    readings = 1e-5 * np.random.default_rng(9).normal(size=2 * PSDS)
    of = Redundancy(PSDS, unknowns)
    got = of.check(tuple(readings.tolist()), slopes, COVARIANCE, 1.0)
    assert got.freedom == 2 * PSDS - unknowns
    shows = unexplained(slopes).diagonal()
    for i, error in enumerate(got.errors):
        found, _ = fitted(readings, np.column_stack((slopes, np.eye(2 * PSDS)[:, i])), COVARIANCE)
        # A reading that hardly shows cannot be checked.
        assert error == pytest.approx(found[-1] if shows[i] > 4e-4 * shows.max() else 0.0, rel=1e-6)
    assert sum(error == 0.0 for error in got.errors) == (unknowns == 7)


def test_without_more_readings_than_unknowns_nothing_is_checked() -> None:
    for unknowns in (2 * PSDS, 2 * PSDS + 1):
        of = Redundancy(PSDS, unknowns)
        slopes = np.ones((2 * PSDS, unknowns))
        none = (0.0,) * (2 * PSDS)
        assert of.check((1.0,) * (2 * PSDS), slopes, COVARIANCE, 1.0) == (0.0, False, none, none, 0, 0)
        assert not of.agrees(none, slopes, COVARIANCE, 1.0)
    assert survival(3.0, 0) == 1.0
    assert survival(3.0, 5) == pytest.approx(chi2.sf(3.0, 5))


@pytest.mark.parametrize('times', [1.0, 16.0])
def test_limits(times: float) -> None:
    for share, contradict in ((0.99, False), (1.01, True)):
        of = Redundancy(PSDS, UNKNOWNS)
        readings = with_error(2, (1.0, 0.5), share * times * LIMIT)
        assert check(of, readings, times=times).contradict == contradict
        assert of.agrees(tuple(readings.tolist()), SLOPES, COVARIANCE, times) != contradict
    doubtful = float(chi2.isf(DOUBTFUL, 5))
    for share, widens in ((0.99, False), (1.01, True)):
        got = check(Redundancy(PSDS, UNKNOWNS), with_error(2, (1.0, 0.5), share * times * doubtful), times=times)
        # Half as much again as the error of a PSD alone, and both of its readings may be wrong together.
        want = 1.5 * 2.0**0.5 * np.abs(got.errors) if widens else np.zeros(2 * PSDS)
        np.testing.assert_allclose(got.possible, want, rtol=1e-12)


@pytest.mark.parametrize('psd', range(1, PSDS + 1))
def test_the_only_psd_to_blame_is_left_out_for_a_second(psd: int) -> None:
    of = Redundancy(PSDS, UNKNOWNS)
    first = check(of, with_error(psd, (1.0, 0.5), 2.0 * LIMIT), {psd})
    assert (first.wrong, first.contradict, first.possible) == (psd, True, (0.0,) * (2 * PSDS))
    blocks = 0
    while check(of, with_error(psd, (0.0, 0.0)), {psd}).wrong:
        blocks += 1
    assert blocks == HOLD - 1
    # Without agreement it is not left out any longer.
    check(of, with_error(psd, (1.0, 0.5), 2.0 * LIMIT), {psd})
    assert check(of, with_error(psd, (0.0, 0.0)), set()).wrong == 0


def test_if_two_may_be_blamed_none_is_left_out_and_both_errors_are_allowed_for() -> None:
    of = Redundancy(PSDS, UNKNOWNS)
    got = check(of, with_error(3, (1.0, 0.5), 2.0 * LIMIT), {1, 3})
    assert (got.wrong, got.contradict) == (0, True)
    want = 1.5 * 2.0**0.5 * np.abs(got.errors) * np.repeat([1, 0, 1, 0], 2)
    np.testing.assert_allclose(got.possible, want, rtol=1e-12)
    # One that was to blame alone before still is.
    of = Redundancy(PSDS, UNKNOWNS)
    check(of, with_error(3, (1.0, 0.5), 2.0 * LIMIT), {3})
    assert check(of, with_error(3, (1.0, 0.5), 2.0 * LIMIT), {1, 3}).wrong == 3
    assert check(of, with_error(3, (1.0, 0.5), 2.0 * LIMIT), {1, 2}).wrong == 0


def test_errors_are_held_and_forgotten_by_a_fiftieth_a_block() -> None:
    of = Redundancy(PSDS, UNKNOWNS)
    first = check(of, with_error(1, (1.0, 0.5), 9.0 * LIMIT))
    shows = unexplained(SLOPES).diagonal()
    for block in range(1, 300):
        got = check(of, with_error(1, (0.0, 0.0)))
        held = 0.98**block * np.square(first.errors)
        if not (held * shows > LIMIT).any():
            break
        assert got.contradict
        np.testing.assert_allclose(got.possible, np.array(first.possible) * 0.98 ** (block / 2.0), rtol=1e-9)
    assert block > 10
    assert not got.contradict
    assert got.possible == (0.0,) * (2 * PSDS)


def test_a_small_residual_that_lasts_is_widened_for_and_fades() -> None:
    """One of 1.7 standard deviations is nothing in a block, and much if it stays."""
    readings = with_error(2, (1.0, 0.5), 3.0)
    of = Redundancy(PSDS, UNKNOWNS)
    first = check(of, readings)
    assert not np.any(first.possible)
    mean = 1.0 / 8.0
    for _ in range(200):
        got = check(of, readings)
        mean += (1.0 - mean) / 8.0
        # The mean has the chi-square 3 mean^2.
        if 3.0 * mean * mean > 2.5:
            break
        assert not np.any(got.possible)
    assert not got.contradict
    np.testing.assert_allclose(got.possible, 1.5 * 2.0**0.5 * mean * np.abs(got.errors), rtol=1e-6)
    for _ in range(100):
        got = check(of, readings)
    np.testing.assert_allclose(got.possible, 1.5 * 2.0**0.5 * np.abs(got.errors), rtol=1e-4)
    # Gone, it is forgotten within a second or two.
    agreed = with_error(2, (0.0, 0.0))
    kept = check(of, agreed).possible
    assert np.any(kept)
    for _ in range(150):
        got = check(of, agreed)
    assert not np.any(got.possible)
