# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The thesis's three discs: what is rendered is found again, within what is claimed."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from blind.render import Pose, Scene, camera_of, mean_of, over_exposure, photograph
from psd_deflection.camera.answer import FrameAnswer, Status
from psd_deflection.camera.reference import CameraReference
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.camera.target import target_of

STILL = [Pose()] * 2


def settings_of(scene: Scene) -> CameraSettings:
    return CameraSettings(
        matrix=tuple(scene.matrix),
        distortion=tuple(scene.distortion),
        view=scene.view,
        spacing=scene.spacing,
        radius=scene.radius,
    )


def measured(scene: Scene, poses: Sequence[Pose], settings: CameraSettings | None = None) -> list[FrameAnswer]:
    rng = np.random.default_rng(11)
    reference = CameraReference(settings or settings_of(scene), target_of)
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
    'from the base': Scene(view='base', turn=0.4),
    'turned': Scene(turn=-0.6),
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
    answers = measured(Scene(turn=0.2, tilt=tilt), STILL + moved, settings)[2:]
    assert_within(answers, moved, 4.0)
    sd = np.sqrt(np.diagonal(np.array([a.covariance for a in answers]), axis1=1, axis2=2))
    off = np.array([[a.dx - p.dx, a.dy - p.dy, a.theta - p.theta] for a, p in zip(answers, moved, strict=True)])
    assert 0.4 < np.sqrt(np.mean((off / sd) ** 2)) < 1.6
    assert np.all(np.median(sd, axis=0) < [1.5e-6, 1.5e-6, math.radians(0.01)]), sd


def test_without_a_lens_the_distance_is_not_known_to_1_um() -> None:
    """Its picture away from the middle of the image moves as that of a displacement does."""
    scene, near = Scene(aim=(0.01, 0.0)), Pose(z=0.04)
    settings = CameraSettings(spacing=0.025, radius=0.008, rest_frames=2)
    answer = measured(scene, [*STILL, near], settings)[-1]
    assert answer.covariance is not None
    assert 0.5e-3 < abs(answer.dx) < 3.0 * math.sqrt(answer.covariance[0, 0])


def test_the_mean_over_the_exposure_is_what_counts() -> None:
    """A link at its turning point: the middle of the exposure is not the mean, the blur is not symmetric."""

    def motion(t: float) -> Pose:
        return Pose(4e-3 * math.cos(2 * math.pi * 14.0 * t))

    scene, rng = Scene(), np.random.default_rng(5)
    poses = over_exposure(motion, 0.0, 8e-3, 24)
    reference = CameraReference(settings_of(scene), target_of)
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
    reference = CameraReference(replace(settings_of(scene), rest_frames=2), target_of)
    for number in range(2):
        reference.take(number, photograph(scene, [Pose()], rng))
    (answer,) = reference.take(2, photograph(replace(scene, blur=5.5), [Pose(1e-3, 1e-3)], rng))
    assert answer.status is Status.OK
    assert math.hypot(answer.dx - 1e-3, answer.dy - 1e-3) < 30e-6


def test_saturating_disc_tilts_plate_within_its_sd() -> None:
    scene = Scene(focal=1500.0, white=240.0, slope=(0.0, 0.45), tilt=(0.15, 0.06), blur=1.0, read_noise=0.9)
    rng = np.random.default_rng(6)
    reference = CameraReference(replace(settings_of(scene), rest_frames=1), target_of)
    (answer,) = reference.take(0, photograph(scene, [Pose()], rng))
    assert answer.target is not None
    off = camera_of(scene)[0].T @ answer.target.rotation
    tilt, sd = abs(off[2, 1]), math.sqrt(answer.target.covariance[0, 0])
    assert 1e-3 < tilt < 2.0 * sd


def test_of_two_mirrored_tilts_the_right_one_is_taken() -> None:
    """With weak perspective a plate tilted to the other side looks much the same."""
    scene = Scene(focal=1200.0, distance=0.49, tilt=(0.0, -0.145), blur=1.8, white=146.0, read_noise=5.9)
    for seed in range(6):
        reference = CameraReference(replace(settings_of(scene), rest_frames=1), target_of)
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
    reference = CameraReference(settings_of(scene), target_of)
    assert [a.status for a in reference.take(0, image)] == [Status.DOUBLED]


@pytest.mark.parametrize(
    ('status', 'scene'),
    [
        (Status.MISSING, Scene(discs=0)),
        (Status.HIDDEN, Scene(discs=2)),
        (Status.HIDDEN, Scene(hide=((280.0, 90.0, 300.0, 110.0),))),
        (Status.OUTSIDE, Scene(aim=(0.0, 0.03))),
        (Status.DOUBLED, Scene(discs=4, radius=0.006, spacing=0.018)),
        (Status.SMALL, Scene(distance=5.0)),
        (Status.DEFOCUSED, Scene(blur=9.0)),
        (Status.OBLIQUE, Scene(tilt=(0.0, 1.1))),
    ],
)
def test_what_cannot_be_measured_is_rejected_with_the_reason(status: Status, scene: Scene) -> None:
    (answer,) = measured(scene, [Pose()])
    assert (answer.status, answer.covariance) == (status, None)


@pytest.mark.parametrize(
    ('moved', 'right', 'wrong'), [(0.0, 0.03, 0.05), (0.4e-3, 0.06, 0.075)], ids=['still', 'moved']
)
def test_light_in_waves_fits_no_target(moved: float, right: float, wrong: float) -> None:
    """By a share of the light that is larger for a motion, whose profile is not known."""
    scene = Scene()
    image = photograph(scene, [Pose(dx=moved * i / 12) for i in range(12)], np.random.default_rng(1))
    for share, status in ((right, Status.OK), (wrong, Status.MISFIT)):
        waves = np.rint(np.clip(image * (1.0 + share * np.cos(np.arange(scene.width) / 3.0)), 0, 255))
        reference = CameraReference(replace(settings_of(scene), rest_frames=1), target_of)
        assert [a.status for a in reference.take(0, waves.astype(np.uint8))] == [status]


def test_an_overexposed_target_is_rejected() -> None:
    scene, rng = Scene(black=60.0, white=900.0), np.random.default_rng(1)
    reference = CameraReference(settings_of(scene), target_of)
    (answer,) = reference.take(0, photograph(scene, [Pose()], rng))
    assert answer.status == Status.SATURATED


def test_two_places_in_one_exposure_are_not_a_motion() -> None:
    scene, rng = Scene(), np.random.default_rng(2)
    reference = CameraReference(settings_of(scene), target_of)
    (answer,) = reference.take(0, photograph(scene, [Pose(), Pose(dx=1.5e-3)], rng))
    assert answer.status == Status.GHOST
