"""The thesis's three discs: what is rendered is found again, within what is claimed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from psd_deflection.camera.answer import FrameAnswer, Status
from psd_deflection.camera.reference import CameraReference
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.camera.targets import target_of
from test.camera.render import Pose, Scene, photograph

STILL = [Pose()] * 4


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


@pytest.mark.parametrize('name', SCENES)
def test_a_rendered_motion_is_found_again(name: str) -> None:
    moved = [Pose(3e-3, -2e-3, 0.05, 0.01, -0.008), Pose(-4e-3, 1e-3, -0.1), Pose(0.0, 4e-3, 0.3, -0.01, 0.01)]
    assert_within(measured(SCENES[name], STILL + moved), STILL + moved)


def test_theta_has_four_quadrants() -> None:
    poses = STILL + [Pose(theta=math.radians(a)) for a in (50, 100, 150, 179)]
    assert_within(measured(Scene(), poses), poses)


def test_a_tilt_of_the_plate_is_seen_and_does_not_turn_theta() -> None:
    poses = [*STILL, Pose(theta=0.1, phi=0.12, omega=-0.1)]
    answer = measured(Scene(tilt=(0.2, 0.1)), poses)[-1]
    assert answer.theta == pytest.approx(0.1, abs=5e-4)
    assert [answer.phi, answer.omega] == pytest.approx([0.12, -0.1], abs=0.01)
