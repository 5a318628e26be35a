# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every kind of target must do: its print, photographed, is found again; the discs, within what is claimed."""

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from blind.render import Pose, Scene, board, camera_of, developed, mean_of, over_exposure, photograph
from psd_deflection.base.errors import ConfigError
from psd_deflection.camera import boards
from psd_deflection.camera.answer import FrameAnswer, Status
from psd_deflection.camera.boards import Board
from psd_deflection.camera.intrinsics import calibrated
from psd_deflection.camera.lens import Lens
from psd_deflection.camera.pictures import printed
from psd_deflection.camera.reference import CameraReference
from psd_deflection.camera.settings import SETTINGS, TARGETS, CameraSettings, target_class
from psd_deflection.camera.target import Target, target_of

SCENE = Scene(width=640, height=480, focal=2000.0, centre=(325.0, 236.0), distance=0.42)
MOVED = Pose(2e-3, -1e-3, math.radians(2.0), 0.02, -0.01)
DOTS_PER_METRE = 600 / 0.0254
CAPTION = round(0.012 * DOTS_PER_METRE)
"""Rows of the paper below the target that have no counterpart above it."""


def settings_of(kind: str) -> CameraSettings:
    return CameraSettings(target=kind, matrix=tuple(SCENE.matrix), rest_frames=1)


def paper_of(target: Target) -> Any:
    return cv2.imdecode(np.frombuffer(printed(target, 'png'), np.uint8), cv2.IMREAD_GRAYSCALE)


def found_again(settings: CameraSettings, make: type[Target]) -> None:
    """Fail unless the printed target is found where it is, and no target on an empty plate."""
    target, rng = make(settings), np.random.default_rng(3)
    paper = paper_of(target)
    white = paper[:-CAPTION] / 255.0
    size = (white.shape[1] / DOTS_PER_METRE, white.shape[0] / DOTS_PER_METRE)

    def photographed(pose: Pose, texture: Any) -> Any:
        return developed(SCENE, board(SCENE, pose, texture, size), rng)

    reference = CameraReference(settings, make)
    answers = reference.take(0, photographed(Pose(), white))
    answers += reference.take(1, photographed(MOVED, white))
    answers += reference.take(2, photographed(MOVED, np.ones((2, 2))))
    assert [a.status is Status.OK for a in answers] == [True, True, False]
    answer = answers[1]
    off = np.array([answer.dx - MOVED.dx, answer.dy - MOVED.dy, answer.theta - MOVED.theta])
    assert np.all(np.abs(off) < [20e-6, 20e-6, math.radians(0.05)]), off
    assert answer.covariance is not None
    assert np.all(np.abs(off) < 5.0 * np.sqrt(np.diag(answer.covariance))), off


@pytest.mark.slow
@pytest.mark.parametrize('kind', TARGETS)
def test_a_printed_target_is_found_again(kind: str) -> None:
    found_again(settings_of(kind), target_class(kind))


@pytest.mark.parametrize('kind', TARGETS)
def test_a_target_describes_itself_by_its_own_settings(kind: str) -> None:
    target = target_of(settings_of(kind))
    assert target.kind == kind
    names = [line.split(':')[0] for line in target.describe()]
    assert names == ['target.kind', *(SETTINGS.parameters[name].name for name in target.fields)]
    assert all(name.startswith('target.') for name in names)
    # They make the same target again, and each of them is a setting that somebody has.
    values = dict(line.split(': ') for line in target.describe())
    same = SETTINGS.read({**values, 'camera.matrix': SCENE.matrix} | _numbers(values), 'as printed')
    assert target_of(same).describe() == target.describe()


def _numbers(values: dict[str, str]) -> dict[str, object]:
    kinds = {p.name: p.kind for p in SETTINGS.parameters.values()}
    read = {'double': float, 'integer': int}
    return {name: read[kinds[name]](text) for name, text in values.items() if kinds[name] in read}


def test_every_size_in_the_settings_is_of_some_kind() -> None:
    declared = {f'{SETTINGS.parameters[name].name}' for kind in TARGETS for name in target_class(kind).fields}
    sizes = {p.name for p in SETTINGS.parameters.values() if p.name.startswith('target.')}
    assert sizes - declared == {'target.kind'}
    # Each of them may be set while the node runs.
    assert [p.name for p in SETTINGS.parameters.values() if not p.live] == ['frame_prefix']


SMALL = Scene(width=400, height=320, focal=1000.0, centre=(195.0, 162.0), distance=0.25, distortion=(-0.1, 0.05))
OF_SMALL = CameraSettings(matrix=tuple(SMALL.matrix), distortion=(-0.1, 0.05, 0.0, 0.0))
BOARD = replace(OF_SMALL, target='charuco', columns=5, rows=5)
TAGS = replace(BOARD, target='apriltag', columns=3, rows=3, marker=0.014, gap=0.005)


def status_of(settings: CameraSettings, image: Any) -> Status:
    """Of the first frame."""
    (answer,) = CameraReference(settings, target_of).take(0, image)
    return answer.status


def shot(scene: Scene, settings: CameraSettings, pose: Pose, rng: np.random.Generator) -> Any:
    target = target_of(settings)
    assert isinstance(target, Board)
    pixels = (round(target.size[0] * 2e4), round(target.size[1] * 2e4))
    texture = boards.picture(target.board, pixels) / 255.0
    return developed(scene, board(scene, pose, texture, target.size), rng)


@pytest.mark.parametrize(('settings', 'view'), [(BOARD, 'outside'), (TAGS, 'base')], ids=['charuco', 'apriltag'])
def test_a_board_is_found_again(settings: CameraSettings, view: str) -> None:
    scene, rng = replace(SMALL, view=view, roll=0.1), np.random.default_rng(3)
    settings = replace(settings, view=view, rest_frames=1)
    reference = CameraReference(settings, target_of)
    reference.take(0, shot(scene, settings, Pose(), rng))
    pose = Pose(2e-3, -1e-3, math.radians(100), 0.02, -0.01)
    (answer,) = reference.take(1, shot(scene, settings, pose, rng))
    assert answer.status is Status.OK
    assert answer.covariance is not None
    off = np.array([answer.dx - pose.dx, answer.dy - pose.dy, answer.theta - pose.theta])
    assert np.all(np.abs(off) < [10e-6, 10e-6, math.radians(0.02)]), off
    assert np.all(np.abs(off) < 5.0 * np.sqrt(np.diag(answer.covariance)))


def test_board_noise_is_pose_residual_over_freedom() -> None:
    """A pose takes six of the independent values; the residuals are those of OpenCV's projection."""
    board = target_of(BOARD)
    assert isinstance(board, Board)
    image = shot(SMALL, BOARD, Pose(0.0, 0.0, 0.1, 0.02, -0.01), np.random.default_rng(3))
    matrix, distortion = np.array(SMALL.matrix).reshape(3, 3), np.array(BOARD.distortion)
    located = board.locate(image, image, Lens(matrix, distortion), 255.0)
    # All of the corners of 5 x 5 squares.
    assert len(located.points) == 16
    assert located.residuals == 32
    apart = BOARD.square * (np.arange(4) - 1.5)
    corners = np.array([[x, y, 0.0] for x in apart for y in apart])
    rotvec, _ = cv2.Rodrigues(located.rotation)
    observed, _ = cv2.projectPoints(corners, rotvec, located.place, matrix, distortion)
    away = np.linalg.norm(observed - located.points, axis=2)
    # Each corner has its own, much nearer than the next.
    assert sorted(away.argmin(axis=0).tolist()) == list(range(16))
    squares = float(np.sum(away.min(axis=0) ** 2))
    assert located.noise**2 == pytest.approx(squares / (32 - 6), rel=0.005)


@pytest.mark.parametrize(('settings', 'free'), [(replace(BOARD, marker=0.008), 1e-3), (TAGS, 1.4e-3)])
def test_board_is_too_small_with_less_than_2_5_px_around_corners(settings: CameraSettings, free: float) -> None:
    for share, status in ((0.98, Status.OK), (1.02, Status.SMALL)):
        scene = replace(SMALL, distance=share * free * SMALL.focal / 2.5)
        image = shot(scene, settings, Pose(), np.random.default_rng(3))
        assert status_of(replace(settings, rest_frames=1), image) is status


def test_half_a_board_and_none_are_rejected() -> None:
    rng = np.random.default_rng(3)
    image = shot(SMALL, BOARD, Pose(), rng)
    hidden = image.copy()
    hidden[:, 150:] = 128
    assert status_of(BOARD, hidden) is Status.HIDDEN
    assert status_of(BOARD, np.full_like(image, 90)) is Status.MISSING


def test_tags_of_another_board_are_hidden_corners() -> None:
    """Tags of the dictionary, of which the board has none."""
    image = shot(SMALL, replace(TAGS, columns=4, rows=4, marker=0.012), Pose(), np.random.default_rng(3))
    image[:, :255] = image[:110] = 128
    assert status_of(TAGS, image) is Status.HIDDEN


def test_the_lens_is_found_again() -> None:
    scene, rng = replace(SMALL, distance=0.16, distortion=(-0.15, 0.05)), np.random.default_rng(7)
    tilts = [(0.4, 0.0), (-0.4, 0.1), (0.0, 0.4), (0.1, -0.4), (0.3, 0.3), (-0.3, -0.3)]
    images = [(f'{i}.png', shot(scene, BOARD, Pose(phi=a, omega=b), rng)) for i, (a, b) in enumerate(tilts)]
    fitted = calibrated(BOARD, [*images, ('broken.png', None)])
    assert (fitted.used, fitted.excluded) == (len(tilts), [('broken.png', 'unreadable image')])
    assert fitted.matrix[0, 0] == pytest.approx(scene.focal, rel=0.01)
    lens = Lens(fitted.matrix, fitted.distortion)
    true = Lens(np.array(scene.matrix).reshape(3, 3), np.array([-0.15, 0.05, 0, 0]))
    corner = np.array([[60.0, 60.0], [340.0, 260.0]])
    assert np.diff(lens.rays(corner), axis=0) == pytest.approx(np.diff(true.rays(corner), axis=0), rel=0.01)
    with pytest.raises(ConfigError, match='at least 5'):
        calibrated(BOARD, images[:2])


def test_opencv_agrees_about_distortion() -> None:
    distortion = np.array([-0.2, 0.1, 0.001, -0.002, 0.05, 0.01, -0.02, 0.003])
    matrix = np.array([[900.0, 0, 320], [0, 910, 240], [0, 0, 1]])
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 2))
    theirs, _ = cv2.projectPoints(np.column_stack([points, np.ones(50)]), np.zeros(3), np.zeros(3), matrix, distortion)
    lens = Lens(matrix, distortion)
    assert lens.pixels(points) == pytest.approx(theirs[:, 0], abs=1e-9)
    assert lens.rays(theirs[:, 0]) == pytest.approx(points, abs=1e-11)


def test_the_printed_discs_have_their_size() -> None:
    target = target_of(CameraSettings(spacing=0.02, radius=0.006))
    paper = paper_of(target)
    middle = paper.shape[1] // 2
    edges = np.flatnonzero(np.diff((paper[:, middle] > 128).astype(int)))
    # White, black, three discs, white.
    rims = edges[1:7] / 600 * 0.0254
    assert np.diff(rims)[::2] == pytest.approx([0.012] * 3, abs=1e-4)
    assert np.diff(rims[::2]) == pytest.approx([0.02] * 2, abs=1e-4)
    assert target.describe() == ['target.kind: circles', 'target.spacing: 0.02', 'target.radius: 0.006']


@pytest.mark.parametrize('settings', [BOARD, TAGS], ids=['charuco', 'apriltag'])
def test_a_printed_board_is_read_again(settings: CameraSettings) -> None:
    target = target_of(settings)
    paper = paper_of(target)
    small = cv2.resize(paper, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA)
    reference = CameraReference(replace(settings, matrix=(), distortion=()), target_of)
    reference.take(0, small)
    (answer,) = reference.finish()
    assert answer.status is Status.OK
    assert printed(target, 'pdf').startswith(b'%PDF')


@pytest.mark.parametrize('kind', ['charuco', 'apriltag'])
@pytest.mark.parametrize(
    ('version', 'there'),
    [
        ('4.6.0', {}),  # Of PyPI: without opencv_contrib.
        ('4.5.4', {'CharucoBoard_create': None}),  # Its boards have other axes.
    ],
)
def test_an_opencv_without_boards_is_rejected_with_the_fix(
    kind: str, version: str, there: dict[str, None], monkeypatch: pytest.MonkeyPatch
) -> None:
    old = SimpleNamespace(__version__=version, aruco=SimpleNamespace(DICT_4X4_50=0, **there))
    monkeypatch.setattr(boards, 'opencv', lambda: old)
    words = rf'OpenCV {version} has no boards; target.kind {kind} .* virtual environment'
    with pytest.raises(ConfigError, match=words):
        target_of(CameraSettings(target=kind))


STILL = [Pose()] * 2


def circle_settings(scene: Scene) -> CameraSettings:
    made = CameraSettings(view=scene.view, spacing=scene.spacing, radius=scene.radius)
    return replace(made, matrix=tuple(scene.matrix), distortion=tuple(scene.distortion))


def measured(scene: Scene, poses: Sequence[Pose], settings: CameraSettings | None = None) -> list[FrameAnswer]:
    rng = np.random.default_rng(11)
    reference = CameraReference(settings or circle_settings(scene), target_of)
    out = []
    for number, pose in enumerate(poses):
        out += reference.take(number, photograph(scene, [pose], rng))
    return out + reference.finish()


def assert_within(answers: Sequence[FrameAnswer], poses: Sequence[Pose], sigmas: float = 5.0) -> None:
    """Each answer is right within its own covariance, and within what the project asks for."""
    assert [a.status for a in answers] == [Status.OK] * len(poses)
    for answer, pose in zip(answers, poses, strict=True):
        assert answer.covariance is not None
        off = np.array([answer.dx - pose.dx, answer.dy - pose.dy, answer.theta - pose.theta])
        assert np.all(np.abs(off) < sigmas * np.sqrt(np.diag(answer.covariance))), (off, answer)
        assert np.all(np.abs(off) < [10e-6, 10e-6, math.radians(0.03)])


SCENES = {
    'plain': Scene(),
    'from the base': Scene(view='base', roll=0.4),
    'turned': Scene(roll=-0.6),
    'wide lens': Scene(distortion=(-0.25, 0.12, 0.001, -0.0015), aim=(0.02, -0.002)),
    'oblique': Scene(tilt=(0.25, -0.3)),
    'uneven light': Scene(slope=(0.8, -0.5), shot_noise=0.15),
    'large': Scene(width=1920, height=1080, focal=5000.0, centre=(960.0, 520.0), blur=1.5),
}


@pytest.mark.parametrize('name', [*list(SCENES)[:-1], pytest.param('large', marks=pytest.mark.slow)])
def test_a_rendered_motion_is_found_again(name: str) -> None:
    moved = [Pose(3e-3, -2e-3, 0.05, 0.01, -0.008), Pose(-4e-3, 3e-3, 0.3, -0.01, 0.01)]
    assert_within(measured(SCENES[name], STILL + moved), STILL + moved)


def test_theta_has_four_quadrants() -> None:
    poses = STILL + [Pose(theta=math.radians(a)) for a in (50, 100, 150, 179)]
    assert_within(measured(Scene(), poses), poses)


def test_a_tilt_of_the_plate_is_observed_and_does_not_turn_theta() -> None:
    poses = [*STILL, Pose(theta=0.1, phi=0.12, omega=-0.1)]
    answer = measured(Scene(tilt=(0.2, 0.1)), poses)[-1]
    assert answer.theta == pytest.approx(0.1, abs=5e-4)
    assert [answer.phi, answer.omega] == pytest.approx([0.12, -0.1], abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize('tilt', [(0.0, 0.0), (0.1, -0.08)], ids=['frontal', 'from the side'])
def test_reported_error_without_lens_has_its_true_size(tilt: tuple[float, float]) -> None:
    """The mirrored tilt is no error of dX, dY or theta, and perspective is seen without knowing the focal length."""
    rng = np.random.default_rng(8)
    shifts = rng.uniform(-3e-3, 3e-3, (10, 2)).tolist()
    moved = [Pose(x, y, rng.uniform(-0.05, 0.05), -2.6 * y, 2.6 * x) for x, y in shifts]
    settings = CameraSettings(spacing=0.025, radius=0.008, rest_frames=2)
    answers = measured(Scene(roll=0.2, tilt=tilt), STILL + moved, settings)[2:]
    assert_within(answers, moved, 4.0)
    sd = np.sqrt(np.diagonal(np.array([a.covariance for a in answers]), axis1=1, axis2=2))
    off = np.array([[a.dx - p.dx, a.dy - p.dy, a.theta - p.theta] for a, p in zip(answers, moved, strict=True)])
    assert 0.4 < np.sqrt(np.mean((off / sd) ** 2)) < 1.6
    assert np.all(np.median(sd, axis=0) < [1.5e-6, 1.5e-6, math.radians(0.01)]), sd


def test_without_a_lens_the_distance_is_not_known_to_1_um() -> None:
    """Its picture away from the middle of the image moves as that of a displacement does."""
    scene, closer = Scene(aim=(0.01, 0.0)), Pose(z=0.04)
    settings = CameraSettings(spacing=0.025, radius=0.008, rest_frames=2)
    answer = measured(scene, [*STILL, closer], settings)[-1]
    assert answer.covariance is not None
    assert 0.5e-3 < abs(answer.dx) < 3.0 * math.sqrt(answer.covariance[0, 0])


def test_the_mean_over_the_exposure_is_what_counts() -> None:
    """A link at its turning point: the middle of the exposure is not the mean, the blur is not symmetric."""

    def motion(t: float) -> Pose:
        return Pose(4e-3 * math.cos(2 * math.pi * 14.0 * t))

    scene, rng = Scene(), np.random.default_rng(5)
    poses = over_exposure(motion, 0.0, 8e-3, 24)
    reference = CameraReference(circle_settings(scene), target_of)
    for number in range(2):
        reference.take(number, photograph(scene, [Pose()], rng))
    (*_, answer) = reference.take(2, photograph(scene, poses, rng))
    mean = mean_of(poses)[0]
    assert abs(mean - poses[12].dx) > 50e-6
    assert abs(answer.dx - mean) < 10e-6
    assert answer.target is not None
    assert answer.covariance is not None
    # A fifth of the motion's standard deviation, px, but for what is no motion, is unsure.
    metre, moved = scene.distance / scene.focal, answer.target.blur / math.sqrt(12.0)
    assert moved * metre == pytest.approx(np.std([p.dx for p in poses]), rel=0.1)
    assert math.sqrt(answer.covariance[0, 0]) == pytest.approx(0.2 * (moved - 0.15) * metre, rel=0.05)


def test_defocus_of_oblique_view_moves_no_plate() -> None:
    """The blur along a bent rim moves it, more at the ends of an ellipse than at its sides."""
    scene, rng = Scene(tilt=(0.29, 0.15), blur=0.5, read_noise=0.5), np.random.default_rng(4)
    reference = CameraReference(replace(circle_settings(scene), rest_frames=2), target_of)
    for number in range(2):
        reference.take(number, photograph(scene, [Pose()], rng))
    (answer,) = reference.take(2, photograph(replace(scene, blur=5.5), [Pose(1e-3, 1e-3)], rng))
    assert answer.status is Status.OK
    assert math.hypot(answer.dx - 1e-3, answer.dy - 1e-3) < 30e-6


def test_saturating_disc_tilts_plate_within_its_sd() -> None:
    scene = Scene(focal=1500.0, white=240.0, slope=(0.0, 0.45), tilt=(0.15, 0.06), blur=1.0, read_noise=0.9)
    rng = np.random.default_rng(6)
    reference = CameraReference(replace(circle_settings(scene), rest_frames=1), target_of)
    (answer,) = reference.take(0, photograph(scene, [Pose()], rng))
    assert answer.target is not None
    off = camera_of(scene)[0].T @ answer.target.rotation
    tilt, sd = abs(off[2, 1]), math.sqrt(answer.target.covariance[0, 0])
    assert 1e-3 < tilt < 2.0 * sd


def test_of_two_mirrored_tilts_the_right_one_is_taken() -> None:
    """With weak perspective a plate tilted to the other side looks much the same."""
    scene = Scene(focal=1200.0, distance=0.49, tilt=(0.0, -0.145), blur=1.8, white=146.0, read_noise=5.9)
    for seed in range(6):
        reference = CameraReference(replace(circle_settings(scene), rest_frames=1), target_of)
        reference.take(0, photograph(scene, [Pose()], np.random.default_rng(seed)))
        assert reference.rest is not None
        off = camera_of(scene)[0].T @ reference.rest.rotation
        assert abs(off[0, 2]) < min(0.05, 5.0 * math.sqrt(reference.rest.covariance[1, 1]))


def test_a_small_thing_beside_a_disc_is_noticed_in_a_large_image() -> None:
    scene = SCENES['large']
    image = photograph(scene, [Pose()], np.random.default_rng(8))
    rows, columns = np.mgrid[: scene.height, : scene.width]
    middle = 960 + 100 + 30
    image[np.hypot(columns - middle, rows - 520) < 24] = 200
    assert status_of(circle_settings(scene), image) is Status.DOUBLED


@pytest.mark.parametrize(
    ('status', 'scene'),
    [
        (Status.MISSING, Scene(discs=0)),
        (Status.HIDDEN, Scene(discs=2)),
        (Status.HIDDEN, Scene(hide=((280.0, 90.0, 300.0, 110.0),))),
        (Status.OUTSIDE, Scene(aim=(0.0, 0.03))),
        (Status.DOUBLED, Scene(discs=4, radius=0.006, spacing=0.018)),
        (Status.SMALL, Scene(distance=2.81)),  # A radius of 5.7 px.
        (Status.DEFOCUSED, Scene(blur=9.0)),
        (Status.OBLIQUE, Scene(tilt=(0.0, 1.06))),
        (Status.OK, Scene(tilt=(0.0, 1.03))),  # 59 degrees.
        (Status.SATURATED, Scene(black=60.0, white=900.0)),
    ],
)
def test_what_cannot_be_measured_is_rejected_with_the_reason(status: Status, scene: Scene) -> None:
    (answer,) = measured(scene, [Pose()])
    assert (answer.status, answer.covariance is None) == (status, status is not Status.OK)


@pytest.mark.parametrize(('moved', 'right', 'wrong'), [(0.0, 0.03, 0.05), (0.4e-3, 0.06, 0.075)])
def test_light_in_waves_fits_no_target(moved: float, right: float, wrong: float) -> None:
    """By a share of the light that is larger for a motion, whose profile is not known."""
    scene = Scene()
    image = photograph(scene, [Pose(dx=moved * i / 12) for i in range(12)], np.random.default_rng(1))
    for share, status in ((right, Status.OK), (wrong, Status.MISFIT)):
        waves = np.rint(np.clip(image * (1.0 + share * np.cos(np.arange(scene.width) / 3.0)), 0, 255))
        assert status_of(replace(circle_settings(scene), rest_frames=1), waves.astype(np.uint8)) is status


def test_one_white_pixel_saturates_no_disc() -> None:
    """The rises are uneven enough for it, but of a thousand pixels one is at full scale."""
    scene = Scene(blur=1.5)
    image = photograph(scene, [Pose()], np.random.default_rng(1)).astype(float)
    white = (image - image.min()) / np.ptp(image)
    uneven = np.rint(image + 12.0 * (4.0 * white * (1.0 - white)) ** 8).astype(np.uint8)
    uneven.flat[np.argmin(np.abs(white - 0.9))] = 255
    assert status_of(replace(circle_settings(scene), rest_frames=1), uneven) is Status.OK


def test_two_places_in_one_exposure_are_not_a_motion() -> None:
    image = photograph(Scene(), [Pose(), Pose(dx=1.5e-3)], np.random.default_rng(2))
    assert status_of(circle_settings(Scene()), image) is Status.GHOST
