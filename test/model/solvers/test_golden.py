# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every method, and the simulator that judges them, against the golden answers."""

from typing import Any

import numpy as np
import pytest

from psd_deflection.model.solvers import SolverStatus, make_solver
from psd_deflection.studies.thesis.appendix_d import appendix_d_iterative

CASES = [f'G{i}' for i in range(1, 13)]
PARALLEL_BEAMS = CASES[:11]
EQUAL = (4e-12,) * 4
SIDEBAR = (0.03, 0.5, 10.0, 0.1)
DIRECT = (3.0, 0.5, 10.0, 0.1)
METHODS: list[tuple[str, dict[str, Any], str]] = [
    ('exact', {}, 'procrustes'),
    ('exact', {}, 'planar_gn_k0'),
    ('iterative', {}, 'procrustes'),
    ('ols', {}, 'ols'),
    ('wls', {}, 'ols'),
    ('wls', {'weights': 'thesis'}, 'wls_sidebar'),
    ('wls', {'weights': 'thesis', 'row_scaling': SIDEBAR}, 'wls_sidebar'),
    ('wls', {'weights': 'thesis', 'row_scaling': DIRECT}, 'wls_direct'),
    ('minimum_tilt', {'angles': 'azimuth'}, 'min_tilt'),
    ('beam', {}, 'beam_gn_k1.5'),
    ('iterative_printed', {}, 'iter_22_printed'),
    ('iterative_printed', {'criterion': 'absolute'}, 'iter_22_abs'),
    ('iterative_printed', {'criterion': 'argmin'}, 'iter_22_argmin'),
]
# The source's own code counts its angle clockwise.
RAW_METHODS: list[tuple[str, dict[str, Any], str]] = [
    ('appendix_d_ols', {}, 'ols_code_raw'),
    ('appendix_d_wls', {}, 'wls_code_sidebar_raw'),
    ('appendix_d_wls', {'row_scaling': DIRECT}, 'wls_code_direct_raw'),
]


def check(golden: Any, case: str, method: str, options: dict[str, Any], want: Any) -> None:
    solver = make_solver(method, golden.geometry(case), **options)
    dots = golden.dots(case)
    solution = solver.solve(dots, EQUAL)
    many = solver.solve_many(np.array([dots, dots]), np.array(EQUAL))
    assert solution.status is SolverStatus.OK
    np.testing.assert_allclose([solution.dx, solution.dy, solution.theta], want, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(many.pose, [want, want], rtol=0.0, atol=1e-9)
    assert many.status.tolist() == [0, 0]


@pytest.mark.parametrize('case', CASES)
@pytest.mark.parametrize(('method', 'options', 'key'), METHODS)
def test_pose(golden: Any, case: str, method: str, options: dict[str, Any], key: str) -> None:
    check(golden, case, method, options, golden.cases[case][key])


@pytest.mark.parametrize('case', CASES)
@pytest.mark.parametrize(('method', 'options', 'key'), RAW_METHODS)
def test_the_sources_own_least_squares(golden: Any, case: str, method: str, options: dict[str, Any], key: str) -> None:
    dx, dy, clockwise = golden.cases[case][key]
    check(golden, case, method, options, [dx, dy, -clockwise])


@pytest.mark.parametrize('case', CASES)
def test_appendix_d_branch_and_all(golden: Any, case: str) -> None:
    geometry = golden.geometry(case)
    dots = golden.dots(case)
    got = appendix_d_iterative(tuple(1e3 * m for m in dots), tuple((1e3 * geometry.zeros).ravel().tolist()))
    want = golden.cases[case]['appD_raw_mm_deg_cw']
    assert (got.branch, got.angle_of_twist) == (golden.cases[case]['appD_branch'], want[2])
    np.testing.assert_allclose(got[:3], want, rtol=0.0, atol=1e-9)
    solver = make_solver('appendix_d', geometry)
    solution = solver.solve(dots, EQUAL)
    many = solver.solve_many(np.array([dots]), np.array(EQUAL))
    pose = np.array(want) * (1e-3, 1e-3, -np.pi / 180.0)
    np.testing.assert_allclose(solution[:3], pose, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(many.pose[0], pose, rtol=0.0, atol=1e-12)
    hit = SolverStatus.NO_HIT if got.branch == 'none' else SolverStatus.OK
    assert solution.status is hit
    assert many.status[0] == hit


@pytest.mark.parametrize('case', PARALLEL_BEAMS)
def test_readings_of_the_simulator(golden: Any, rays: Any, case: str) -> None:
    dx, dy, dz, theta, phi, omega = golden.cases[case]['pose']
    got = rays.tip_dots(golden.geometry(case), (dx, dy, theta, phi, omega), lift=dz)
    np.testing.assert_allclose(got, golden.dots(case), rtol=0.0, atol=1e-15)


def test_readings_of_the_simulator_with_all_effects(golden: Any, rays: Any) -> None:
    dx, dy, dz, theta, phi, omega = golden.cases['G12']['pose']
    geometry = golden.geometry('G12')
    geometry.heights[:] = 0.020
    got = rays.tip_dots(
        geometry,
        (dx, dy, theta, phi, omega),
        lift=dz,
        directions=np.array([[np.tan(np.radians(1.0)), 0.0, 1.0], [0.0, -np.tan(np.radians(0.5)), 1.0]]),
        rolls=np.radians([1.0, -0.5]).tolist(),
        gains=np.array([[1.01, 1.0], [1.0, 0.98]]),
    )
    np.testing.assert_allclose(got, golden.dots('G12'), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize('case', CASES)
def test_minimum_tilt(golden: Any, case: str) -> None:
    solution = make_solver('minimum_tilt', golden.geometry(case)).solve(golden.dots(case), EQUAL)
    beta = np.arccos(np.cos(solution.phi) * np.cos(solution.omega))
    want = golden.cases[case]['min_tilt_beta']
    # An arccosine near 1 turns the last digit of a length into 1.5e-8 rad.
    assert abs(beta - want) < (1e-9 if want > 1e-6 else 3e-8)


def test_covariance_of_beam(golden: Any) -> None:
    solver = make_solver('beam', golden.geometry('G5'))
    solution = solver.solve(golden.dots('G5'), EQUAL)
    want = golden.constants['cov_beam_G5_2um']
    np.testing.assert_allclose(np.reshape(solution.covariance, (3, 3)), want, rtol=1e-8)


@pytest.mark.parametrize('theta_deg', [0.5, 1.0, 2.0, 3.0])
@pytest.mark.parametrize('d', [(0.0, 0.0), (2e-3, -2e-3), (5e-3, -5e-3)])
def test_what_linearising_costs_and_how_it_is_undone(
    golden: Any, rays: Any, theta_deg: float, d: tuple[float, float]
) -> None:
    """ols gives sin theta and R(-theta) d + (1 - cos theta) lbar, lbar = (-50, 35) mm; to 1e-13."""
    geometry = golden.geometry()
    theta = np.radians(theta_deg)
    dots = tuple(rays.tip_dots(geometry, (*d, theta, 0.0, 0.0)).tolist())
    c, s = np.cos(theta), np.sin(theta)
    rotated = np.array([[c, s], [-s, c]]) @ d + (1.0 - c) * np.array([-0.050, 0.035])
    np.testing.assert_allclose(make_solver('ols', geometry).solve(dots, EQUAL)[:3], [*rotated, s], atol=1e-13)
    for options in ({}, {'weights': 'thesis'}):
        exact = make_solver('wls_exact', geometry, **options).solve(dots, EQUAL)
        np.testing.assert_allclose(exact[:3], [*d, theta], rtol=0.0, atol=1e-13)
