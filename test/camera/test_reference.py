# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The tip against its rest: pose and covariance of made targets, by finite differences and by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from psd_deflection.camera.answer import TargetPose
from psd_deflection.camera.reference import mean_pose, relative, relative_covariance
from psd_deflection.records import FloatArray


def target(turn: FloatArray, place: FloatArray, keystone: FloatArray, seed: int) -> TargetPose:
    """A target with a covariance that ties all of its numbers, of about 1 mrad, 0.1 mm, 1e-3 /m."""
    sizes = np.array([*[1e-3] * 3, *[1e-4] * 3, *[1e-3] * len(keystone)])
    root = sizes[:, None] * np.random.default_rng(seed).normal(size=(len(sizes), 2 * len(sizes)))
    rotation = Rotation.from_rotvec(turn).as_matrix()
    return TargetPose(
        rotation, place, root @ root.T, 0.0, 0, np.zeros((0, 2)), planar=keystone.size > 0, keystone=keystone
    )


def shifted(pose: TargetPose, by: FloatArray) -> TargetPose:
    """The pose after a small turn about its own axes, a shift, and a change of its keystone."""
    rotation = pose.rotation @ Rotation.from_rotvec(by[:3]).as_matrix()
    # _replace is public: the one of named tuples.
    return pose._replace(rotation=rotation, place=pose.place + by[3:6], keystone=pose.keystone + by[6:])


@pytest.mark.parametrize('keystone', [[], [0.2, -0.1]], ids=['with a lens', 'without'])
def test_covariance_is_that_of_small_changes_of_rest_and_pose(keystone: list[float]) -> None:
    """A rest that is tilted, so that its tilts turn theta; every reading tied to every other one."""
    perspective = np.array(keystone)
    rest = target(np.array([0.35, -0.25, 0.5]), np.array([0.02, -0.03, 0.6]), perspective, 1)
    # In the plane of the rest: what leaves it widens the covariance of a camera without a lens beyond this.
    pose = target(np.array([0.1, 0.4, 0.6]), rest.plane @ [0.004, 0.003, 1.0], 0.5 * perspective, 2)

    def changed(of: str, i: int, size: float) -> FloatArray:
        by = np.zeros(6 + perspective.size)
        by[i] = size
        return relative(shifted(rest, by), pose)[:3] if of == 'rest' else relative(rest, shifted(pose, by))[:3]

    expected = np.zeros((3, 3))
    for of, one in (('rest', rest), ('pose', pose)):
        slopes = [(changed(of, i, 1e-6) - changed(of, i, -1e-6)) / 2e-6 for i in range(6 + perspective.size)]
        by = np.column_stack(slopes)
        expected += by @ one.covariance @ by.T
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        relative_covariance(rest, pose) / np.outer(sd, sd), expected / np.outer(sd, sd), atol=1e-4
    )


def test_mean_pose_has_frame_covariance_over_count() -> None:
    frames = [target(np.full(3, 0.01 * i), np.array([0.0, 0.0, 0.5 + 0.001 * i]), np.zeros(0), i) for i in range(4)]
    mean = mean_pose(frames)
    np.testing.assert_allclose(mean.covariance, sum(f.covariance for f in frames) / 16.0, rtol=1e-12)
    np.testing.assert_allclose(mean.place, [0.0, 0.0, 0.5015])
    np.testing.assert_allclose(Rotation.from_matrix(mean.rotation).as_rotvec(), np.full(3, 0.015), atol=1e-9)
    assert np.linalg.det(mean.rotation) == pytest.approx(1.0)


def test_turns_and_tilts_are_those_of_one_rotation_in_its_order() -> None:
    """Of a rest that is turned itself: R = Ry(omega) Rx(phi) Rz(theta), moved along the axes of the rest."""
    rest = target(np.array([0.2, -0.3, 0.4]), np.array([0.01, 0.02, 0.7]), np.zeros(0), 1)
    own = Rotation.from_euler('YXZ', [0.05, -0.04, 0.3]).as_matrix()
    place = rest.place + rest.rotation @ [1e-3, -2e-3, 3e-3]
    found = relative(rest, rest._replace(rotation=rest.rotation @ own, place=place))
    np.testing.assert_allclose(found, [1e-3, -2e-3, 0.3, -0.04, 0.05], atol=1e-12)
