# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reading too many, against generalised least squares with dense matrices of numpy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from psd_deflection.measure.uncertainty.consistency import Consistency, Suspect, widened
from psd_deflection.measure.uncertainty.stamped import StampedDots
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import rig_from_values

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


def test_a_contradiction_is_held_and_forgotten_by_a_fiftieth_a_block() -> None:
    of = Consistency()
    first = check(scaled_to(60.0), of)
    assert first.contradict
    blocks = 0
    while (got := check(np.zeros(4), of)).contradict:
        blocks += 1
        assert got.chi_square == pytest.approx(0.0, abs=1e-9)
        assert np.abs(got.possible) == pytest.approx(np.abs(first.possible) * 0.98 ** (blocks / 2.0))
    # 60 falls to 25.
    assert blocks == math.floor(math.log(2.4) / -math.log(0.98))
    assert of.held == 0.0
    assert got.possible == (0.0, 0.0, 0.0, 0.0)


def test_an_error_that_lasts_is_widened_for_though_no_block_alone_shows_it() -> None:
    """Two sd in every block; not one, and not hum of the worst constant phase, which its own variance explains."""
    small, hum, large = (scaled_to(chi_square) for chi_square in (1.0, 2.0, 4.0))
    for readings, widens in ((small, False), (hum, False), (large, True)):
        of = Consistency()
        got = [check(readings, of) for _ in range(60)]
        assert not any(c.contradict for c in got)
        assert not any(got[0].possible)
        assert all(any(c.possible) == widens for c in got[20:])
    # By half as much again as the error of each reading.
    np.testing.assert_allclose(np.abs(got[-1].possible), 1.5 * np.abs(got[-1].errors), rtol=1e-2)
    # What was wrong and is not any more is forgotten in about a second.
    after = [check(0.0 * large, of) for _ in range(120)]
    assert any(after[10].possible)
    assert not any(after[-1].possible)


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


def with_(i: int, law: Any) -> Any:
    def change(readings: FloatArray) -> FloatArray:
        out = readings.copy()
        out[i] = law(out[i])
        return out

    return change


@pytest.mark.parametrize('name', ['x1', 'y1', 'x2', 'y2'])
def test_a_reading_that_stands_still_or_is_inverted_is_named(name: str) -> None:
    i = ('x1', 'y1', 'x2', 'y2').index(name)
    assert seen(with_(i, lambda _: 3e-4)) == f'{name} does not move with the others'
    assert seen(with_(i, lambda v: -v), size=0.2) == f'{name} has the wrong sign'
    # Too little to tell: few blocks, small motion.
    assert seen(with_(i, lambda _: 3e-4), blocks=9) == ''
    assert seen(with_(i, lambda _: 3e-4), size=0.02) == ''
    # Neither law: half as large.
    assert seen(with_(i, lambda v: 0.5 * v)) == ''


@pytest.mark.parametrize(('psd', 'order'), [(1, [1, 0, 2, 3]), (2, [0, 1, 3, 2])])
def test_exchanged_axes_are_named(psd: int, order: list[int]) -> None:
    assert seen(lambda r: r[order]) == f'the axes of psd_{psd} are exchanged'


@pytest.mark.parametrize(('scatter', 'said'), [(0.005, 'y1 has the wrong sign'), (0.1, '')])
def test_a_sign_is_wrong_if_nothing_but_the_sign_is(scatter: float, said: str) -> None:
    """What is left of an inverted reading must be below a hundredth of its motion, or be noise."""
    suspect = Suspect(CENTERS, CENTERS)
    for block in range(60):
        should = 4e-4 * (-1.0) ** block
        reads = -should + scatter * 4e-4 * (-1.0) ** (block // 2)
        suspect.add((0.0, reads, 0.0, 0.0), (0.0, reads - should, 0.0, 0.0))
    assert suspect.most_likely(NOISE) == said


def test_a_base_line_may_lie_along_any_direction() -> None:
    residual = (1e-6, -2e-6, 3e-6, 4e-6)
    for x, y in ((0.14, 0.05), (0.05, 0.14), (-0.05, 0.14), (0.0, -0.1)):
        along = np.array([x, y, -x, -y]) / math.hypot(x, y) / 2**0.5
        r = float(along @ residual)
        got = Consistency().check((x, y), residual, COVARIANCE)
        assert got.chi_square == pytest.approx(r * r / float(along @ COVARIANCE @ along), rel=1e-9)
        want = [r / a if abs(a) > 0.02 else 0.0 for a in along]
        assert got.errors == pytest.approx(want)


def test_sound_readings_are_not_accused() -> None:
    assert seen(lambda r: r) == ''


def test_the_p_is_that_of_the_chi_square() -> None:
    """One degree of freedom: 3.84 is the 5 % point, 6.63 the 1 % point."""
    stamped = StampedDots(rig_from_values({}), flat=True)
    for chi_square, p in ((0.0, '1'), (3.8415, '0.05'), (6.6349, '0.01')):
        stamped.chi_square = chi_square
        assert dict(stamped.words())['p of that chi-square'] == p


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


def test_what_was_seen_is_forgotten_by_a_five_hundredth_a_block() -> None:
    """A reading that stands still for 500 blocks and follows for 1500: weights, moments and base lines by numpy."""
    rng = np.random.default_rng(13)
    suspect = Suspect(CENTERS, CENTERS)
    places = 4e-4 * rng.normal(size=2000)
    for block, place in enumerate(places.tolist()):
        # Of y1 what is read: at first nothing.
        read = place if block >= 500 else 0.0
        suspect.add((0.0, read, 0.0, 0.0), (0.0, read - place, 0.0, 0.0))
    weights = (1.0 - 1.0 / 500.0) ** np.arange(1999, -1, -1)
    assert suspect._weight == pytest.approx(weights.sum(), rel=1e-12)
    np.testing.assert_allclose(suspect._sum[5], weights @ (places - places[0]), rtol=1e-9)
    np.testing.assert_allclose(suspect._squares[2, 1], weights @ (places - places[0]) ** 2, rtol=1e-9)
    read = np.where(np.arange(2000) < 500, 0.0, places)
    apart = np.hypot(REST[0], REST[1] + read)
    assert suspect._swapped[0] == pytest.approx(weights @ (apart - math.hypot(*REST)) ** 2, rel=1e-9)
