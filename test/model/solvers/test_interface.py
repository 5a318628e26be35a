# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What holds for every method: one block and many agree, names and geometry are checked."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.model.plate import Geometry
from psd_deflection.model.solvers import SOLVERS, SolverStatus, make_solver, solver_from_rig
from psd_deflection.rig.config import rig_from_values

VARIANCES = {
    'equal': (4e-12, 4e-12, 4e-12, 4e-12),
    'equal within a PSD': (4e-12, 4e-12, 1e-12, 1e-12),
    'all different': (4e-12, 1e-12, 9e-12, 2e-12),
}
THRESHOLD = ('iterative_printed', 'appendix_d')
ELSEWHERE = ('pose', 'base_pair')
"""They reject the thesis rig: three staggered PSDs, and PSDs at the base, are what they are for."""

SMOOTH: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name in SOLVERS if name not in THRESHOLD + ELSEWHERE),
    ('wls', {'weights': 'thesis'}),
    ('wls_exact', {'weights': 'thesis'}),
]
STEPPED: list[tuple[str, dict[str, Any]]] = [
    ('iterative_printed', {}),
    ('iterative_printed', {'criterion': 'absolute'}),
    ('iterative_printed', {'criterion': 'argmin'}),
    ('appendix_d', {}),
]
OPPOSITE = Geometry(np.array([[0.07, 0.02], [-0.06, 0.0]]), np.full((2, 2), 2e-4), np.zeros(2), 0.585)
STAGGERED = Geometry(
    np.array([[0.1, 0.0], [-0.05, 0.087], [-0.05, -0.087]]), np.full((3, 2), 1e-4), np.array([0.1, -0.05, -0.05]), 0.585
)
AT_THE_BASE = Geometry(np.array([[0.0, 0.07], [-0.1, 0.0]]), np.full((2, 2), 1e-4), np.array([-0.585, -0.485]), 0.585)


def some_dots(rays: Any, geometry: Geometry, count: int, noise: float, tilt: float = 0.0) -> np.ndarray[Any, Any]:
    rng = np.random.default_rng(2)
    poses = rng.uniform(-1, 1, (count, 5)) * (0.005, 0.005, 0.05, tilt, tilt)
    dots = np.array([rays.tip_dots(geometry, pose) for pose in poses])
    return dots + noise * rng.standard_normal(dots.shape)


def agree(solver: Any, dots: np.ndarray[Any, Any], variances: tuple[float, ...], atol: float = 1e-14) -> None:
    count = len(dots)
    many = solver.solve_many(dots, np.tile(variances, (count, 1)))
    shared = solver.solve_many(dots, np.array(variances))
    for name in ('pose', 'tilt', 'covariance', 'residual', 'status'):
        np.testing.assert_allclose(getattr(many, name), getattr(shared, name), rtol=1e-12, atol=1e-18)
    for i in range(count):
        one = solver.solve(tuple(dots[i].tolist()), variances)
        np.testing.assert_allclose([one.dx, one.dy, one.theta], many.pose[i], rtol=0, atol=atol)
        np.testing.assert_allclose([one.phi, one.omega], many.tilt[i], rtol=0, atol=10 * atol)
        scale = np.sqrt(np.diag(many.covariance[i]))
        scale = np.where(scale > 0.0, scale, 1.0)
        np.testing.assert_allclose(
            np.reshape(one.covariance, (3, 3)) / np.outer(scale, scale),
            many.covariance[i] / np.outer(scale, scale),
            rtol=0,
            atol=1e-9,
        )
        np.testing.assert_allclose(one.residual, many.residual[i], rtol=0, atol=atol)
        assert int(one.status) == many.status[i]
        assert type(one.status) is SolverStatus
        assert all(type(v) is float for v in (*one[:5], *one.covariance, *one.residual))
        again = solver.solve(tuple(dots[i].tolist()), variances)
        np.testing.assert_array_equal(np.array(again[:5]), np.array(one[:5]))


@pytest.mark.slow
@pytest.mark.parametrize('kind', VARIANCES)
@pytest.mark.parametrize(('method', 'options'), [*SMOOTH, *STEPPED])
def test_one_block_and_many_agree(golden: Any, rays: Any, method: str, options: dict[str, Any], kind: str) -> None:
    geometry = golden.geometry('G11')
    agree(make_solver(method, geometry, **options), some_dots(rays, geometry, 20, 2e-5, 0.01), VARIANCES[kind])


@pytest.mark.repeatable
@pytest.mark.parametrize(('method', 'options'), [*SMOOTH, *STEPPED])
def test_solver_cache_between_blocks_changes_no_answer(golden: Any, method: str, options: dict[str, Any]) -> None:
    """Nor does a caller who writes into a gain that he was given."""
    geometry, dots = golden.geometry(), golden.dots('G4')
    solver = make_solver(method, geometry, **options)
    for kind in (*VARIANCES, *VARIANCES):
        variances = VARIANCES[kind]
        fresh = make_solver(method, geometry, **options)
        want, got = fresh.solve(dots, variances), solver.solve(dots, variances)
        assert repr(got) == repr(want)
        gain = solver.gain(dots, variances, got)
        with contextlib.suppress(ValueError):
            gain[:] = 7.0
        np.testing.assert_array_equal(solver.gain(dots, variances, got), fresh.gain(dots, variances, want))


@pytest.mark.parametrize(('method', 'options'), SMOOTH)
def test_one_block_and_many_agree_for_opposite_psds(rays: Any, method: str, options: dict[str, Any]) -> None:
    agree(make_solver(method, OPPOSITE, **options), some_dots(rays, OPPOSITE, 20, 2e-6), VARIANCES['all different'])


@pytest.mark.parametrize('method', ['exact', 'wls', 'wls_exact', 'ols', 'iterative', 'beam', 'pose'])
def test_one_block_and_many_agree_for_three_psds(rays: Any, method: str) -> None:
    variances = (4e-12, 1e-12, 9e-12, 2e-12, 3e-12, 5e-12)
    agree(make_solver(method, STAGGERED), some_dots(rays, STAGGERED, 20, 2e-6, 0.01), variances)


@pytest.mark.parametrize('assume', ['beam', 'no_twist'])
def test_one_block_and_many_agree_at_the_base(rays: Any, assume: str) -> None:
    rng = np.random.default_rng(4)
    poses = rng.uniform(-1, 1, (10, 5)) * (0.003, 0.003, 0.0, 0.005, 0.005)
    dots = np.array([rays.base_dots(AT_THE_BASE, pose) for pose in poses])
    agree(make_solver('base_pair', AT_THE_BASE, assume=assume), dots, VARIANCES['all different'], atol=1e-13)


@pytest.mark.parametrize(('method', 'options'), STEPPED)
def test_a_threshold_claims_no_covariance(golden: Any, method: str, options: dict[str, Any]) -> None:
    one = make_solver(method, golden.geometry(), **options).solve(golden.dots('G4'), VARIANCES['equal'])
    assert np.isnan(one.covariance).all()


def test_no_hit_is_no_measurement(golden: Any) -> None:
    far = (5e-3, 0.0, 0.0, -9e-3)
    printed = make_solver('iterative_printed', golden.geometry(), criterion='absolute').solve(far, VARIANCES['equal'])
    assert printed.status is SolverStatus.NO_HIT
    assert np.isnan(printed[:3]).all()
    code = make_solver('appendix_d', golden.geometry()).solve(golden.dots('G3'), VARIANCES['equal'])
    assert code.status is SolverStatus.NO_HIT
    assert code[:3] == (0.0, 0.0, 0.0)


def test_a_base_line_too_short_for_any_tilt_is_inadmissible(golden: Any) -> None:
    # 30 um shorter along (0.1, 0.07) m; noise of 2 um.
    shrink = 30e-6 * np.array([0.1, 0.07]) / np.hypot(0.1, 0.07)
    solver = make_solver('minimum_tilt', golden.geometry())
    for scale, status in ((1.0, SolverStatus.INADMISSIBLE), (0.1, SolverStatus.OK)):
        dots = (-scale * shrink[0], -scale * shrink[1], 0.0, 0.0)
        one = solver.solve(dots, VARIANCES['equal'])
        many = solver.solve_many(np.array([dots]), np.array(VARIANCES['equal']))
        assert one.status is status
        assert many.status[0] == status
        assert one.phi == one.omega == 0.0


def test_an_unknown_method_is_rejected_with_the_known_ones(golden: Any) -> None:
    with pytest.raises(ConfigError, match=r"'exakt': must be one of exact, .*did you mean exact\?"):
        make_solver('exakt', golden.geometry())


def test_options_are_checked(golden: Any) -> None:
    with pytest.raises(ConfigError, match=r'wls\.row_scaling .* 4 elements'):
        make_solver('wls', golden.geometry(), weights='thesis', row_scaling=(1.0, 1.0))
    with pytest.raises(ConfigError, match=r'wls\.row_scaling .* above 0'):
        make_solver('wls_exact', golden.geometry(), weights='thesis', row_scaling=(1.0, 1.0, 0.0, 1.0))
    with pytest.raises(ConfigError, match=r"wls\.weights = 'mine': must be one of inverse_variance, thesis"):
        make_solver('wls', golden.geometry(), weights='mine')
    with pytest.raises(ConfigError, match=r"criterion = 'x': must be one of printed, absolute, argmin"):
        make_solver('iterative_printed', golden.geometry(), criterion='x')
    with pytest.raises(ConfigError, match=r"assume = 'x': must be one of beam"):
        make_solver('base_pair', AT_THE_BASE, assume='x')


@pytest.mark.parametrize('method', ['exact', 'wls', 'wls_exact', 'beam'])
def test_a_variance_of_zero_is_rejected(golden: Any, method: str) -> None:
    with pytest.raises(SolverError, match=r'variances must be above 0'):
        make_solver(method, golden.geometry()).solve((0.0,) * 4, (0.0,) * 4)
    with pytest.raises(SolverError, match=r'variances must be above 0'):
        make_solver(method, golden.geometry()).solve_many(np.zeros((1, 4)), np.array([1.0, 1.0, float('nan'), 1.0]))


def test_a_variance_of_zero_is_rejected_elsewhere_too() -> None:
    for method, geometry in (('pose', STAGGERED), ('base_pair', AT_THE_BASE)):
        count = 2 * len(geometry.centers)
        with pytest.raises(SolverError, match=r'variances must be above 0'):
            make_solver(method, geometry).solve((0.0,) * count, (0.0,) * count)
        with pytest.raises(SolverError, match=r'variances must be above 0'):
            make_solver(method, geometry).solve_many(np.zeros((1, count)), np.zeros(count))


def test_the_rig_file_reaches_geometry_and_weights() -> None:
    rig = rig_from_values({'psd_2.center': [0.06, 0.01], 'psd_1.zero': [1e-4, 2e-4], 'wls.weights': 'thesis'})
    geometry = Geometry.from_rig(rig)
    np.testing.assert_allclose(geometry.beams, [[1e-4, 0.0702], [0.06, 0.01]], rtol=1e-15)
    dots = (1e-3, -2e-3, 5e-4, 1e-3)
    for name in ('wls', 'wls_exact'):
        same = make_solver(name, geometry, weights='thesis').solve(dots, (1e-12,) * 4)
        assert solver_from_rig(name, rig).solve(dots, (1e-12,) * 4) == same
        assert make_solver(name, geometry).solve(dots, (1e-12,) * 4) != same


@pytest.mark.parametrize(('method', 'options'), [*SMOOTH, *STEPPED])
def test_a_dot_that_is_no_number_has_no_status_ok(golden: Any, method: str, options: dict[str, Any]) -> None:
    solver = make_solver(method, golden.geometry(), **options)
    good = golden.dots('G5')
    bad = (good[0], float('nan'), *good[2:])
    assert solver.solve(bad, VARIANCES['equal']).status != 0
    many = solver.solve_many(np.array([good, bad, good]), np.array(VARIANCES['equal']))
    assert many.status[1] != 0
    # Its neighbours are none the worse.
    one = solver.solve(good, VARIANCES['equal'])
    np.testing.assert_allclose(many.pose[[0, 2]], [one[:3], one[:3]], rtol=0, atol=1e-14)
    assert many.status[[0, 2]].tolist() == [one.status] * 2
