# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How an answer goes with each dot, by differences of the answers, is the judge of every stated gain and covariance."""

from typing import Any

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.model.plate import Geometry
from psd_deflection.model.solvers import SolverStatus, make_solver, solver_from_rig
from psd_deflection.model.solvers.interface import Solver
from psd_deflection.model.solvers.registry import check_arrangement, solver_class
from psd_deflection.model.solvers.subset import geometry_of, subset_solver
from psd_deflection.rig.config import rig_from_values
from test.model.solvers.test_truth import FLAT_THREE, RAISED, THREE, TWO, VARIANCES, least_squares

Array = np.ndarray[Any, Any]
SKEW = Geometry(np.array([[0.06, 0.05], [-0.05, -0.03]]), np.array([[3e-4, -2e-4], [1e-4, 5e-4]]), np.zeros(2), 0.585)
AT_THE_BASE = Geometry(
    np.array([[0.01, 0.07], [-0.1, 0.02]]), np.array([[3e-4, -2e-4], [1e-4, 5e-4]]), np.array([-0.585, -0.485]), 0.585
)
OTHER_WEIGHTS: dict[str, Any] = {'weights': 'thesis', 'row_scaling': (0.3, 0.5, 2.0, 0.4)}
POSES = ((2e-3, -3e-3, 0.04), (-4e-3, 1e-3, -0.05))


def tied(geometry: Geometry, pose: tuple[float, float, float]) -> tuple[float, ...]:
    """The pose with a cantilever's tilts, phi = -k dY/L and omega = k dX/L."""
    k = geometry.slope_ratio / geometry.link_length
    return (*pose, -k * pose[1], k * pose[0])


def by_differences(solver: Solver, dots: Array, variances: Array) -> Array:
    """d(dX, dY, theta)/d(dots), (3, 2P)."""
    columns = []
    for i in range(len(dots)):
        ends = []
        for step in (1e-6, -1e-6):
            moved = dots.copy()
            moved[i] += step
            ends.append(np.array(solver.solve(tuple(moved.tolist()), tuple(variances.tolist()))[:3]))
        columns.append((ends[0] - ends[1]) / 2e-6)
    return np.stack(columns, axis=1)


TIP: list[tuple[str, dict[str, Any], Geometry, tuple[float, float]]] = [
    ('exact', {}, SKEW, (0.0, 0.0)),
    ('exact', {}, FLAT_THREE, (0.0, 0.0)),
    ('iterative', {}, SKEW, (0.0, 0.0)),
    ('iterative', {}, FLAT_THREE, (0.0, 0.0)),
    ('ols', {}, SKEW, (0.01, 0.01)),
    ('ols', {}, FLAT_THREE, (0.01, 0.01)),
    ('wls', {}, SKEW, (0.01, 0.01)),
    ('wls', OTHER_WEIGHTS, SKEW, (0.01, 0.01)),
    ('wls_exact', {}, SKEW, (0.0, 0.0)),
    ('wls_exact', {}, FLAT_THREE, (0.0, 0.0)),
    ('wls_exact', OTHER_WEIGHTS, SKEW, (0.0, 0.0)),
    ('minimum_tilt', {}, SKEW, (0.2, -0.15)),
    ('minimum_tilt', {'angles': 'azimuth'}, SKEW, (0.2, -0.15)),
    ('pose', {}, THREE, (0.02, -0.03)),
]


@pytest.mark.parametrize('pose', POSES)
@pytest.mark.parametrize(('method', 'options', 'geometry', 'tilt'), TIP)
def test_gain_and_covariance_are_those_of_the_answer(
    rays: Any,
    method: str,
    options: dict[str, Any],
    geometry: Geometry,
    tilt: tuple[float, float],
    pose: tuple[float, float, float],
) -> None:
    solver = make_solver(method, geometry, **options)
    checked(solver, np.asarray(rays.tip_dots(geometry, (*pose, *tilt))), 1e-5, 1e-5)


def checked(solver: Solver, dots: Array, covariance_within: float, gain_within: float) -> None:
    """Covariance against K V K^T and the stated gain against K, each in units of its own size."""
    variances = np.array(VARIANCES[: len(dots)])
    gain = by_differences(solver, dots, variances)
    solution = solver.solve(tuple(dots.tolist()), tuple(variances.tolist()))
    assert solution.status is SolverStatus.OK
    want = gain * variances @ gain.T
    sd = np.sqrt(np.maximum(np.diag(want), 1e-24))
    stated = np.reshape(solution.covariance, (3, 3))
    np.testing.assert_allclose(stated / np.outer(sd, sd), want / np.outer(sd, sd), rtol=0.0, atol=covariance_within)
    size = np.abs(gain).max(axis=1, keepdims=True) + 1e-9
    of_dots = solver.gain(tuple(dots.tolist()), tuple(variances.tolist()), solution)
    np.testing.assert_allclose(of_dots / size, gain / size, rtol=0.0, atol=gain_within)


@pytest.mark.parametrize('pose', POSES)
@pytest.mark.parametrize(('geometry', 'gain_within'), [(TWO, 0.02), (FLAT_THREE, 0.02), (RAISED, 0.3)])
def test_the_covariance_of_beam_is_that_of_its_answer(
    rays: Any, geometry: Geometry, gain_within: float, pose: tuple[float, float, float]
) -> None:
    """Its gain is a flat plate's, so it misses what heights do: k h/L of it."""
    dots = np.asarray(rays.tip_dots(geometry, tied(geometry, pose)))
    checked(make_solver('beam', geometry), dots, 1e-5, gain_within)


@pytest.mark.parametrize('assume', ['beam', 'no_twist'])
@pytest.mark.parametrize('pose', POSES)
def test_the_base_pair_is_weighted_least_squares_of_its_model(
    rays: Any, assume: str, pose: tuple[float, float, float]
) -> None:
    k = AT_THE_BASE.slope_ratio / AT_THE_BASE.link_length
    variances = np.array(VARIANCES[:4])

    def model(x: Array) -> Array:
        five = (*x, -k * x[1], k * x[0]) if assume == 'beam' else (x[0], x[1], 0.0, x[2], x[3])
        return np.asarray(rays.base_dots(AT_THE_BASE, five))

    unknowns = 3 if assume == 'beam' else 4
    x = np.array((*pose, 0.004)[:unknowns] if assume == 'beam' else (*pose[:2], 0.004, -0.006))
    # Of four readings four unknowns leave no residual.
    dots = model(x) + np.array([6e-6, -4e-6, 3e-6, 5e-6]) * (assume == 'beam')
    solver = make_solver('base_pair', AT_THE_BASE, assume=assume)
    got = solver.solve(tuple(dots.tolist()), tuple(variances.tolist()))
    want, covariance, residual, gain = least_squares(model, dots, variances, unknowns)
    if assume == 'beam':
        five = (*want, -k * want[1], k * want[0])
    else:
        five = (want[0], want[1], 0.0, want[2], want[3])
        keep = [0, 1]
        gain = np.vstack((gain[keep], np.zeros(4)))
        full = np.zeros((3, 3))
        full[:2, :2] = covariance[:2, :2]
        covariance = full
    np.testing.assert_allclose(got[:5], five, rtol=0.0, atol=3e-9)
    np.testing.assert_allclose(got.residual, residual, rtol=0.0, atol=3e-9)
    sd = np.sqrt(np.diag(covariance)) + 1e-12
    stated = np.reshape(got.covariance, (3, 3))
    np.testing.assert_allclose(stated / np.outer(sd, sd), covariance / np.outer(sd, sd), rtol=0.0, atol=2e-3)
    stated_gain = solver.gain(tuple(dots.tolist()), tuple(variances.tolist()), got)
    np.testing.assert_allclose(stated_gain, gain, rtol=0.0, atol=2e-3 * np.abs(gain).max())


@pytest.mark.parametrize('geometry', [SKEW, FLAT_THREE])
@pytest.mark.parametrize('method', ['exact', 'iterative'])
def test_residual_is_dots_minus_plate_at_answer(rays: Any, method: str, geometry: Geometry) -> None:
    variances = VARIANCES[: 2 * len(geometry.centers)]
    off = np.random.default_rng(8).normal(size=len(variances)) * 1e-4
    dots = rays.tip_dots(geometry, (2e-3, -1e-3, 0.04, 0.0, 0.0)) + off
    solution = make_solver(method, geometry).solve(tuple(dots.tolist()), variances)
    np.testing.assert_allclose(solution.residual, dots - rays.tip_dots(geometry, solution[:5]), rtol=0.0, atol=1e-14)
    assert np.abs(solution.residual).max() > 1e-5


@pytest.mark.parametrize(('method', 'tries'), [('exact', 30), ('iterative', 50)])
def test_what_never_ends_is_given_up(method: str, tries: int) -> None:
    solution = make_solver(method, SKEW).solve((float('nan'), 0.0, 0.0, 0.0), VARIANCES[:4])
    assert solution.status is SolverStatus.NOT_CONVERGED
    assert solution.iterations == tries


def test_newton_converges_fast_on_inconsistent_dots() -> None:
    """Half a radian from the start to the answer: the slope and its own slope must both be right."""
    variances = np.array([1e-12, 9e-10, 4e-12, 1e-10])
    dots = np.array([0.02, -0.03, -0.025, 0.03])
    many = make_solver('exact', SKEW)
    solution = many.solve(tuple(dots.tolist()), tuple(variances.tolist()))
    assert solution.status is SolverStatus.OK
    assert solution.iterations <= 6, solution
    q, pairs = SKEW.centers + dots.reshape(2, 2), variances.reshape(2, 2)

    def cost(theta: Array) -> Array:
        """The smallest sum of squares at each angle: of two dots, what their difference is off."""
        lx, ly = SKEW.beams[0] - SKEW.beams[1]
        qx, qy = q[0] - q[1]
        off_x, off_y = qx - np.cos(theta) * lx - np.sin(theta) * ly, qy - np.cos(theta) * ly + np.sin(theta) * lx
        return np.asarray(off_x**2 / pairs[:, 0].sum() + off_y**2 / pairs[:, 1].sum())

    angles = np.linspace(-np.pi, np.pi, 200_001)
    assert solution.theta == pytest.approx(float(angles[np.argmin(cost(angles))]), abs=4e-5)
    assert many.solve_many(dots[None], variances).pose[0] == pytest.approx(solution[:3], abs=1e-13)


def test_dots_that_lie_on_one_another_turn_nothing() -> None:
    """The plate points of both dots are one: no angle is better than another, and 0 is said by one block and many."""
    meet = SKEW.centers[1] - SKEW.centers[0]
    dots, solver = np.array([*meet, 0.0, 0.0]), make_solver('exact', SKEW)
    assert solver.solve(tuple(dots.tolist()), (1e-12,) * 4).theta == 0.0
    got = solver.solve_many(np.array([dots, [1e-3, 0.0, 0.0, 0.0]]), np.full(4, 1e-12))
    # Both beams' middle comes to where the dots are.
    np.testing.assert_allclose(got.pose[0], [*(SKEW.beams.mean(axis=0) - SKEW.centers[1]), 0.0], atol=1e-15)
    assert got.status.tolist() == [0, 0]


@pytest.mark.parametrize(('method', 'count'), [('exact', 2), ('exact', 4098), ('iterative', 2)])
def test_of_many_blocks_each_has_its_own_variances(rays: Any, method: str, count: int) -> None:
    """More of them than are worked on at once, too."""
    rng = np.random.default_rng(6)
    dots = rays.tip_dots(SKEW, (1e-3, 2e-3, 0.02, 0.0, 0.0)) + rng.normal(size=(count, 4)) * 1e-4
    variances = rng.uniform(1.0, 9.0, (count, 4)) * 1e-12
    solver = make_solver(method, SKEW)
    many = solver.solve_many(dots, variances)
    for i in {0, 1, count - 2, count - 1}:
        solution = solver.solve(tuple(dots[i].tolist()), tuple(variances[i].tolist()))
        np.testing.assert_allclose(many.pose[i], solution[:3], rtol=0.0, atol=1e-13)
        np.testing.assert_allclose(many.covariance[i].ravel(), solution.covariance, rtol=1e-9, atol=1e-22)
        np.testing.assert_allclose(many.residual[i], solution.residual, rtol=0.0, atol=1e-14)
    assert not many.tilt.any()


def of_three(**values: Any) -> Any:
    """A rig of three PSDs at different heights, which see the tilts together."""
    places: dict[str, Any] = {}
    for i, ((x, y), (zx, zy), height) in enumerate(zip(THREE.centers, THREE.zeros, THREE.heights, strict=True), 1):
        places |= {f'psd_{i}.center': [x, y], f'psd_{i}.zero': [zx, zy], f'psd_{i}.height': float(height)}
    return rig_from_values({**places, 'solver': 'pose', 'solvers': ['pose'], **values})


def test_two_of_three_psds_allow_for_unobserved_tilt(rays: Any) -> None:
    """The middle between no tilt and a cantilever's, by least squares, and the way to either end as one more error."""
    rig, subset = of_three(), [0, 2]
    geometry = geometry_of(rig, subset)
    np.testing.assert_array_equal(geometry.centers, THREE.centers[subset])
    np.testing.assert_array_equal(geometry.zeros, THREE.zeros[subset])
    np.testing.assert_array_equal(geometry.heights, THREE.heights[subset])
    solver = subset_solver('pose', rig, subset)
    assert solver is not None
    variances = np.array(VARIANCES[:4])
    dots = np.asarray(rays.tip_dots(geometry, tied(geometry, (2e-3, -3e-3, 0.02)))) + np.array(
        [3e-6, 1e-6, -2e-6, 4e-6]
    )

    def leaning(share: float) -> tuple[Array, ...]:
        k = share * geometry.slope_ratio / geometry.link_length

        def model(x: Array) -> Array:
            return np.asarray(rays.tip_dots(geometry, (*x, -k * x[1], k * x[0])))

        return least_squares(model, dots, variances, 3)

    (middle, covariance, residual, _), (end, *_) = leaning(0.5), leaning(1.0)
    got = solver.solve(tuple(dots.tolist()), tuple(variances.tolist()))
    np.testing.assert_allclose(got[:3], middle, rtol=0.0, atol=2e-9)
    k = 0.5 * geometry.slope_ratio / geometry.link_length
    np.testing.assert_allclose(got[3:5], (-k * middle[1], k * middle[0]), rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(got.residual, residual, rtol=0.0, atol=2e-9)
    apart = end - middle
    assert np.abs(apart[:2]).max() > 1e-5
    np.testing.assert_allclose(np.reshape(got.covariance, (3, 3)), covariance + np.outer(apart, apart), rtol=2e-3)
    allowed = solver.allowance(tuple(dots.tolist()), tuple(variances.tolist()))
    assert allowed is not None
    np.testing.assert_allclose(allowed, np.outer(apart, apart), rtol=2e-3)
    want = make_solver('beam', Geometry(geometry.centers, geometry.zeros, geometry.heights, 0.585, 0.75))
    args = tuple(dots.tolist()), tuple(variances.tolist())
    np.testing.assert_allclose(solver.gain(*args, got), want.gain(*args, want.solve(*args)), rtol=1e-12)


def test_who_can_do_with_fewer_psds() -> None:
    """Every method that needs no third; minimum_tilt takes two at height 0 and no others; one PSD gives no twist."""
    rig = of_three()
    for name in ('exact', 'beam', 'wls', 'ols', 'iterative', 'wls_exact'):
        pair = subset_solver(name, rig, [1, 2])
        assert pair is not None
        assert pair.name == name
        assert pair.allowance((0.0,) * 4, VARIANCES[:4]) is None
    assert subset_solver('minimum_tilt', rig, [1, 2]) is None
    assert subset_solver('pose', rig, [1]) is None
    assert subset_solver('exact', rig, [1]) is None
    three = subset_solver('pose', rig, [0, 1, 2])
    assert three is not None
    assert three.tilts == 'free'


def test_where_the_psds_are_is_reported_once() -> None:
    """PSDs nearer to the base than to the tip are at the base; halfway they may still be at the tip."""
    check_arrangement(rig_from_values({'link.length': 0.5, 'psd_1.height': -0.25}))
    with pytest.raises(ConfigError, match=r'psd_2\.height = -0\.251 m: that is nearer to the base'):
        check_arrangement(rig_from_values({'link.length': 0.5, 'psd_2.height': -0.251}))
    base = {'solver': 'base_pair', 'solvers': ['base_pair'], 'psd_1.height': -0.585, 'psd_2.height': -0.485}
    check_arrangement(rig_from_values({**base, 'degraded': 'none'}))
    with pytest.raises(ConfigError, match='one PSD at the base gives no pose'):
        check_arrangement(rig_from_values({**base, 'degraded': 'hold'}))
    for values, names in (
        ({**base, 'solvers': ['base_pair', 'wls']}, 'wls'),
        ({'solvers': ['base_pair']}, 'base_pair'),
    ):
        with pytest.raises(ConfigError, match=f'; {names} of solvers have not'):
            check_arrangement(rig_from_values({**values, 'degraded': 'none'}))


def test_arrangement_comes_from_rig_or_solver_name() -> None:
    """Said by the rig, it is not changed by the name of a solver: that is rejected with the lines to write."""
    base = {'psd_1.height': -0.585, 'psd_2.height': -0.485, 'solver': 'base_pair', 'solvers': ['base_pair']}
    for more, at_base in (({}, True), ({'arrangement': 'base'}, True), ({'arrangement': 'tip'}, False)):
        assert rig_from_values({**base, **more}).psds_at_base is at_base
    assert rig_from_values({'arrangement': 'base'}).psds_at_base
    assert not rig_from_values({'solvers': ['base_pair']}).psds_at_base
    check_arrangement(rig_from_values({**base, 'arrangement': 'base'}))
    for values, lines in (
        (
            {**base, 'arrangement': 'tip'},
            r"'base_pair' takes PSDs at the base: set solver: exact and solvers: \[exact\]",
        ),
        ({'arrangement': 'base'}, r"'exact' takes PSDs at the tip: set solver: base_pair and solvers: \[base_pair\]"),
    ):
        rig = rig_from_values(values)
        with pytest.raises(ConfigError, match=lines):
            check_arrangement(rig)
        with pytest.raises(SolverError, match=f'the rig file has arrangement: {values["arrangement"]}'):
            solver_from_rig(rig.estimator.solver, rig)


def test_options_come_from_the_rig_file() -> None:
    """Each has another answer, or another rejection, than the default."""
    base = {'solver': 'base_pair', 'solvers': ['base_pair'], 'degraded': 'none'}
    rig = rig_from_values({**base, 'psd_1.height': -0.585, 'psd_2.height': -0.485, 'base_pair.assume': 'no_twist'})
    dots = (1e-3, -2e-3, 5e-4, 1e-3)
    message = solver_from_rig('base_pair', rig).solve(dots, VARIANCES[:4])
    assert message == make_solver('base_pair', Geometry.from_rig(rig), assume='no_twist').solve(dots, VARIANCES[:4])
    assert message != make_solver('base_pair', Geometry.from_rig(rig)).solve(dots, VARIANCES[:4])
    rig = rig_from_values({'minimum_tilt.angles': 'azimuth'})
    spots = (1e-3, 2e-3, -1e-3, -3e-3)
    message = solver_from_rig('minimum_tilt', rig).solve(spots, VARIANCES[:4])
    assert message == make_solver('minimum_tilt', Geometry.from_rig(rig), angles='azimuth').solve(spots, VARIANCES[:4])
    assert message.theta != make_solver('minimum_tilt', Geometry.from_rig(rig)).solve(spots, VARIANCES[:4]).theta
    two = {'psd_1.height': 0.02, 'psd_2.height': -0.03}
    for effect, in_dots in (({}, True), ({'effects.t.name': 'plane_tilt', 'effects.t.slope_ratio': 1.5}, False)):
        rig = rig_from_values({**two, **effect})
        message = solver_from_rig('beam', rig).solve(dots, VARIANCES[:4])
        assert message == make_solver('beam', Geometry.from_rig(rig), tilt_in_dots=in_dots).solve(dots, VARIANCES[:4])
    # An effect that does not say how the plate leans leaves the tilts in, and so does one that says it does not.
    for effect in (
        {'effects.g.name': 'sensor_gain', 'effects.g.psd': 1, 'effects.g.x': 0.01},
        {'effects.t.name': 'plane_tilt', 'effects.t.slope_ratio': 0.0},
    ):
        assert solver_class('beam').options_from_rig(rig_from_values({**two, **effect})) == {'tilt_in_dots': True}


def test_quarter_rotation_leaves_stationary_start() -> None:
    """Each dot is a quarter turn from its beam, without rounding: at angle 0 the agreement is exactly 0."""
    centers = np.array([[0.125, 0.0], [-0.125, 0.0]])
    geometry = Geometry(centers, np.zeros((2, 2)), np.zeros(2), 0.585)
    solution = make_solver('iterative', geometry).solve((-0.125, -0.125, 0.125, 0.125), VARIANCES[:4])
    assert solution.status is SolverStatus.OK
    assert solution[:3] == pytest.approx((0.0, 0.0, np.pi / 2.0), abs=1e-14)


def test_the_thesis_weights_are_of_two_psds() -> None:
    third = {'psd_3.center': [0.08, -0.06]}
    for name in ('wls', 'wls_exact'):
        solver_from_rig(name, rig_from_values({**third}))
        solver_from_rig(name, rig_from_values({'wls.weights': 'thesis'}))
        with pytest.raises(ConfigError, match='its weights are of two PSDs, the rig has 3'):
            solver_from_rig(name, rig_from_values({**third, 'wls.weights': 'thesis'}))


def test_three_psds_at_the_base_in_two_planes_give_five_unknowns(rays: Any) -> None:
    geometry = Geometry(
        np.array([[0.01, 0.07], [-0.1, 0.02], [0.05, -0.06]]),
        np.array([[3e-4, -2e-4], [1e-4, 5e-4], [0.0, 1e-4]]),
        np.array([-0.585, -0.385, -0.485]),
        0.585,
    )
    five = (1e-3, -2e-3, 0.01, 0.004, -0.006)
    dots = tuple(np.asarray(rays.base_dots(geometry, five)).tolist())
    got = make_solver('base_pair', geometry, assume='nothing').solve(dots, VARIANCES)
    assert got.status is SolverStatus.OK
    assert got[:5] == pytest.approx(five, abs=1e-12)


def test_beam_without_tilt_in_dots_is_flat_with_tilts() -> None:
    """Dots whose tilts a correction has taken off, on surfaces at heights."""
    dots = (1e-3, -2e-3, 5e-4, 1e-3)
    flat = make_solver('exact', RAISED).solve(dots, VARIANCES[:4])
    got = make_solver('beam', RAISED, tilt_in_dots=False).solve(dots, VARIANCES[:4])
    assert got[:3] == pytest.approx(flat[:3], abs=1e-12)
    k = RAISED.slope_ratio / RAISED.link_length
    assert got[3:5] == pytest.approx((-k * flat.dy, k * flat.dx), rel=1e-9)
    np.testing.assert_allclose(got.covariance, flat.covariance, rtol=1e-6, atol=1e-18)
    assert make_solver('beam', RAISED).solve(dots, VARIANCES[:4])[:3] != pytest.approx(flat[:3], abs=1e-6)


def test_a_sine_is_inadmissible_from_one_on_in_either_direction() -> None:
    """Readings that turn more and more: an angle, and beyond a quarter turn none."""
    solver = make_solver('wls_exact', TWO)
    for way in (1.0, -1.0):
        message = [solver.solve((0.0, 0.0, 0.0, way * y), VARIANCES[:4]).status for y in np.linspace(0.01, 0.6, 60)]
        ends = message.index(SolverStatus.INADMISSIBLE)
        assert 3 < ends < 30
        assert message == [SolverStatus.OK] * ends + [SolverStatus.INADMISSIBLE] * (60 - ends)
