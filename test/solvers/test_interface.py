"""What holds for every method: one block and many agree, names and geometry are checked."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from psd_deflection.config import rig_from_values
from psd_deflection.errors import ConfigError, SolverError
from psd_deflection.solvers import SOLVERS, Geometry, geometry_from_rig, make_solver, solver_from_rig

VARIANCES = {
    'equal': (4e-12, 4e-12, 4e-12, 4e-12),
    'equal within a PSD': (4e-12, 4e-12, 1e-12, 1e-12),
    'all different': (4e-12, 1e-12, 9e-12, 2e-12),
}
METHODS: list[tuple[str, dict[str, Any]]] = [*((name, {}) for name in SOLVERS), ('wls', {'weights': 'thesis'})]


def flat_dots(geometry: Geometry, pose: np.ndarray[Any, Any], noise: float) -> np.ndarray[Any, Any]:
    """m_i = R(-theta)(l_i - d) - c_i, with noise: (n, 2P)."""
    rng = np.random.default_rng(1)
    c = np.cos(pose[:, 2:])
    s = np.sin(pose[:, 2:])
    u = geometry.beams[:, 0] - pose[:, :1]
    v = geometry.beams[:, 1] - pose[:, 1:2]
    dots = np.stack((c * u + s * v - geometry.centers[:, 0], c * v - s * u - geometry.centers[:, 1]), axis=2)
    return dots.reshape(len(pose), -1) + noise * rng.standard_normal((len(pose), 2 * len(geometry.centers)))


@pytest.mark.parametrize('kind', VARIANCES)
@pytest.mark.parametrize(('method', 'options'), METHODS)
def test_one_block_and_many_agree(golden: Any, method: str, options: dict[str, Any], kind: str) -> None:
    geometry = golden.geometry('G11')
    rng = np.random.default_rng(2)
    pose = rng.uniform(-1, 1, (50, 3)) * (0.005, 0.005, 0.05)
    dots = flat_dots(geometry, pose, 2e-5)
    solver = make_solver(method, geometry, **options)
    variances = VARIANCES[kind]
    many = solver.solve_many(dots, np.tile(variances, (50, 1)))
    shared = solver.solve_many(dots, np.array(variances))
    np.testing.assert_array_equal(many.pose, shared.pose)
    np.testing.assert_allclose(many.covariance, shared.covariance, rtol=1e-12)
    for i in range(50):
        one = solver.solve(tuple(dots[i].tolist()), variances)
        np.testing.assert_allclose([one.dx, one.dy, one.theta], many.pose[i], rtol=0, atol=1e-14)
        scale = np.sqrt(np.diag(many.covariance[i]))
        np.testing.assert_allclose(
            np.reshape(one.covariance, (3, 3)) / np.outer(scale, scale),
            many.covariance[i] / np.outer(scale, scale),
            rtol=0,
            atol=1e-11,
        )
        np.testing.assert_allclose(one.residual, many.residual[i], rtol=0, atol=1e-14)
        assert int(one.status) == many.status[i]
        again = solver.solve(tuple(dots[i].tolist()), variances)
        assert again == one


def test_exact_is_the_minimum_for_any_weights(golden: Any) -> None:
    geometry = golden.geometry('G11')
    variances = np.array(VARIANCES['all different'])
    pose = np.array([[0.002, -0.003, 0.04]])
    dots = flat_dots(geometry, pose, 1e-4)
    got = make_solver('exact', geometry).solve_many(dots, variances).pose[0]

    def cost(p: np.ndarray[Any, Any]) -> float:
        return float(((dots - flat_dots(geometry, p[None, :], 0.0)) ** 2 / variances).sum())

    best = cost(got)
    for axis, step in ((0, 1e-6), (1, 1e-6), (2, 1e-5)):
        for sign in (-1.0, 1.0):
            other = got.copy()
            other[axis] += sign * step
            assert cost(other) > best


def test_exact_and_iterative_agree_for_equal_weights_and_three_psds() -> None:
    geometry = Geometry(
        np.array([[0.1, 0.0], [-0.05, 0.09], [-0.06, -0.08]]), np.full((3, 2), 1e-4), np.zeros(3), 0.585
    )
    rng = np.random.default_rng(3)
    dots = flat_dots(geometry, rng.uniform(-1, 1, (200, 3)) * (0.005, 0.005, 0.3), 1e-4)
    variances = np.full(6, 4e-12)
    exact = make_solver('exact', geometry).solve_many(dots, variances)
    iterative = make_solver('iterative', geometry).solve_many(dots, variances)
    np.testing.assert_allclose(exact.pose, iterative.pose, rtol=0, atol=1e-13)
    one = make_solver('exact', geometry).solve(tuple(dots[0].tolist()), tuple(variances.tolist()))
    np.testing.assert_allclose([one.dx, one.dy, one.theta], exact.pose[0], rtol=0, atol=1e-15)


def test_an_unknown_method_is_refused_with_the_known_ones(golden: Any) -> None:
    with pytest.raises(ConfigError, match=r"'exakt': must be one of exact, .*did you mean exact\?"):
        make_solver('exakt', golden.geometry())


@pytest.mark.parametrize('method', SOLVERS)
def test_coinciding_beams_are_refused_by_name(method: str) -> None:
    geometry = Geometry(np.array([[0.0, 0.07], [0.0, 0.07]]), np.zeros((2, 2)), np.zeros(2), 0.585)
    with pytest.raises(SolverError, match=r'coincide at .* the twist cannot be seen'):
        make_solver(method, geometry)


@pytest.mark.parametrize('method', SOLVERS)
def test_one_psd_is_refused(method: str) -> None:
    with pytest.raises(SolverError, match='at least 2'):
        make_solver(method, Geometry(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1), 0.585))


def test_a_row_scaling_of_another_length_is_refused(golden: Any) -> None:
    with pytest.raises(ConfigError, match=r'wls\.row_scaling .* 4 elements'):
        make_solver('wls', golden.geometry(), weights='thesis', row_scaling=(1.0, 1.0))


def test_the_rig_file_reaches_geometry_and_weights() -> None:
    rig = rig_from_values({'psd_2.center': [0.06, 0.01], 'psd_1.zero': [1e-4, 2e-4], 'wls.weights': 'thesis'})
    geometry = geometry_from_rig(rig)
    np.testing.assert_allclose(geometry.beams, [[1e-4, 0.0702], [0.06, 0.01]], rtol=1e-15)
    dots = (1e-3, -2e-3, 5e-4, 1e-3)
    same = make_solver('wls', geometry, weights='thesis').solve(dots, (1e-12,) * 4)
    assert solver_from_rig('wls', rig).solve(dots, (1e-12,) * 4) == same
    assert make_solver('wls', geometry).solve(dots, (1e-12,) * 4) != same


@pytest.mark.parametrize('method', SOLVERS)
def test_a_dot_that_is_no_number_has_no_status_ok(golden: Any, method: str) -> None:
    solver = make_solver(method, golden.geometry())
    dots = (1e-3, float('nan'), 0.0, 0.0)
    with np.errstate(invalid='ignore'):
        assert solver.solve(dots, VARIANCES['equal']).status != 0
        assert solver.solve_many(np.array([dots]), np.array(VARIANCES['equal'])).status[0] != 0
