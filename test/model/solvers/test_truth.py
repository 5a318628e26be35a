# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pose, covariance, residual and gain of the smooth methods against weighted least squares written with numpy.

The model is that of ``rays`` in space, its derivatives are differences, and the normal equations are dense.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate import Geometry
from psd_deflection.model.solvers import SolverStatus, make_solver
from psd_deflection.model.solvers.subset import OnePsd
from psd_deflection.rig.config import load_rig

Array = np.ndarray[Any, Any]
TWO = Geometry(np.array([[0.0, 0.07], [-0.1, 0.01]]), np.array([[3e-4, -2e-4], [1e-4, 5e-4]]), np.zeros(2), 0.585)
THREE = Geometry(
    np.array([[0.1, 0.0], [-0.05, 0.087], [-0.04, -0.087]]), np.full((3, 2), 2e-4), np.array([0.1, -0.05, -0.04]), 0.585
)
FLAT_THREE = Geometry(THREE.centers, THREE.zeros, np.zeros(3), 0.585)
RAISED = Geometry(TWO.centers, TWO.zeros, np.array([0.02, -0.03]), 0.585, 1.4)
VARIANCES = (4e-12, 1e-12, 9e-12, 2e-12, 3e-12, 6e-12)


def least_squares(model: Callable[[Array], Array], dots: Array, variances: Array, unknowns: int) -> tuple[Array, ...]:
    """Pose, covariance, residual and gain at the minimum of the weighted squares."""
    x = np.zeros(unknowns)
    for _ in range(8):
        columns = []
        for i in range(unknowns):
            step = np.zeros(unknowns)
            step[i] = 1e-5
            columns.append((model(x + step) - model(x - step)) / 2e-5)
        jacobian = np.stack(columns, axis=1)
        weighted = jacobian.T / variances
        covariance = np.linalg.inv(weighted @ jacobian)
        gain = covariance @ weighted
        residual = dots - model(x)
        x = x + gain @ residual
    return x, covariance, dots - model(x), gain


def flat(rays: Any, geometry: Geometry) -> Callable[[Array], Array]:
    return lambda x: np.asarray(rays.tip_dots(geometry, (*x, 0.0, 0.0)))


def tied(rays: Any, geometry: Geometry) -> Callable[[Array], Array]:
    k = geometry.slope_ratio / geometry.link_length
    return lambda x: np.asarray(rays.tip_dots(geometry, (*x, -k * x[1], k * x[0])))


def free(rays: Any, geometry: Geometry) -> Callable[[Array], Array]:
    return lambda x: np.asarray(rays.tip_dots(geometry, tuple(x)))


def linear(rays: Any, geometry: Geometry) -> Callable[[Array], Array]:
    """m_0 + A x: of a small motion each dot goes back by (dX, dY), and by theta across its place."""

    def model(x: Array) -> Array:
        dots = [(-x[0] + x[2] * ly, -x[1] - x[2] * lx) for lx, ly in geometry.beams]
        return np.array(dots).ravel() + geometry.zeros.ravel()

    return model


@pytest.mark.parametrize(
    ('method', 'geometry', 'model', 'unknowns', 'gain_within'),
    [
        *(('exact', TWO, flat, 3, 1e-3), ('exact', FLAT_THREE, flat, 3, 1e-3), ('beam', TWO, tied, 3, 2e-2)),
        *(('beam', RAISED, tied, 3, 1.0), ('pose', THREE, free, 5, 1e-3), ('wls', TWO, linear, 3, 1e-6)),
        ('wls', FLAT_THREE, linear, 3, 1e-6),
    ],
)
def test_a_method_is_weighted_least_squares_of_its_model(
    rays: Any, method: str, geometry: Geometry, model: Any, unknowns: int, gain_within: float
) -> None:
    solver, of = make_solver(method, geometry), model(rays, geometry)
    variances = np.array(VARIANCES[: 2 * len(geometry.centers)])
    rng = np.random.default_rng(3)
    for _ in range(3):
        pose = rng.uniform(-1, 1, unknowns) * (0.004, 0.004, 0.05, 0.01, 0.01)[:unknowns]
        dots = of(pose) + rng.normal(size=len(variances)) * 5e-6
        got = solver.solve(tuple(dots.tolist()), tuple(variances.tolist()))
        x, covariance, residual, gain = least_squares(of, dots, variances, unknowns)
        assert got.status is SolverStatus.OK
        # To where the bend of the model moves the minimum off that of its differences.
        assert got[:3] == pytest.approx(x[:3], abs=2e-9)
        sd = np.sqrt(np.diag(covariance)[:3])
        stated = np.reshape(got.covariance, (3, 3))
        np.testing.assert_allclose(stated / np.outer(sd, sd), covariance[:3, :3] / np.outer(sd, sd), atol=2e-3)
        np.testing.assert_allclose(got.residual, residual, atol=2e-9)
        stated_gain = solver.gain(tuple(dots.tolist()), tuple(variances.tolist()), got)
        size = np.abs(gain[:3]).max(axis=1, keepdims=True)
        np.testing.assert_allclose(stated_gain / size, gain[:3] / size, atol=gain_within)


@pytest.mark.parametrize(('deviations', 'status'), [(2.9, SolverStatus.OK), (3.1, SolverStatus.INADMISSIBLE)])
def test_base_line_is_too_short_from_three_deviations(deviations: float, status: SolverStatus) -> None:
    """On a base line along x it varies as the two x readings do together."""
    geometry = Geometry(np.array([[0.1, 0.0], [-0.1, 0.0]]), np.zeros((2, 2)), np.zeros(2), 0.585)
    short = deviations * float(np.sqrt(VARIANCES[0] + VARIANCES[2]))
    got = make_solver('minimum_tilt', geometry).solve((-short, 0.0, 0.0, 0.0), VARIANCES[:4])
    assert got.status is status


@pytest.mark.parametrize(('k', 'taken'), [(-0.9995, False), (-0.9985, True), (-1.0005, False), (-1.0015, True)])
def test_surface_cancelling_deflection_is_rejected(k: float, taken: bool) -> None:
    """1 + k h/L below a thousandth."""
    geometry = Geometry(TWO.centers, TWO.zeros, np.array([0.585, 0.0]), 0.585, k)
    if taken:
        make_solver('beam', geometry)
    else:
        with pytest.raises(SolverError, match='the deflection cannot be seen'):
            make_solver('beam', geometry)


@pytest.mark.parametrize('psd', [0, 1])
@pytest.mark.parametrize('theta_sd', [0.0, 1e-4])
def test_covariance_is_rotated_reading_plus_twist(psd: int, theta_sd: float) -> None:
    geometry = Geometry.from_rig(load_rig())
    dot, variances, theta = np.array([2e-3, -3e-3]), np.array([4e-12, 1e-12]), 0.7
    c, s = np.cos(theta), np.sin(theta)
    rotation, slope = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
    gain = -slope @ (geometry.centers[psd] + dot)
    wanted = np.zeros((3, 3))
    wanted[:2, :2] = rotation @ np.diag(variances) @ rotation.T
    full = np.append(gain, 1.0)
    wanted += theta_sd**2 * np.outer(full, full)
    dx, dy, covariance = OnePsd(geometry).solve(psd, (2e-3, -3e-3), (4e-12, 1e-12), theta, theta_sd**2)
    np.testing.assert_allclose(np.reshape(covariance, (3, 3)), wanted, rtol=1e-9, atol=1e-24)
    np.testing.assert_allclose((dx, dy), geometry.beams[psd] - rotation @ (geometry.centers[psd] + dot), atol=1e-15)
