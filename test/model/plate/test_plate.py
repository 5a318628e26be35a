# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pose to dots and back, lasers on the plate, beams that lean: against rays in space, and golden readings."""

from typing import Any

import numpy as np
import pytest

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate import Geometry
from psd_deflection.model.plate import plate as module
from psd_deflection.model.plate.landing import landing, landings
from psd_deflection.model.plate.layout import bend, check_shapes, check_twist, tip_boxes
from psd_deflection.model.plate.linear import condition_number, design_matrix, error_bound, gain_matrix
from psd_deflection.model.plate.rays import hit, lifted, rotation
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.thesis.appendix_d import printed_design_matrix
from psd_deflection.studies.thesis.comparison import DIRECT, SIDEBAR, printed_bound

POSES = np.random.default_rng(5).normal(size=(6, 5)) * [0.003, 0.003, 0.05, 0.02, 0.02]
STAGGERED = Geometry(
    np.array([[0.0, 0.070], [-0.100, 0.0], [0.03, -0.05]]),
    np.array([[7e-5, -5e-5], [-3e-5, 4e-5], [1e-4, 0.0]]),
    np.array([0.05, -0.02, 0.01]),
    0.585,
)


@pytest.mark.parametrize('case', [f'G{i}' for i in range(1, 12)])
def test_golden_readings(golden: Any, case: str) -> None:
    dx, dy, _, theta, phi, omega = golden.cases[case]['pose']
    geometry = golden.geometry(case)
    points = module.plate_points(np.array([dx, dy, theta, phi, omega]), geometry.beams, geometry.heights)
    assert (points - geometry.centers).ravel() == pytest.approx(np.array(golden.dots(case)), abs=1e-15)


def test_the_dots_are_where_the_rays_meet_the_plate(rays: Any) -> None:
    expected = np.array([rays.tip_dots(STAGGERED, pose) for pose in POSES]).reshape(6, 3, 2) + STAGGERED.centers
    beams, heights = STAGGERED.beams, STAGGERED.heights
    points, jacobian = module.crossings(POSES, beams, heights)
    assert points == pytest.approx(expected, abs=1e-15)
    np.testing.assert_array_equal(module.plate_points(POSES, beams, heights), points)
    np.testing.assert_array_equal(
        np.stack(
            module.points_under((beams[:, 0], beams[:, 1], heights), tuple(np.moveaxis(POSES[..., None], 1, 0))),
            axis=-1,
        ),
        points,
    )
    for i in range(len(POSES)):
        dx, dy, theta, phi, omega = POSES[i].tolist()
        for j in range(3):
            lx, ly = beams[j].tolist()
            qx, qy, row_x, row_y = module.crossing((lx, ly, float(heights[j])), (dx, dy, theta, phi, omega))
            assert (qx, qy) == pytest.approx(points[i, j], abs=1e-16)
            assert np.array([row_x, row_y]) == pytest.approx(jacobian[i, j], abs=1e-14)
    many = np.broadcast_to(beams, (6, 3, 2))
    np.testing.assert_array_equal(module.crossings(POSES, many, heights)[1], jacobian)


def test_derivatives_agree_with_differences() -> None:
    step = 1e-6
    beams, heights = STAGGERED.beams, STAGGERED.heights
    moved = [
        (module.plate_points(POSES + d, beams, heights) - module.plate_points(POSES - d, beams, heights)) / (2.0 * step)
        for d in step * np.eye(5)
    ]
    jacobian = module.crossings(POSES, beams, heights)[1]
    assert jacobian == pytest.approx(np.stack(moved, axis=-1), abs=1e-9)
    pushed = [
        (module.plate_points(POSES, beams + d, heights) - module.plate_points(POSES, beams - d, heights)) / (2.0 * step)
        for d in step * np.eye(2)
    ]
    assert -jacobian[..., :2] == pytest.approx(np.stack(pushed, axis=-1), abs=1e-9)


def test_a_flat_pose_comes_back(rays: Any) -> None:
    flat = POSES * [1.0, 1.0, 20.0, 0.0, 0.0]
    level = Geometry(STAGGERED.centers, STAGGERED.zeros, np.zeros(3), 0.585)
    # Unless it is given that of a beam with a force at its end: L^2/2 over L^3/3.
    assert level.slope_ratio == (1 / 2) / (1 / 3)
    points = np.array([rays.tip_dots(level, pose) for pose in flat]).reshape(6, 3, 2) + level.centers
    assert module.flat_points(flat[:, :3], level.beams) == pytest.approx(points, abs=1e-15)
    assert module.flat_poses(points, level.beams) == pytest.approx(flat[:, :3], abs=1e-14)
    places = [(x, y) for x, y in level.beams.tolist()]
    for i in range(6):
        assert module.flat_pose(points[i].ravel().tolist(), places) == pytest.approx(flat[i, :3], abs=1e-14)


def test_beams_and_surfaces_of_any_direction(rays: Any) -> None:
    """Inclined beams on sensors that are turned in the plate, by the simulator and by ``rays``."""
    rolls, directions = [0.02, -0.01, 0.0], np.array([[0.01, 0.0, 1.0], [0.0, -0.02, 1.0], [0.005, 0.005, 1.0]])
    pose = POSES[0]
    expected = rays.tip_dots(STAGGERED, pose, directions=directions, rolls=rolls).reshape(3, 2)
    sensors = rotation(np.array(rolls), 0.0, 0.0)
    plate = rotation(*pose[2:])
    assert plate == pytest.approx(rays.rotation(*pose[2:]), abs=1e-15)
    centers = lifted(STAGGERED.centers, STAGGERED.heights)
    start = centers + np.einsum('pij,pj->pi', sensors[..., :2], STAGGERED.zeros)
    got = hit(start, directions, centers @ plate.T + [pose[0], pose[1], 0.0], plate @ sensors)
    assert got == pytest.approx(expected, abs=1e-15)


def test_the_tie_is_the_cantilevers() -> None:
    pose = np.array([0.00012, -0.00225, 0.01])
    tied = module.tied_pose(pose, 1.5, 0.585)
    assert tied == pytest.approx(module.tie_matrix(1.5, 0.585) @ pose, rel=1e-15)
    # Golden case G5: phi 0.33055 deg, omega 0.017629 deg.
    assert np.degrees(tied[3:]) == pytest.approx([0.3305525741, 0.01762947062], rel=1e-9)


def test_many_poses_are_tied_one_by_one() -> None:
    flat = POSES[:, :3]
    for ratios in (1.5, np.linspace(1.0, 2.0, 6)):
        want = [module.tied_pose(p, k, 0.585) for p, k in zip(flat, np.broadcast_to(ratios, 6), strict=True)]
        np.testing.assert_array_equal(module.tied_pose(flat, ratios, 0.585), want)


def test_the_geometry_is_that_of_the_rig_file() -> None:
    values = {'psd_1.height': 0.02, 'psd_2.height': -0.01, 'psd_1.zero': [1e-3, 2e-3], 'link.length': 0.4}
    geometry = Geometry.from_rig(load_rig(overrides={**values, 'link.slope_ratio': 1.4, 'psd_2.center': [-0.09, 0.01]}))
    assert (geometry.heights.tolist(), geometry.centers.tolist()) == ([0.02, -0.01], [[0.0, 0.07], [-0.09, 0.01]])
    assert geometry.zeros.tolist() == [[1e-3, 2e-3], [0.0, 0.0]]
    assert (geometry.link_length, geometry.slope_ratio) == (0.4, 1.4)


@pytest.mark.parametrize('tilts', ['none', 'tied', 'bounded', 'free'])
def test_readings_go_with_what_is_solved_for_as_differences_say(tilts: module.Tilts) -> None:
    """Of a flat plate whatever its heights and tilts; tied to the deflection; with tilts of their own."""
    pose, beams, k = np.array([2e-3, -3e-3, 0.04, 0.02, -0.03]), STAGGERED.beams, 1.4 / 0.585
    heights = np.zeros(3) if tilts == 'none' else STAGGERED.heights

    def readings(change: Any) -> Any:
        if tilts == 'free':
            moved = change
        else:
            tie = 0.0 if tilts == 'none' else k
            moved = np.array([*change, -tie * change[1], tie * change[0]])
        at = np.array([*pose[:3], 0.0, 0.0]) if tilts == 'none' else pose
        return module.plate_points(at + moved, beams, heights).ravel()

    steps = 1e-6 * np.eye(5 if tilts == 'free' else 3)
    want = np.stack([(readings(e) - readings(-e)) / 2e-6 for e in steps], axis=1)
    got = module.reading_slopes(beams, STAGGERED.heights, pose, tilts, 1.4, 0.585)
    np.testing.assert_allclose(got, want, atol=1e-8)


LANDED = np.array([[1e-3, -2e-3, 0.05, 0.02, -0.03], [0.0, 0.0, -0.3, -0.2, 0.25], [2e-3, 1e-3, 0.1, 0.15, 0.1]])
PLACE = (0.03, -0.08)


@pytest.mark.parametrize('pose', LANDED)
@pytest.mark.parametrize('height', [0.0, 0.05])
def test_laser_on_plate_lands_where_ray_meets_surface(pose: np.ndarray, height: float) -> None:
    plate = rotation(*pose[2:])
    start = plate @ [*PLACE, 0.0] + [pose[0], pose[1], 0.0]
    want = hit(start, plate[:, 2], np.array([0.0, 0.0, height]), np.eye(3))
    x, y, by_x, by_y = landing((*PLACE, height), tuple(pose.tolist()))
    assert (x, y) == pytest.approx(want, abs=1e-15)
    lx, ly, h, dx, dy, theta, phi, omega = (np.asarray(v) for v in (*PLACE, height, *pose))
    many = landings((lx, ly, h), (dx, dy, theta, phi, omega))
    assert np.array(many) == pytest.approx(want, abs=1e-15)
    for i in range(5):
        step = 1e-6 * np.eye(5)[i]
        moved = [tuple((pose + s).tolist()) for s in (step, -step)]
        plus, minus = (np.array(landing((*PLACE, height), p)[:2]) for p in moved)
        assert (by_x[i], by_y[i]) == pytest.approx((plus - minus) / 2e-6, abs=1e-9)


@pytest.mark.parametrize('height', [-0.05, 0.0, 0.04])
def test_a_beam_that_leans_meets_the_plate_where_its_ray_does(height: float) -> None:
    pose, slopes = np.array([1e-3, -2e-3, 0.05, 0.03, -0.02]), (0.02, -0.01)
    plate = rotation(*pose[2:])
    origin = plate @ [0.0, 0.0, height] + [pose[0], pose[1], 0.0]
    want = hit(np.array([*PLACE, height]), np.array([*slopes, 1.0]), origin, plate)
    lx, ly, sx, sy, h, dx, dy, theta, phi, omega = (np.asarray(v) for v in (*PLACE, *slopes, height, *pose))
    got = module.points_under_leaning((lx, ly, h), (sx, sy), (dx, dy, theta, phi, omega))
    # Three passes, each of which leaves 6e-4 of the error before it, of 10 um at first.
    assert np.array(got) == pytest.approx(want, abs=3e-14)


@pytest.mark.parametrize(
    ('centers', 'heights', 'message'),
    [
        (np.zeros((2, 3)), 2, r'centers has shape \(2, 3\)'),
        (np.zeros(4), 2, r'centers has shape \(4,\)'),
        (np.zeros((1, 2)), 1, '1 PSD: one dot cannot tell'),
        (np.zeros((2, 2)), 3, 'must all be of the same 2 PSDs'),
        (np.full((2, 2), np.nan), 2, 'centers must be finite'),
    ],
)
def test_arrays_that_are_no_geometry_are_rejected(centers: np.ndarray, heights: int, message: str) -> None:
    with pytest.raises(SolverError, match=message):
        check_shapes(Geometry(centers, np.zeros(centers.shape), np.zeros(heights), 0.585))


def test_beams_closer_than_a_micrometre_are_rejected() -> None:
    """The rejection says where they are: at the first one's place."""
    for along in ((1.0, 0.0), (0.0, 1.0), (-0.6, 0.8)):
        for apart, message in ((0.9e-6, True), (1.1e-6, False)):
            centers = np.array([[0.01, 0.07], [0.01, 0.07]]) + np.array([[0.0, 0.0], along]) * apart
            geometry = Geometry(centers, np.zeros((2, 2)), np.zeros(2), 0.585)
            if message:
                with pytest.raises(SolverError, match=r'psd_1 and psd_2 coincide at \(0\.01, 0\.07\) m'):
                    check_twist(geometry)
            else:
                assert check_twist(geometry) == 2
    # Beams, not centres, count; and of three any two that differ.
    zeros = np.array([[0.0, 0.0], [1e-3, 0.0], [0.0, 0.0]])
    assert check_twist(Geometry(np.zeros((3, 2)), zeros, np.zeros(3), 0.585)) == 3
    with pytest.raises(SolverError, match='psd_1 and psd_2 and psd_3 coincide'):
        check_twist(Geometry(np.zeros((3, 2)), np.zeros((3, 2)), np.zeros(3), 0.585))


def test_the_link_bends_as_under_a_force_at_its_tip() -> None:
    """EI y'' = F (L - z), y(0) = y'(0) = 0: integrated twice, over the deflection of the tip."""
    z = np.linspace(0.0, 1.0, 2001)
    slope = np.concatenate([[0.0], np.cumsum((1.0 - (z[1:] + z[:-1]) / 2.0) * np.diff(z))])
    y = np.concatenate([[0.0], np.cumsum((slope[1:] + slope[:-1]) / 2.0 * np.diff(z))])
    np.testing.assert_allclose(bend(z), y / y[-1], atol=1e-6)


def test_the_plate_holds_the_detectors() -> None:
    plate, first, second = tip_boxes(load_rig(overrides={'psd_2.height': 0.02, 'psd_1.active_area': [0.008, 0.009]}))
    # Detectors at (0, 70) and (-100, 0) mm, 15 mm of plate around them and the axis.
    assert plate[0] == pytest.approx((-0.05, 0.035, 0.003))
    assert plate[1] == pytest.approx((0.13, 0.10, 0.004))
    assert first[0] == pytest.approx((0.0, 0.07, 0.0))
    assert first[1] == pytest.approx((0.008, 0.009, 0.002))
    assert second[0] == pytest.approx((-0.1, 0.0, 0.02))


@pytest.mark.slow
@pytest.mark.parametrize('scaling', [(1.0,) * 4, SIDEBAR, DIRECT])
@pytest.mark.parametrize('lacking', [0.0, 0.5e-3, 2e-3])
def test_no_error_exceeds_the_bound(golden: Any, scaling: Any, lacking: float) -> None:
    """Also with readings that no pose explains, where 4.33 fails (2.5 % of trials at 0.5 mm, 25 % at 2 mm)."""
    rng = np.random.default_rng(5)
    used = design_matrix(golden.geometry().beams)
    po = np.array(scaling)
    design_error = np.tile((2e-3, 2e-3, 1e-3), (4, 1))
    reading_error = np.full(4, 2e-6 + lacking)
    share = []
    for _ in range(400):
        pose = rng.uniform(-1, 1, 3) * (3e-3, 3e-3, 0.05)
        true = used + rng.choice([-1.0, 1.0], (4, 3)) * design_error
        observed = true @ pose + rng.choice([-1.0, 1.0], 4) * reading_error
        got = np.linalg.lstsq(po[:, None] * used, po * observed, rcond=None)[0]
        share.append(np.abs(got - pose) / error_bound(used, got, design_error, reading_error, po))
    assert np.max(share) <= 1.0
    assert (np.max(share, axis=0) > 0.5).all()


def test_the_sources_example(golden: Any) -> None:
    """50 N, R_1 and R_2 off by 1 mm, 2 um a reading: 4.33 says 3.868 (mm and rad added), truth is 0.00375."""
    design = design_matrix(golden.geometry().beams)
    pose = np.array([0.12e-3, -2.2272e-3, -0.016418])
    design_error = np.zeros((4, 3))
    design_error[0, 2] = design_error[3, 2] = 1e-3
    bound = error_bound(design, pose, design_error, np.full(4, 2e-6))
    # um, um, mrad: some micrometres for some micrometres.
    assert (bound[:2] < 50e-6).all()
    assert bound[2] < 0.5e-3
    assert printed_bound(design, pose, design_error, np.full(4, 2e-6)) == pytest.approx(3.868396, abs=1e-6)


@pytest.mark.parametrize(('unit', 'length'), [('mm', 1e-3), ('m', 1.0), ('scaled_0.1m', 0.1)])
def test_condition_number_in_stated_units(golden: Any, unit: str, length: float) -> None:
    want = golden.constants['cond'][unit]
    for design in (design_matrix(golden.geometry().beams), printed_design_matrix(golden.geometry())):
        got = condition_number(design, length)
        np.testing.assert_allclose([got.frobenius, got.two], [want['fro'], want['two']], rtol=1e-12)
        assert got.angle_length == length


@pytest.mark.parametrize(('which', 'key'), [('true', 'gain_true_mm'), ('printed', 'gain_code_mm')])
@pytest.mark.parametrize(('name', 'scaling'), [('ols', (1.0,) * 4), ('sidebar', SIDEBAR), ('direct', DIRECT)])
def test_gain_matrices(golden: Any, which: str, key: str, name: str, scaling: tuple[float, ...]) -> None:
    geometry = golden.geometry()
    design = design_matrix(geometry.beams) if which == 'true' else printed_design_matrix(geometry)
    got = gain_matrix(design, np.array(scaling)) * np.array([[1.0], [1.0], [1e-3]])
    np.testing.assert_allclose(got, golden.constants[key][name], rtol=0.0, atol=1e-11)
    if name == 'ols':
        np.testing.assert_allclose(gain_matrix(design), gain_matrix(design, np.ones(4)), rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize('unit', [1e-18, 1.0, 1e18])
def test_the_gain_does_not_depend_on_the_unit_of_length(golden: Any, unit: float) -> None:
    beams = golden.geometry().beams
    po = np.array([0.3, 0.5, 2.0, 0.4])
    design = np.array([row for x, y in beams for row in ([-1.0, 0.0, y], [0.0, -1.0, -x])])
    want = np.linalg.solve(design.T @ np.diag(po**2) @ design, design.T @ np.diag(po**2))
    got = gain_matrix(design_matrix(unit * beams), po) * np.array([[1.0], [1.0], [unit]])
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(('largest', 'finite'), [(0.05, True), (0.32, True), (0.34, False), (0.6, False)])
def test_bound_is_infinite_where_errors_can_hide_pose(largest: float, finite: bool) -> None:
    """An error e of each entry, a tenth of it of the angle's: |G| E has the eigenvalue 3 e."""
    design = design_matrix(np.array([[0.0, 0.1], [0.0, -0.1]]))
    gain = np.abs(np.linalg.pinv(design))
    errors = np.full((4, 3), largest)
    errors[:, 2] = largest * 0.1
    share = float(np.abs(np.linalg.eigvals(gain @ errors)).max())
    assert share == pytest.approx(3.0 * largest)
    bound = error_bound(design, np.array([1e-3, -2e-3, 0.01]), errors, np.full(4, -2e-6))
    assert np.isfinite(bound).all() == finite
    if finite:
        # The series of (I - K)^-1, added up.
        k, at = gain @ errors, gain @ (np.full(4, 2e-6) + errors @ np.array([1e-3, 2e-3, 0.01]))
        np.testing.assert_allclose(bound, sum(np.linalg.matrix_power(k, n) @ at for n in range(600)), rtol=1e-6)
