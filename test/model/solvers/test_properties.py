# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Any pose in range comes back, through a simulator that shares no code; turning the rig turns the answer."""

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psd_deflection.model.plate import Geometry
from psd_deflection.model.solvers import SolverStatus, make_solver

L = 0.585
ISOTROPIC = (4e-12, 4e-12, 1e-12, 1e-12)
UNEQUAL = (4e-12, 1e-12, 9e-12, 2e-12)
many = settings(deadline=None, max_examples=60)


def within(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit, allow_nan=False)


poses = st.tuples(within(5e-3), within(5e-3), within(np.radians(3.0)))
tilts = st.tuples(within(np.radians(1.0)), within(np.radians(1.0)))
places = st.tuples(within(0.15), within(0.15))


@st.composite
def two_psds(draw: st.DrawFn) -> Geometry:
    centers = np.array([draw(places), draw(places)])
    assume(np.hypot(*(centers[0] - centers[1])) > 0.02)
    zeros = np.array([[draw(within(1e-3)) for _ in range(2)] for _ in range(2)])
    return Geometry(centers, zeros, np.zeros(2), L, draw(st.floats(1.0, 2.0)))


def close(got: Any, want: Any) -> None:
    np.testing.assert_allclose(np.array(got, dtype=float), np.array(want, dtype=float), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize('variances', [ISOTROPIC, UNEQUAL])
@pytest.mark.parametrize(
    ('method', 'options'),
    [('exact', {}), ('wls_exact', {}), ('wls_exact', {'weights': 'thesis'}), ('iterative', {}), ('minimum_tilt', {})],
)
@many
@given(geometry=two_psds(), pose=poses)
def test_a_flat_pose_comes_back(
    rays: Any, method: str, options: dict[str, Any], variances: tuple[float, ...], geometry: Geometry, pose: Any
) -> None:
    dots = rays.tip_dots(geometry, (*pose, 0.0, 0.0))
    solver = make_solver(method, geometry, **options)
    solution = solver.solve(tuple(dots.tolist()), variances)
    # The thesis's weights of rigs that they were not made for can be near singular: digits go with that.
    digits = 1.0 if options == {} else 10.0
    np.testing.assert_allclose(solution[:3], pose, rtol=0.0, atol=1e-9 * digits)
    np.testing.assert_allclose(solver.solve_many(dots[None], np.array(variances)).pose[0], pose, atol=1e-9 * digits)
    assert solution.status is SolverStatus.OK


@pytest.mark.parametrize('method', ['ols', 'wls'])
@many
@given(geometry=two_psds(), pose=poses)
def test_a_linear_answer_is_good_to_the_square_of_the_motion(
    rays: Any, method: str, geometry: Geometry, pose: Any
) -> None:
    """Shrink the motion a hundredfold and the error shrinks ten-thousandfold."""
    small = 0.01 * np.array(pose)
    dots = rays.tip_dots(geometry, (*small, 0.0, 0.0))
    got = make_solver(method, geometry).solve(tuple(dots.tolist()), UNEQUAL)
    size = float(np.hypot(pose[0], pose[1])) * abs(pose[2]) + pose[2] ** 2 * 0.25
    assert np.hypot(got.dx - small[0], got.dy - small[1]) <= 1e-4 * 3.0 * size + 1e-14
    assert abs(got.theta - small[2]) <= 1e-4 * 3.0 * pose[2] ** 2 * 12.5 + 1e-13


@many
@given(geometry=two_psds(), pose=poses, heights=st.tuples(within(0.1), within(0.1)))
def test_a_cantilevers_pose_comes_back_with_its_tilts(
    rays: Any, geometry: Geometry, pose: Any, heights: tuple[float, float]
) -> None:
    geometry.heights[:] = heights
    tie = geometry.slope_ratio / L
    tilt = (-tie * pose[1], tie * pose[0])
    dots = rays.tip_dots(geometry, (*pose, *tilt))
    solution = make_solver('beam', geometry).solve(tuple(dots.tolist()), UNEQUAL)
    close(solution[:5], (*pose, *tilt))
    assert solution.status is SolverStatus.OK
    assert solution.iterations <= 6


@many
@given(pose=poses, tilt=tilts, distance=st.floats(0.05, 0.15), step=st.floats(0.02, 0.1))
def test_three_staggered_psds_see_the_tilts(rays: Any, pose: Any, tilt: Any, distance: float, step: float) -> None:
    angles = np.radians([0.0, 120.0, 240.0])
    centers = distance * np.column_stack((np.cos(angles), np.sin(angles)))
    geometry = Geometry(centers, np.full((3, 2), 1e-4), np.array([step, -step, -step / 2]), L)
    dots = rays.tip_dots(geometry, (*pose, *tilt))
    variances = (*UNEQUAL, 3e-12, 5e-12)
    solver = make_solver('pose', geometry)
    solution = solver.solve(tuple(dots.tolist()), variances)
    close(solution[:5], (*pose, *tilt))
    all_at_once = solver.solve_many(dots[None], np.array(variances))
    close([*all_at_once.pose[0], *all_at_once.tilt[0]], (*pose, *tilt))


@many
@given(pose=poses, tilt=tilts, planes=st.tuples(st.floats(0.3, 0.45), st.floats(0.5, 0.6)))
def test_two_planes_at_the_base_see_tilts_without_twist(rays: Any, pose: Any, tilt: Any, planes: Any) -> None:
    geometry = Geometry(np.array([[0.0, 0.07], [-0.1, 0.0]]), np.full((2, 2), 1e-4), -np.array(planes), L)
    dots = rays.base_dots(geometry, (pose[0], pose[1], 0.0, *tilt))
    solution = make_solver('base_pair', geometry, assume='no_twist').solve(tuple(dots.tolist()), UNEQUAL)
    close(solution[:5], (pose[0], pose[1], 0.0, *tilt))


@many
@given(pose=poses, planes=st.tuples(st.floats(0.3, 0.6), st.floats(0.3, 0.6)), k=st.floats(1.2, 1.3))
def test_the_base_pair_sees_twist_when_the_link_is_a_beam(rays: Any, pose: Any, planes: Any, k: float) -> None:
    geometry = Geometry(np.array([[0.0, 0.07], [-0.1, 0.0]]), np.zeros((2, 2)), -np.array(planes), L, k)
    gain = 1.0 - k * np.array(planes) / L
    assume(np.abs(gain).max() > 0.1)
    tilt = (-k * pose[1] / L, k * pose[0] / L)
    dots = rays.base_dots(geometry, (*pose, *tilt))
    solution = make_solver('base_pair', geometry).solve(tuple(dots.tolist()), UNEQUAL)
    close(solution[:5], (*pose, *tilt))


def test_section_5_3_in_numbers(rays: Any) -> None:
    """L_1 = 585, L_2 = 485 mm, dY = 2 mm, k = 1.5: dots, and what 5.4-5.7 make of them (thesis 5.3)."""
    geometry = Geometry(np.array([[0.0, 0.07], [-0.1, 0.0]]), np.zeros((2, 2)), np.array([-0.585, -0.485]), L)

    def linear(pose: tuple[float, ...]) -> tuple[float, float, float]:
        (x1, y1), (x2, y2) = rays.base_dots(geometry, pose).reshape(2, 2).tolist()
        slope_x, slope_y = (x2 - x1) / 0.1, (y2 - y1) / 0.1
        return x1 + 0.585 * slope_x, y1 + 0.585 * slope_y, slope_y

    dots = rays.base_dots(geometry, (0.0, 2e-3, 0.0, -1.5 * 2e-3 / L, 0.0))
    np.testing.assert_allclose(dots[1::2], [-0.999105842e-3, -0.487201290e-3], rtol=0.0, atol=1e-12)
    _, dy, slope = linear((0.0, 2e-3, 0.0, -1.5 * 2e-3 / L, 0.0))
    np.testing.assert_allclose([dy, slope], [1.995535783e-3, 0.005119045512], rtol=0.0, atol=1e-12)
    tilt = (1.5 * 2e-3 / L, 1.5 * 1e-3 / L)
    for theta, want in ((0.0, (0.99808, -1.99677)), (0.1, (1.59151, -3.01729)), (1.0, (7.01229, -12.15493))):
        dx, dy, _ = linear((1e-3, -2e-3, np.radians(theta), *tilt))
        np.testing.assert_allclose([1e3 * dx, 1e3 * dy], want, rtol=0.0, atol=6e-6)


def rotated(geometry: Geometry, matrix: Any) -> Geometry:
    return Geometry(
        geometry.centers @ matrix.T,
        geometry.zeros @ matrix.T,
        geometry.heights,
        geometry.link_length,
        geometry.slope_ratio,
    )


@pytest.mark.parametrize('method', ['exact', 'wls', 'wls_exact', 'ols', 'iterative', 'minimum_tilt'])
@many
@given(geometry=two_psds(), pose=poses, noise=st.tuples(*[within(2e-5)] * 4), angle=within(3.2), flip=st.booleans())
def test_turning_or_mirroring_the_rig_does_so_to_the_answer(
    rays: Any, method: str, geometry: Geometry, pose: Any, noise: Any, angle: float, flip: bool
) -> None:
    dots = rays.tip_dots(geometry, (*pose, 0.0, 0.0)) + noise
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if flip else 1.0, 1.0])
    # The angles of one rotation turn with it as a whole, not one by one.
    options = {'angles': 'azimuth'} if method == 'minimum_tilt' else {}
    here = make_solver(method, geometry, **options).solve(tuple(dots.tolist()), ISOTROPIC)
    there_dots = (dots.reshape(-1, 2) @ matrix.T).ravel()
    there = make_solver(method, rotated(geometry, matrix), **options).solve(tuple(there_dots.tolist()), ISOTROPIC)
    np.testing.assert_allclose(there[:2], matrix @ here[:2], rtol=0.0, atol=1e-9)
    assert there.theta == pytest.approx(-here.theta if flip else here.theta, abs=1e-9)
    if (here.phi == here.omega == 0.0) != (there.phi == there.omega == 0.0):
        # minimum_tilt, on the very edge between a tilt and none: rounding decides which covariance it has.
        return
    full = np.eye(3)
    full[:2, :2] = matrix
    full[2, 2] = np.linalg.det(matrix)
    want = full @ np.reshape(here.covariance, (3, 3)) @ full.T
    scale = np.sqrt(np.diag(want))
    np.testing.assert_allclose(
        np.reshape(there.covariance, (3, 3)) / np.outer(scale, scale), want / np.outer(scale, scale), atol=1e-6
    )


@many
@given(geometry=two_psds(), pose=poses, noise=st.tuples(*[within(2e-5)] * 4), flip=st.booleans())
def test_a_half_turn_and_a_mirror_of_the_beams_rig(
    rays: Any, geometry: Geometry, pose: Any, noise: Any, flip: bool
) -> None:
    """Tilts in the order Ry Rx keep their form under these two alone."""
    dots = rays.tip_dots(geometry, (*pose, 0.0, 0.0)) + noise
    matrix = np.diag([-1.0, 1.0]) if flip else -np.eye(2)
    here = make_solver('beam', geometry).solve(tuple(dots.tolist()), UNEQUAL)
    there_dots = (dots.reshape(-1, 2) @ matrix.T).ravel()
    there = make_solver('beam', rotated(geometry, matrix)).solve(tuple(there_dots.tolist()), UNEQUAL)
    sign = np.linalg.det(matrix)
    close(there[:3], [*(matrix @ here[:2]), sign * here.theta])
    close(there[3:5], (here.phi, -here.omega) if flip else (-here.phi, -here.omega))


@many
@given(pose=poses, tilt=tilts)
def test_minimum_tilt_explains_dots_with_least_tilt(golden: Any, rays: Any, pose: Any, tilt: Any) -> None:
    geometry = golden.geometry()
    dots = rays.tip_dots(geometry, (*pose, *tilt))
    solution = make_solver('minimum_tilt', geometry).solve(tuple(dots.tolist()), ISOTROPIC)
    lean = np.arccos(np.cos(solution.phi) * np.cos(solution.omega))
    assert lean <= np.arccos(np.cos(tilt[0]) * np.cos(tilt[1])) + 1e-7
    # The plate at the published pose has these very dots.
    r = rays.rotation(solution.theta, solution.phi, solution.omega)
    np.testing.assert_allclose(rays.tip_dots(geometry, solution[:5]), dots, rtol=0.0, atol=1e-9)
    azimuth = make_solver('minimum_tilt', geometry, angles='azimuth').solve(tuple(dots.tolist()), ISOTROPIC)
    assert azimuth[:2] + azimuth[3:5] == solution[:2] + solution[3:5]
    quaternion = Rotation.from_matrix(r).as_quat()
    assert azimuth.theta == pytest.approx(2.0 * np.arctan2(quaternion[2], quaternion[3]), abs=1e-9)
    for i, q in enumerate(geometry.centers + dots.reshape(2, 2)):
        np.testing.assert_allclose(r[:2, :2] @ q + solution[:2], geometry.beams[i], rtol=0.0, atol=1e-9)
