# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reading too many, against generalised least squares with dense matrices of numpy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from psd_deflection.measure.uncertainty.consistency import Consistency, Suspect, widened
from psd_deflection.records import FloatArray

CENTERS = np.array([[0.0, 0.070], [-0.100, 0.0]])
COVARIANCE = np.diag([4e-12, 1e-12, 9e-12, 2e-12]) + 0.5e-12
REST = tuple((CENTERS[0] - CENTERS[1]).tolist())
# d(x1, y1, x2, y2)/d(dX, dY, theta) at rest: -1, and the place turned by a right angle.
DESIGN = np.array([[-1.0, 0.0, 0.070], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.100]])


def left_over(readings: FloatArray, covariance: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """Residual of least squares with this covariance, its chi-square, and the gain."""
    weight = np.linalg.inv(covariance)
    gain = np.linalg.inv(DESIGN.T @ weight @ DESIGN) @ DESIGN.T @ weight
    residual = readings - DESIGN @ gain @ readings
    return residual, float(residual @ weight @ residual), gain


def check(readings: FloatArray, of: Consistency | None = None, **options: Any) -> Any:
    residual, _, _ = left_over(readings, np.eye(4))
    return (of or Consistency()).check(REST, tuple(residual.tolist()), COVARIANCE, **options)


@pytest.mark.parametrize('seed', range(4))
def test_chi_square_is_that_of_least_squares_with_the_whole_covariance(seed: int) -> None:
    """Whatever the weights were with which the pose was found."""
    readings = np.random.default_rng(seed).normal(size=4) * 5e-6
    _, chi_square, _ = left_over(readings, COVARIANCE)
    got = check(readings)
    assert got.chi_square == pytest.approx(chi_square, rel=1e-9)
    # Of each reading the error that alone explains all: with it taken off nothing is left.
    for i, error in enumerate(got.errors):
        true = readings.copy()
        true[i] -= error
        assert left_over(true, COVARIANCE)[1] == pytest.approx(0.0, abs=1e-9)


def scaled_to(chi_square: float) -> FloatArray:
    readings = np.array([1e-5, 0.0, 0.0, 0.0])
    return readings * math.sqrt(chi_square / left_over(readings, COVARIANCE)[1])


@pytest.mark.parametrize(
    ('chi_square', 'contradict', 'widens', 'limit'),
    [
        (24.9, False, True, 25.0),
        (25.1, True, True, 25.0),
        # Chance exceeds 6.635 once in a hundred.
        (6.7, False, True, 25.0),
        (6.5, False, False, 25.0),
        (399.0, False, True, 400.0),
        (401.0, True, True, 400.0),
        (107.0, False, True, 400.0),
        (105.0, False, False, 400.0),
    ],
)
def test_limits(chi_square: float, contradict: bool, widens: bool, limit: float) -> None:
    got = check(scaled_to(chi_square), limit=limit)
    assert got.chi_square == pytest.approx(chi_square)
    assert got.contradict == contradict
    # Half as much again as the error of one alone.
    assert np.abs(got.possible) == pytest.approx(1.5 * np.abs(got.errors) if widens else np.zeros(4))


def test_what_has_next_to_no_part_in_the_base_line_is_not_accused() -> None:
    """Along a base line in x a wrong y changes its length to second order only."""
    for y, seen in ((0.0, False), (0.0028 * 2**0.5 * 1.05, True), (0.0028 * 2**0.5 * 0.95, False)):
        got = Consistency().check((0.14, y), (1e-5, 0.0, -1e-5, 0.0), COVARIANCE)
        assert [e != 0.0 for e in got.errors] == [True, seen, True, seen]
    nothing = Consistency().check((0.0, 0.0), (1e-5,) * 4, COVARIANCE)
    assert nothing == (0.0, False, (0.0,) * 4, (0.0,) * 4, 0, 1)
    assert Consistency().check(REST, (1e-5, 0.0, 0.0, 0.0), np.zeros((4, 4))).chi_square == 0.0


def test_a_covariance_is_widened_by_what_each_error_alone_would_cause() -> None:
    _, _, gain = left_over(np.zeros(4), COVARIANCE)
    errors = (1e-5, -2e-5, 0.0, 3e-5)
    own = gain @ COVARIANCE @ gain.T
    want = own + sum(np.outer(gain[:, i] * e, gain[:, i] * e) for i, e in enumerate(errors))
    np.testing.assert_allclose(widened(own, gain, errors), want, rtol=1e-12, atol=1e-24)


# The reading that is wrong.

NOISE = 1e-6


def dots_of(pose: FloatArray) -> FloatArray:
    """Of a flat plate, m = R(-theta)(l - d) - c."""
    dx, dy, theta = pose
    c, s = math.cos(theta), math.sin(theta)
    u, v = CENTERS[:, 0] - dx, CENTERS[:, 1] - dy
    return np.asarray(np.column_stack((c * u + s * v, c * v - s * u)) - CENTERS).ravel()


def seen(change: Any, blocks: int = 60, size: float = 1.0) -> str:
    """What is said after ``blocks`` poses of some millimetres of which ``change`` alters the readings."""
    rng = np.random.default_rng(5)
    suspect, consistency = Suspect(CENTERS, CENTERS), Consistency()
    for _ in range(blocks):
        readings = change(dots_of(rng.normal(size=3) * (2e-3, 2e-3, 0.02) * size) + rng.normal(size=4) * NOISE)
        apart = (CENTERS + readings.reshape(2, 2))[0] - (CENTERS + readings.reshape(2, 2))[1]
        # r by its definition: how much longer the line between the dots is than that between the beams.
        r = (math.hypot(*apart) - math.hypot(*REST)) / 2**0.5
        a = np.array([*apart, *-apart]) / math.hypot(*apart) / 2**0.5
        checked = consistency.check(tuple(apart.tolist()), tuple((a * r).tolist()), NOISE**2 * np.eye(4))
        suspect.add(tuple(readings.tolist()), checked.errors)
    return suspect.most_likely(NOISE)


def test_what_is_remembered_follows_its_laws_through_any_blocks() -> None:
    """Chi-squares by chance around the limits, of either sign, for a while of one: each law written again."""
    rng = np.random.default_rng(11)
    along = np.array([*REST, *(-c for c in REST)]) / math.hypot(*REST) / 2**0.5
    variance = float(along @ COVARIANCE @ along)
    of, held, mean, lasting = Consistency(), 0.0, 0.0, 0.0
    seen = set()
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
        got = of.check(REST, tuple((along * r).tolist()), COVARIANCE, limit=limit)
        assert got.chi_square == pytest.approx(chi_square, abs=1e-9)
        assert got.contradict == (held > 0.0)
        np.testing.assert_allclose(got.errors, r / along, rtol=1e-9)
        np.testing.assert_allclose(got.possible, root / along, rtol=1e-9)
        np.testing.assert_allclose((of.held, of.mean, of.lasting), (held, mean, lasting), rtol=1e-9, atol=1e-18)
        seen.add((held > 0.0, lasting > 0.0, doubtful))
    assert len(seen) > 5


def named(said: FloatArray, should: FloatArray, noise: float) -> str:
    """Of readings (n, 4) and what they should be: the words, from weighted moments by numpy."""
    n = len(said)
    weights = (1.0 - 1.0 / 500.0) ** np.arange(n - 1, -1, -1)
    if n < 10:
        return ''
    orders = ([0, 1, 2, 3], [1, 0, 2, 3], [0, 1, 3, 2])
    off = []
    for order in orders:
        apart = CENTERS[0] - CENTERS[1] + said[:, order][:, :2] - said[:, order][:, 2:]
        off.append(float(weights @ (np.hypot(*apart.T) - math.hypot(*REST)) ** 2))
    for psd in (1, 2):
        if off[psd] < 0.01 * off[0] and off[psd] < weights.sum() * (10.0 * noise) ** 2:
            return f'the axes of psd_{psd} are exchanged'
    found = []
    for c, name in enumerate(('x1', 'y1', 'x2', 'y2')):
        own, shared, wanted = np.cov(said[:, c], should[:, c], aweights=weights, ddof=0)[[0, 0, 1], [0, 1, 1]]
        if wanted < (100.0 * noise) ** 2:
            continue
        if own < (5.0 * noise) ** 2:
            found.append(f'{name} does not move with the others')
        elif abs(shared / wanted + 1.0) < 0.02 and own - shared**2 / wanted < (10.0 * noise) ** 2 + 1e-4 * wanted:
            found.append(f'{name} has the wrong sign')
    return found[0] if len(found) == 1 else ''


def test_a_reading_is_named_by_the_moments_of_what_was_seen() -> None:
    """Readings around each limit of the rules, a reading or two at a time; axes exchanged more or less exactly."""
    rng = np.random.default_rng(12)
    told: dict[str, int] = {}
    for case in range(500):
        n = int(rng.choice([9, 10, 11, 40]))
        should = rng.normal(size=(n, 4)) * NOISE * 10.0 ** rng.uniform(1.7, 3.0, 4)
        should[:, rng.random(4) < 0.5] *= 1e-3
        said = should.copy()
        for i in rng.choice(4, 1 + case % 2, replace=False):
            slope = rng.choice([0.0, -1.0, -1.0, -1.018, -0.982, -1.022, -0.978, 1.0])
            scatter = NOISE * rng.choice([0.0, 3.0, 4.5, 5.5, 9.0, 11.0]) + rng.choice([0.0, 0.9e-2]) * np.std(
                should[:, i]
            )
            said[:, i] = slope * should[:, i] + scatter * rng.choice([-1.0, 1.0], n) + 1e-4
        suspect = Suspect(CENTERS, CENTERS)
        if case % 3 == 0:
            # Poses of some millimetres whose base line is right but for noise once the axes are put right.
            right = np.array([dots_of(rng.normal(size=3) * (2e-3, 2e-3, 0.02)) for _ in range(n)])
            right[:, 0] += rng.choice([0.0, 5.0, 12.0, 17.0, 30.0]) * NOISE * rng.choice([-1.0, 1.0], n)
            said = right[:, [[0, 1, 2, 3], [1, 0, 2, 3], [0, 1, 3, 2]][int(rng.integers(3))]]
            should = said - 1e-5
        for block in range(n):
            suspect.add(tuple(said[block].tolist()), tuple((said[block] - should[block]).tolist()))
        want = named(said, should, NOISE)
        assert suspect.most_likely(NOISE) == want, case
        told[want] = told.get(want, 0) + 1
    assert len(told) == 11
