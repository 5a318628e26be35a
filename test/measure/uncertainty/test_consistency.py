# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The check of the readings of two and of more PSDs, against least squares with dense matrices of numpy."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np
import pytest
from scipy.stats import chi2

from psd_deflection.measure.uncertainty.consistency import (
    CONTRADICTS,
    DOUBTFUL,
    HOLD,
    ONE_DEGREE,
    BaseLineExcess,
    ConsistencyCheck,
    ConsistencyResult,
    Unexplained,
    UnexplainedResidual,
    survival,
    widened,
)
from psd_deflection.records import FloatArray


def residual_of(readings: FloatArray, slopes: FloatArray, covariance: FloatArray) -> tuple[FloatArray, float]:
    """Unknowns of the least squares with this covariance, and its chi-square."""
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    unknowns = np.linalg.lstsq(root @ slopes, root @ readings, rcond=None)[0]
    residual = root @ (readings - slopes @ unknowns)
    return np.asarray(unknowns, dtype=np.float64), float(residual @ residual)


# Two PSDs.

REST = (0.100, 0.070)
COVARIANCE = np.diag([4e-12, 1e-12, 9e-12, 2e-12]) + 0.5e-12
# d(x1, y1, x2, y2)/d(dX, dY, theta) at rest: -1, and the place turned by a right angle.
DESIGN = np.array([[-1.0, 0.0, 0.070], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.100]])


def two() -> ConsistencyCheck:
    return ConsistencyCheck(2, 3, 1)


@pytest.mark.parametrize('seed', range(4))
def test_excess_of_the_base_line_is_that_of_least_squares(seed: int) -> None:
    """Whatever the weights were with which the pose was found."""
    readings = np.random.default_rng(seed).normal(size=4) * 5e-6
    residual = readings - DESIGN @ np.linalg.lstsq(DESIGN, readings, rcond=None)[0]
    got = two().update(BaseLineExcess(REST, tuple(residual.tolist()), COVARIANCE), 1.0, None)
    assert got.chi_square == pytest.approx(residual_of(readings, DESIGN, COVARIANCE)[1], rel=1e-9)
    # Of each reading the error that alone explains all: with it taken off nothing is left.
    for i, error in enumerate(got.errors):
        true = readings - error * np.eye(4)[i]
        assert residual_of(true, DESIGN, COVARIANCE)[1] == pytest.approx(0.0, abs=1e-9)


def test_readings_across_base_line_have_no_error() -> None:
    """Along a base line in x a wrong y changes its length to second order only."""
    for y, observed in ((0.0, False), (0.0028 * 2**0.5 * 1.05, True), (0.0028 * 2**0.5 * 0.95, False)):
        got = two().update(BaseLineExcess((0.14, y), (1e-5, 0.0, -1e-5, 0.0), COVARIANCE), 1.0, None)
        assert [e != 0.0 for e in got.errors] == [True, observed, True, observed]
    assert two().update(None, 1.0, None) == (0.0, False, (0.0,) * 4, (0.0,) * 4, 0, 1)
    assert BaseLineExcess(REST, (1e-5, 0.0, 0.0, 0.0), np.zeros((4, 4))).chi_square == 0.0


@pytest.mark.slow
def test_the_state_follows_its_laws_through_any_blocks() -> None:
    """Chi-squares by chance around the limits, of either sign, for a while of one: each law written again."""
    rng = np.random.default_rng(11)
    along = np.array([*REST, *(-c for c in REST)]) / math.hypot(*REST) / 2**0.5
    variance = float(along @ COVARIANCE @ along)
    of, held, mean, lasting = two(), 0.0, 0.0, 0.0
    observed = set()
    for block in range(1500):
        limit = 400.0 if block % 300 > 250 else 25.0
        chi_square = rng.choice([0.0, 1.5, 2.4, 3.0, 6.0, 7.0, 24.0, 26.0, 390.0, 410.0])
        r = math.sqrt(chi_square * variance) * (1.0 if block // 40 % 2 else rng.choice([-1.0, 1.0]))
        contradicts = chi_square > limit
        held = max(0.98 * held, r * r if contradicts else 0.0)
        held = held if held > limit * variance else 0.0
        mean = mean + (r - mean) / 8.0
        # 2.5 of a limit of 25, and its share of a wider one.
        lasting = max(0.98 * lasting, mean * mean if mean * mean > 0.1 * limit * variance else 0.0)
        lasting = lasting if lasting > variance else 0.0
        doubtful = chi_square > 6.635 / 25.0 * limit
        root = 1.5 * math.sqrt(max(held, lasting, r * r if doubtful else 0.0))
        got = of.update(BaseLineExcess(REST, tuple((along * r).tolist()), COVARIANCE), limit / 25.0, None)
        assert got.chi_square == pytest.approx(chi_square, abs=1e-9)
        assert got.contradict == (held > 0.0)
        np.testing.assert_allclose(got.errors, r / along, rtol=1e-9)
        np.testing.assert_allclose(got.possible, root / along, rtol=1e-9)
        np.testing.assert_allclose(of.state(), (0.0, 0.0, held, mean, lasting), rtol=1e-9, atol=1e-18)
        observed.add((held > 0.0, lasting > 0.0, doubtful))
    assert len(observed) > 5


def test_limits_of_one_degree_are_those_of_the_shares() -> None:
    np.testing.assert_allclose(ONE_DEGREE, chi2.isf([CONTRADICTS, DOUBTFUL], 1), rtol=2e-5)


def test_covariance_is_widened_by_each_error_alone() -> None:
    gain = np.linalg.pinv(DESIGN)
    errors = (1e-5, -2e-5, 0.0, 3e-5)
    own = gain @ COVARIANCE @ gain.T
    want = own + sum(np.outer(gain[:, i] * e, gain[:, i] * e) for i, e in enumerate(errors))
    np.testing.assert_allclose(widened(own, gain, errors), want, rtol=1e-12, atol=1e-24)


# Four PSDs.

RNG = np.random.default_rng(7)
PSDS, UNKNOWNS = 4, 3
SLOPES = RNG.normal(size=(2 * PSDS, UNKNOWNS))
MIXED = RNG.normal(size=(2 * PSDS, 2 * PSDS))
FULL = 1e-12 * (MIXED @ MIXED.T + np.eye(2 * PSDS))
LIMIT = float(chi2.isf(CONTRADICTS, 2 * PSDS - UNKNOWNS))


def unexplained(slopes: FloatArray) -> FloatArray:
    weights = np.linalg.inv(FULL)
    return np.asarray(weights - weights @ slopes @ np.linalg.inv(slopes.T @ weights @ slopes) @ slopes.T @ weights)


def with_error(psd: int, error: tuple[float, float], chi_square: float | None = None) -> FloatArray:
    """Readings of some pose of which PSD ``psd`` (from 1) is wrong, so much that they have that chi-square."""
    wrong = np.zeros(2 * PSDS)
    wrong[2 * psd - 2 : 2 * psd] = error
    if chi_square is not None:
        wrong *= (chi_square / residual_of(wrong, SLOPES, FULL)[1]) ** 0.5
    return SLOPES @ [1e-5, -2e-5, 3e-5] + wrong


def four() -> ConsistencyCheck:
    return ConsistencyCheck(PSDS, UNKNOWNS, 2 * PSDS)


def of(readings: FloatArray) -> Unexplained:
    return UnexplainedResidual(tuple(readings.tolist()), SLOPES, FULL)


def check(
    checks: ConsistencyCheck, readings: FloatArray, blamed: Collection[int] | None = None, times: float = 1.0
) -> ConsistencyResult:
    """``blamed``: PSDs without which the others agree; None: none may be excluded."""
    if blamed is not None:
        blamed = [psd for psd in checks.candidates(of(readings), times) if psd in blamed]
    return checks.update(of(readings), times, blamed)


@pytest.mark.parametrize('psd', range(1, PSDS + 1))
def test_psd_error_is_least_squares_with_two_unknowns(psd: int) -> None:
    readings = with_error(psd, (2e-4, -3e-4)) + 1e-6 * np.random.default_rng(psd).normal(size=2 * PSDS)
    got = check(four(), readings)
    assert got.chi_square == pytest.approx(residual_of(readings, SLOPES, FULL)[1], rel=1e-9)
    assert got.freedom == 5
    for other in range(PSDS):
        more = np.eye(2 * PSDS)[:, 2 * other : 2 * other + 2]
        found, _ = residual_of(readings, np.column_stack((SLOPES, more)), FULL)
        np.testing.assert_allclose(got.errors[2 * other : 2 * other + 2], found[-2:], rtol=1e-6)


@pytest.mark.parametrize('unknowns', [6, 7])
def test_each_reading_has_own_error_at_low_freedom(unknowns: int) -> None:
    slopes = np.random.default_rng(unknowns).normal(size=(2 * PSDS, unknowns))
    readings = 1e-5 * np.random.default_rng(9).normal(size=2 * PSDS)
    checks = ConsistencyCheck(PSDS, unknowns, 2 * PSDS)
    got = checks.update(UnexplainedResidual(tuple(readings.tolist()), slopes, FULL), 1.0, None)
    assert got.freedom == 2 * PSDS - unknowns
    shows = unexplained(slopes).diagonal()
    for i, error in enumerate(got.errors):
        found, _ = residual_of(readings, np.column_stack((slopes, np.eye(2 * PSDS)[:, i])), FULL)
        # A reading that hardly shows cannot be checked.
        assert error == pytest.approx(found[-1] if shows[i] > 4e-4 * shows.max() else 0.0, rel=1e-6)
    assert sum(error == 0.0 for error in got.errors) == (unknowns == 7)


def test_without_more_readings_than_unknowns_nothing_is_checked() -> None:
    for unknowns in (2 * PSDS, 2 * PSDS + 1):
        checks, none = ConsistencyCheck(PSDS, unknowns, 2 * PSDS), (0.0,) * (2 * PSDS)
        assert checks.update(None, 1.0, None) == (0.0, False, none, none, 0, 0)
        assert not checks.agrees(None, 1.0)
    assert [survival(3.0, n) for n in (0, 1, 5)] == pytest.approx([1.0, chi2.sf(3.0, 1), chi2.sf(3.0, 5)])


@pytest.mark.parametrize('times', [1.0, 16.0])
def test_limits(times: float) -> None:
    for share, contradict in ((0.99, False), (1.01, True)):
        checks, readings = four(), with_error(2, (1.0, 0.5), share * times * LIMIT)
        assert checks.candidates(of(readings), times) == ((1, 2, 3, 4) if contradict else ())
        assert checks.agrees(of(readings), times) != contradict
        assert check(checks, readings, times=times).contradict == contradict
    doubtful = float(chi2.isf(DOUBTFUL, 5))
    for share, widens in ((0.99, False), (1.01, True)):
        got = check(four(), with_error(2, (1.0, 0.5), share * times * doubtful), times=times)
        # Half as much again as the error of a PSD alone, and both of its readings may be wrong together.
        want = 1.5 * 2.0**0.5 * np.abs(got.errors) if widens else np.zeros(2 * PSDS)
        np.testing.assert_allclose(got.possible, want, rtol=1e-12)


@pytest.mark.parametrize('psd', range(1, PSDS + 1))
def test_the_only_psd_to_blame_is_left_out_for_a_second(psd: int) -> None:
    checks = four()
    first = check(checks, with_error(psd, (1.0, 0.5), 2.0 * LIMIT), {psd})
    assert (first.excluded, first.contradict, first.possible) == (psd, True, (0.0,) * (2 * PSDS))
    blocks = 0
    while check(checks, with_error(psd, (0.0, 0.0)), {psd}).excluded:
        blocks += 1
    assert blocks == HOLD - 1
    # Without agreement it is not left out any longer.
    check(checks, with_error(psd, (1.0, 0.5), 2.0 * LIMIT), {psd})
    assert check(checks, with_error(psd, (0.0, 0.0)), set()).excluded == 0


def test_two_outlier_candidates_stay_with_both_errors() -> None:
    checks = four()
    got = check(checks, with_error(3, (1.0, 0.5), 2.0 * LIMIT), {1, 3})
    assert (got.excluded, got.contradict) == (0, True)
    want = 1.5 * 2.0**0.5 * np.abs(got.errors) * np.repeat([1, 0, 1, 0], 2)
    np.testing.assert_allclose(got.possible, want, rtol=1e-12)
    # One that was to blame alone before still is.
    checks = four()
    check(checks, with_error(3, (1.0, 0.5), 2.0 * LIMIT), {3})
    assert check(checks, with_error(3, (1.0, 0.5), 2.0 * LIMIT), {1, 3}).excluded == 3
    assert check(checks, with_error(3, (1.0, 0.5), 2.0 * LIMIT), {1, 2}).excluded == 0
