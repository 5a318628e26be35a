# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What holds for every method: one block and many agree, geometry is checked, it converges or says that it does not."""

import contextlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.model.plate import Geometry
from psd_deflection.model.solvers import SOLVERS, SolverStatus, make_solver, solver_from_rig
from psd_deflection.model.solvers.gauss_newton import MAX_STEPS, Minimum, answer, fit
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
        single = solver.solve(tuple(dots[i].tolist()), variances)
        np.testing.assert_allclose([single.dx, single.dy, single.theta], many.pose[i], rtol=0, atol=atol)
        np.testing.assert_allclose([single.phi, single.omega], many.tilt[i], rtol=0, atol=10 * atol)
        scale = np.sqrt(np.diag(many.covariance[i]))
        scale = np.where(scale > 0.0, scale, 1.0)
        np.testing.assert_allclose(
            np.reshape(single.covariance, (3, 3)) / np.outer(scale, scale),
            many.covariance[i] / np.outer(scale, scale),
            rtol=0,
            atol=1e-9,
        )
        np.testing.assert_allclose(single.residual, many.residual[i], rtol=0, atol=atol)
        assert int(single.status) == many.status[i]
        assert type(single.status) is SolverStatus
        assert all(type(v) is float for v in (*single[:5], *single.covariance, *single.residual))
        again = solver.solve(tuple(dots[i].tolist()), variances)
        np.testing.assert_array_equal(np.array(again[:5]), np.array(single[:5]))


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


@pytest.mark.parametrize('psds', [2, 3])
@pytest.mark.parametrize('method', ['exact', 'wls', 'iterative'])
def test_one_block_and_many_have_the_same_bits(method: str, psds: int) -> None:
    """Their gains too. Of two PSDs the last block's plate points coincide, so that nothing says how it is turned."""
    rng = np.random.default_rng(psds)
    centers = rng.uniform(-0.1, 0.1, (psds, 2))
    solver = make_solver(method, Geometry(centers, np.full((psds, 2), 1e-3), np.zeros(psds), 0.585, arithmetic=FIXED))
    dots = rng.normal(size=(30, 2 * psds)) * rng.choice([1e-6, 1e-3, 2e-2], (30, 1))
    if psds == 2:
        dots[-1] = (-centers).ravel()
    for variances in ((4e-12,) * 2 * psds, tuple((rng.uniform(1.0, 9.0, 2 * psds) * 1e-12).tolist())):
        many = solver.solve_many(dots, np.array(variances))
        gains = solver.gain_many(dots[:-1], variances, solver.solve_many(dots[:-1], np.array(variances)))
        for i, (block, row) in enumerate(zip(dots.tolist(), many.rows(), strict=True)):
            single = solver.solve(tuple(block), variances)
            assert repr(single._replace(iterations=0)) == repr(row)
            if i < 29:
                np.testing.assert_array_equal(solver.gain(tuple(block), variances, single), gains[i])


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
    solution = make_solver(method, golden.geometry(), **options).solve(golden.dots('G4'), VARIANCES['equal'])
    assert np.isnan(solution.covariance).all()


def test_no_hit_is_no_measurement(golden: Any) -> None:
    miss = (5e-3, 0.0, 0.0, -9e-3)
    printed = make_solver('iterative_printed', golden.geometry(), criterion='absolute').solve(miss, VARIANCES['equal'])
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
        solution = solver.solve(dots, VARIANCES['equal'])
        many = solver.solve_many(np.array([dots]), np.array(VARIANCES['equal']))
        assert solution.status is status
        assert many.status[0] == status
        assert solution.phi == solution.omega == 0.0


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
    single = solver.solve(good, VARIANCES['equal'])
    np.testing.assert_allclose(many.pose[[0, 2]], [single[:3], single[:3]], rtol=0, atol=1e-14)
    assert many.status[[0, 2]].tolist() == [single.status] * 2


def curve(x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
    """(a, b) to a e^b, a e^2b, a: three readings of two unknowns."""
    a, b = x
    e = float(np.exp(b))
    return [a * e, a * e * e, a], [(e, a * e), (e * e, 2.0 * a * e * e), (1.0, 0.0)]


def line(x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
    """Sees the sum of its unknowns only, except where the first is 1."""
    reports = 1.0 if x[0] == 1.0 else 0.0
    return [x[0] + x[1], 0.0], [(1.0, 1.0), (reports, 0.0)]


def test_a_curve_is_fitted_with_its_covariance() -> None:
    measured, _ = curve((2.0, 0.3))
    fitted = fit(curve, (1.5, 0.2), measured, (0.01, 0.04, 0.02))
    assert fitted.converged
    np.testing.assert_allclose(fitted.parameters, (2.0, 0.3), atol=1e-12)
    _, rows = curve((2.0, 0.3))
    j = np.array(rows)
    want = np.linalg.inv(j.T @ np.diag([100.0, 25.0, 50.0]) @ j)
    np.testing.assert_allclose(fitted.covariance, want, rtol=1e-9)


def test_what_cannot_be_observed_is_not_converged() -> None:
    fitted = fit(line, (0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    assert not fitted.converged
    assert np.isnan(fitted.covariance).all()


@pytest.mark.parametrize(('slope', 'reading', 'steps'), [(1.0, 1.0, MAX_STEPS), (1e-150, 1e160, 1)])
def test_steps_without_an_end_end(slope: float, reading: float, steps: int) -> None:
    """The model never comes nearer; a slope of 1e-150 and a reading of 1e160 have 1e310 to go."""

    def away(x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
        return [0.0], [(slope,)]

    fitted = fit(away, (0.0,), (reading,), (1.0,))
    assert not fitted.converged
    assert (fitted.steps, MAX_STEPS) == (steps, 50)


def test_the_residual_is_that_at_the_answer_to_the_last_digit() -> None:
    """Readings that no curve explains: each step is a share of the one before, and the last one still counts."""
    on, _ = curve((2.0, 0.3))
    measured = [a + b for a, b in zip(on, (0.9, -0.7, 0.8), strict=True)]
    fitted = fit(curve, (1.5, 0.2), measured, (0.01, 0.04, 0.02))
    assert fitted.converged
    assert fitted.steps > 5
    want = np.array(measured) - curve(fitted.parameters)[0]
    np.testing.assert_allclose(fitted.residual, want, rtol=0.0, atol=2e-15)


def test_an_answer_takes_the_first_three_of_five() -> None:
    covariance = [[float(10 * min(i, j) + max(i, j)) for j in range(5)] for i in range(5)]
    for converged in (True, False):
        got = answer(Minimum([0.0] * 5, covariance, [7.0, 8.0], converged, 4), (1.0, 2.0, 3.0, 4.0, 5.0), covariance)
        assert got[:5] == (1.0, 2.0, 3.0, 4.0, 5.0)
        assert got.covariance == (0.0, 1.0, 2.0, 1.0, 11.0, 12.0, 2.0, 12.0, 22.0)
        assert (got.residual, got.iterations) == ((7.0, 8.0), 4)
        assert got.status is (SolverStatus.OK if converged else SolverStatus.NOT_CONVERGED)


def rig(centers: Any, heights: Any = None, k: float = 1.5, length: float = 0.585) -> Geometry:
    places = np.array(centers, dtype=float)
    up = np.zeros(len(places)) if heights is None else np.array(heights, dtype=float)
    return Geometry(places, np.zeros_like(places), up, length, k)


CORNER = [[0.0, 0.07], [-0.1, 0.0]]
THREE = [[0.1, 0.0], [-0.05, 0.087], [-0.05, -0.087]]


@pytest.mark.parametrize('method', SOLVERS)
def test_a_geometry_that_tells_no_pose_is_rejected(method: str) -> None:
    with pytest.raises(SolverError, match=r'beams of psd_1 and psd_2 coincide at .* the twist cannot be seen'):
        make_solver(method, rig([[0.0, 0.07], [0.0, 0.07]]))
    with pytest.raises(SolverError, match=r'cannot tell a twist from a translation; at least 2'):
        make_solver(method, rig([[0.0, 0.07]]))
    with pytest.raises(SolverError, match=r'centers must be finite'):
        make_solver(method, rig([[0.0, float('nan')], [0.0, 0.0]]))
    with pytest.raises(SolverError, match=r'of the same 2 PSDs'):
        make_solver(method, Geometry(np.array(CORNER), np.zeros((2, 2)), np.zeros(3), 0.585))
    with pytest.raises(SolverError, match=r'must be \(number of PSDs, 2\)'):
        make_solver(method, Geometry(np.zeros(4), np.zeros(4), np.zeros(2), 0.585))


@pytest.mark.parametrize('centers', [[[0.0, 0.07], [0.0, -0.07]], [[0.07, 0.0], [-0.07, 0.0]]])
@pytest.mark.parametrize('method', ['exact', 'wls', 'wls_exact', 'ols', 'iterative', 'beam', 'minimum_tilt'])
def test_one_of_the_two_rank_conditions_is_enough(rays: Any, method: str, centers: Any) -> None:
    """The source asks for 4.21 and 4.22; these rigs break one of them and are well-conditioned."""
    geometry = rig(centers)
    dots = tuple(rays.tip_dots(geometry, (0.0, 0.0, 1e-6, 0.0, 0.0)).tolist())
    assert make_solver(method, geometry).solve(dots, (4e-12,) * 4).theta == pytest.approx(1e-6, rel=1e-5)


@pytest.mark.parametrize(
    ('method', 'geometry', 'options', 'message'),
    [
        ('beam', rig(CORNER, [-0.39, 0.0]), {}, r'psd_1\.height = -0\.39 m: .*the deflection cannot be seen'),
        ('beam', rig(CORNER, length=0.0), {}, r'link\.length = 0\.0 m: must be above 0'),
        ('beam', rig(CORNER, k=float('inf')), {}, r'link\.slope_ratio = inf: must be finite'),
        ('pose', rig(CORNER, [0.1, -0.1]), {}, r'4 readings for 5 unknowns'),
        ('pose', rig(THREE), {}, r'coplanar surfaces do not see a tilt'),
        ('pose', rig([[0.1, 0.0], [0.0, 0.0], [-0.1, 0.0]], [0.1, 0.0, -0.1]), {}, r'lie on one line in space'),
        ('minimum_tilt', rig(THREE), {}, r'takes two PSDs'),
        ('minimum_tilt', rig(CORNER, [0.02, 0.02]), {}, r'takes both surfaces at 0'),
        ('base_pair', rig(CORNER), {}, r'psd_1\.height = 0 m: a PSD at the base stands below'),
        ('base_pair', rig(CORNER, [-0.585, -0.485]), {'assume': 'nothing'}, r'4 readings for 5 unknowns: with torsion'),
        ('base_pair', rig(CORNER, [-0.5, -0.5]), {'assume': 'no_twist'}, r'all PSD planes are 0\.5 m from the lasers'),
        ('base_pair', rig(CORNER, [-0.585, -0.585], k=1.0), {}, r'slope_ratio = 1 with all PSDs 0\.585 m .*Fig\. 5\.9'),
        ('base_pair', rig(THREE, [-0.5, -0.5, -0.5]), {'assume': 'nothing'}, r'some motion of the tip moves no dot'),
        ('iterative_printed', rig(THREE), {}, r'takes two PSDs'),
        ('appendix_d', rig(THREE), {}, r'takes two PSDs'),
        ('appendix_d', rig([[0.07, 0.0], [-0.1, 0.0]]), {}, r'appendix_d divides by both'),
        ('appendix_d_ols', rig(THREE), {}, r'takes two PSDs'),
    ],
)
def test_rejected_by_name(method: str, geometry: Geometry, options: dict[str, Any], message: str) -> None:
    with pytest.raises(SolverError, match=message):
        make_solver(method, geometry, **options)


def test_the_rejection_under_torsion_says_how_bad_it_is(rays: Any) -> None:
    """0.1 degree of twist is read as -1.02 mm of dY (thesis 5.3; docs/audit.md)."""
    geometry = rig(CORNER, [-0.585, -0.485])
    with pytest.raises(SolverError, match=r'one degree of twist looks like 10\.2 mm of ΔY'):
        make_solver('base_pair', geometry, assume='nothing')
