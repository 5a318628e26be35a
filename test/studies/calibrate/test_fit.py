# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The fit's own pieces against a minimiser that is not ours."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.optimize import minimize

from blind import misaligned
from psd_deflection.model.misalignment.rig import vector_of_rig
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import rig_from_values
from psd_deflection.studies.calibrate.fit import (
    CLAMP_AT,
    SIZE,
    Kind,
    Linear,
    Noise,
    pose_of_readings,
    prior_of_rig,
    variance_components,
    weight_matrices,
)


def test_a_noisy_reading_weighs_less_in_the_pose() -> None:
    """The pose has the least sum of squares, each reading over its own variance: no other pose is as likely."""
    rig = rig_from_values({})
    p, length = vector_of_rig(rig).values, rig.link.length
    rng = np.random.default_rng(2)
    true = rng.uniform(-1.0, 1.0, (3, 3)) * (1e-3, 1e-3, 5e-3)
    sd = np.array([2e-6, 20e-6, 8e-6, 1e-6]) * rng.uniform(0.5, 2.0, (3, 4))
    dots = misaligned.dots(misaligned.nominal(), true) + sd * rng.normal(size=sd.shape)
    found = pose_of_readings(dots, sd**2, p, length)

    def misfit(pose: FloatArray, row: int) -> float:
        residual = (dots[row] - misaligned.dots(misaligned.nominal(), pose[None])[0]) / sd[row]
        return float(residual @ residual)

    for row, pose in enumerate(found):

        def of(x: FloatArray, pose: FloatArray = pose, row: int = row) -> float:
            return misfit(pose + x * (1e-6, 1e-6, 1e-5), row)

        best = minimize(of, np.zeros(3), method='Nelder-Mead', options={'xatol': 1e-4, 'fatol': 1e-9})
        np.testing.assert_allclose(best.x, 0.0, atol=0.02)
        assert misfit(pose, row) == pytest.approx(best.fun, abs=1e-3)


def test_clamp_prior_is_a_fifth_of_link_compliance() -> None:
    """In the deflection by a tip force, L^3/3EI, and in the twist by a moment, L/GJ."""
    rig = rig_from_values({})
    bends, twists = prior_of_rig(rig).sd[CLAMP_AT : CLAMP_AT + 2]
    length = rig.link.length
    assert bends * length**2 == pytest.approx(0.2 * length**3 / (3.0 * rig.link.bending_stiffness))
    assert twists == pytest.approx(0.2 * length / rig.link.torsional_stiffness)


def test_rows_that_are_worth_fewer_weigh_less() -> None:
    rng = np.random.default_rng(4)
    rows = cast(Any, SimpleNamespace(sd=np.ones((5, 3)), variances=rng.uniform(1.0, 2.0, (5, 4)) * 1e-12))
    linear = Linear(np.zeros((5, 4)), np.zeros((5, 4, 2)), rng.normal(size=(5, 4, 3)))
    noise = Noise(np.array([1e-6, 2e-6, 3e-6]), 1.5)
    each = weight_matrices(linear, rows, noise)
    covariance = linear.pose_slopes[2] @ np.diag(noise.reference**2) @ linear.pose_slopes[2].T
    np.testing.assert_allclose(each[2], np.linalg.inv(covariance + np.diag(1.5**2 * rows.variances[2])), rtol=1e-9)
    np.testing.assert_allclose(weight_matrices(linear, rows, replace(noise, fewer=4.0)), each / 4.0, rtol=1e-12)


@pytest.mark.parametrize('kind', ['reference', 'loads', 'self'])
@pytest.mark.parametrize(('share', 'reported'), [(0.0, 0.3), (0.2, 0.3), (0.4, 0.4), (2.0, 2.0)])
def test_dots_are_believed_up_to_three_tenths_of_their_noise(kind: Kind, share: float, reported: float) -> None:
    """The redundant reading has ``share`` of the noise that is stated, of either sign; nothing was fitted."""
    rng = np.random.default_rng(6)
    n, sd = 200, 3e-6
    by_pose = rng.normal(size=(n, 4, 3))
    # The direction that no pose reaches, by cofactors.
    across = np.array([[(-1) ** i * np.linalg.det(np.delete(m, i, axis=0)) for i in range(4)] for m in by_pose])
    across /= np.linalg.norm(across, axis=1)[:, None]
    moved = np.einsum('nij,nj->ni', by_pose, rng.normal(size=(n, 3)) * 1e-4)
    residual = moved + share * sd * rng.choice([-1.0, 1.0], n)[:, None] * across
    rows = cast(
        Any,
        SimpleNamespace(sd=np.ones((n, 3)), variances=np.full((n, 4), sd**2), run=np.zeros(n, dtype=np.int64)),
    )
    linear = Linear(residual, np.zeros((n, 4, SIZE)), by_pose)
    prior = prior_of_rig(rig_from_values({}))
    found = variance_components(linear, rows, np.ones(n), kind, 1, np.zeros((SIZE, SIZE)), prior)
    assert found.dots == pytest.approx(reported)
