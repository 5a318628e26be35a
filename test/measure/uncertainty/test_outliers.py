# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The search for a wrong reading of two PSDs, against weighted moments by numpy."""

from __future__ import annotations

import math

import numpy as np

from psd_deflection.measure.uncertainty.outliers import OutlierSearch
from psd_deflection.records import FloatArray

CENTERS = np.array([[0.0, 0.070], [-0.100, 0.0]])
REST = tuple((CENTERS[0] - CENTERS[1]).tolist())
NOISE = 1e-6


def dots_of(pose: FloatArray) -> FloatArray:
    """Of a flat plate, m = R(-theta)(l - d) - c."""
    dx, dy, theta = pose
    c, s = math.cos(theta), math.sin(theta)
    u, v = CENTERS[:, 0] - dx, CENTERS[:, 1] - dy
    return np.asarray(np.column_stack((c * u + s * v, c * v - s * u)) - CENTERS).ravel()


def named(message: FloatArray, should: FloatArray, noise: float) -> str:
    """Of readings (n, 4) and what they should be: the words, from weighted moments by numpy."""
    n = len(message)
    weights = (1.0 - 1.0 / 500.0) ** np.arange(n - 1, -1, -1)
    if n < 10:
        return ''
    orders = ([0, 1, 2, 3], [1, 0, 2, 3], [0, 1, 3, 2])
    off = []
    for order in orders:
        apart = CENTERS[0] - CENTERS[1] + message[:, order][:, :2] - message[:, order][:, 2:]
        off.append(float(weights @ (np.hypot(*apart.T) - math.hypot(*REST)) ** 2))
    for psd in (1, 2):
        if off[psd] < 0.01 * off[0] and off[psd] < weights.sum() * (10.0 * noise) ** 2:
            return f'the axes of psd_{psd} are exchanged'
    found = []
    for c, name in enumerate(('x1', 'y1', 'x2', 'y2')):
        own, shared, wanted = np.cov(message[:, c], should[:, c], aweights=weights, ddof=0)[[0, 0, 1], [0, 1, 1]]
        if wanted < (100.0 * noise) ** 2:
            continue
        if own < (5.0 * noise) ** 2:
            found.append(f'{name} does not move with the others')
        elif abs(shared / wanted + 1.0) < 0.02 and own - shared**2 / wanted < (10.0 * noise) ** 2 + 1e-4 * wanted:
            found.append(f'{name} has the wrong sign')
    return found[0] if len(found) == 1 else ''


def test_a_reading_is_named_by_the_moments_of_what_was_observed() -> None:
    """Readings around each limit of the rules, a reading or two at a time; axes exchanged more or less exactly."""
    rng = np.random.default_rng(12)
    reported: dict[str, int] = {}
    for case in range(500):
        n = int(rng.choice([9, 10, 11, 40]))
        should = rng.normal(size=(n, 4)) * NOISE * 10.0 ** rng.uniform(1.7, 3.0, 4)
        should[:, rng.random(4) < 0.5] *= 1e-3
        message = should.copy()
        for i in rng.choice(4, 1 + case % 2, replace=False):
            slope = rng.choice([0.0, -1.0, -1.0, -1.018, -0.982, -1.022, -0.978, 1.0])
            scatter = NOISE * rng.choice([0.0, 3.0, 4.5, 5.5, 9.0, 11.0]) + rng.choice([0.0, 0.9e-2]) * np.std(
                should[:, i]
            )
            message[:, i] = slope * should[:, i] + scatter * rng.choice([-1.0, 1.0], n) + 1e-4
        search = OutlierSearch(CENTERS, CENTERS)
        if case % 3 == 0:
            # Poses of some millimetres whose base line is right but for noise once the axes are put right.
            right = np.array([dots_of(rng.normal(size=3) * (2e-3, 2e-3, 0.02)) for _ in range(n)])
            right[:, 0] += rng.choice([0.0, 5.0, 12.0, 17.0, 30.0]) * NOISE * rng.choice([-1.0, 1.0], n)
            message = right[:, [[0, 1, 2, 3], [1, 0, 2, 3], [0, 1, 3, 2]][int(rng.integers(3))]]
            should = message - 1e-5
        for block in range(n):
            search.add(tuple(message[block].tolist()), tuple((message[block] - should[block]).tolist()))
        want = named(message, should, NOISE)
        assert search.most_likely(NOISE) == want, case
        reported[want] = reported.get(want, 0) + 1
    assert len(reported) == 11
