# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""From the target in each image to the tip in ``link_tip_rest``: the rest, the mean of the first good frames
(``rest.frames``; 0: those that do not differ by more than noise), is taken off, its variance in every covariance."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from psd_deflection.camera.answer import FrameAnswer, NoPoseError, Status, TargetPose
from psd_deflection.camera.lens import AFFINE_FOCAL, Lens
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.camera.target import Target
from psd_deflection.records import FloatArray

MOST_REST = 20
_STILL = 4.0
"""A frame belongs to the rest if each of dX, dY and theta is within so many sd of it."""

_MIDDLE = 0.1
"""How far the axis of a lens that is not known may pass from the middle of the image, in image widths."""


class CameraReference:
    """Images in, poses of the tip out. One target, one camera, one size of image."""

    def __init__(self, settings: CameraSettings, make: Callable[[CameraSettings], Target]) -> None:
        self._settings = settings
        self.target = make(settings)
        self._lens: Lens | None = None
        self._shape: tuple[int, int] = (0, 0)
        self._waiting: list[tuple[int, TargetPose | NoPoseError]] = []  # Bound: 20 MOST_REST, or twice rest.frames.
        self._rest: TargetPose | None = None

    @property
    def rest(self) -> TargetPose | None:
        """The target at rest, once it is known."""
        return self._rest

    @property
    def rotation(self) -> float:
        """How far the image of the plate at rest is turned clockwise, rad; NaN before the rest is known."""
        if self._rest is None:
            return math.nan
        up = self._rest.rotation[:, 1]
        return math.atan2(float(up[0]), -float(up[1]))

    @property
    def lens(self) -> Lens | None:
        """The lens, once an image has come."""
        return self._lens

    def take(self, t_ns: int, image: Any) -> list[FrameAnswer]:
        """Return the answers that are known now, in the order of the frames.

        ``t_ns``: middle of the exposure. ``image``: (rows, columns) of uint8 or uint16, None if it cannot be read,
        or the NoPoseError that says why.
        """
        pose: TargetPose | NoPoseError
        try:
            pose = self._locate(image)
        except NoPoseError as error:
            pose = error.with_traceback(None)
        # A frame without a target waits only behind one that waits for the rest.
        if self._rest is not None or (not self._waiting and isinstance(pose, NoPoseError)):
            return [self._answer(t_ns, pose)]
        self._waiting.append((t_ns, pose))
        good = [f for _, f in self._waiting if isinstance(f, TargetPose)]
        if self._settings.rest_frames:
            complete = len(good) >= self._settings.rest_frames
        else:
            complete = len(good) >= MOST_REST or (len(good) > 1 and not _still(good[:-1], good[-1]))
            if complete and len(good) < MOST_REST:
                good = good[:-1]
        if complete or len(self._waiting) > max(20 * MOST_REST, 2 * self._settings.rest_frames):
            return self._decide(good)
        return []

    def finish(self) -> list[FrameAnswer]:
        """Return the answers of the frames that still wait for the rest: there are no further frames."""
        good = [f for _, f in self._waiting if isinstance(f, TargetPose)]
        if self._rest is None and good:
            return self._decide(good)
        waiting, self._waiting = self._waiting, []
        return [self._answer(t_ns, pose) for t_ns, pose in waiting]

    def _locate(self, image: Any) -> TargetPose:
        if isinstance(image, NoPoseError):
            raise image
        if image is None or image.ndim != 2 or min(image.shape) < 16:
            raise NoPoseError(Status.UNREADABLE)
        if self._lens is None:
            self._shape = image.shape
            self._lens = self._settings.lens(image.shape)
        elif image.shape != self._shape:
            (rows, columns), (first_rows, first_columns) = image.shape, self._shape
            sizes = f'{columns} x {rows} px instead of {first_columns} x {first_rows}'
            raise NoPoseError(Status.OTHER_SIZE, sizes)
        if image.dtype == np.uint8:
            return self.target.locate(image, image, self._lens, 255.0)
        grey = (image >> 8).astype(np.uint8)
        return self.target.locate(image.astype(float) / 257.0, grey, self._lens, 255.0)

    def _decide(self, good: list[TargetPose]) -> list[FrameAnswer]:
        self._rest = mean_pose(good)
        self.target.set_rest(self._rest)
        waiting, self._waiting = self._waiting, []
        return [self._answer(t_ns, pose) for t_ns, pose in waiting]

    def _answer(self, t_ns: int, pose: TargetPose | NoPoseError) -> FrameAnswer:
        if isinstance(pose, NoPoseError):
            return FrameAnswer(t_ns, pose.status, words=str(pose))
        if self._rest is None:
            raise RuntimeError('a pose is answered before the rest is known')
        dx, dy, theta, phi, omega = relative(self._rest, pose)
        return FrameAnswer(t_ns, Status.OK, dx, dy, theta, phi, omega, relative_covariance(self._rest, pose), pose)


def relative(rest: TargetPose, pose: TargetPose) -> FloatArray:
    """(dX m, dY m, theta, phi, omega rad) of ``pose`` against ``rest``: R = Ry(omega) Rx(phi) Rz(theta)."""
    r = rest.rotation.T @ pose.rotation
    if pose.planar:
        # Where the ray meets the plane of the rest: an unknown distance must not become a displacement.
        met = np.linalg.solve(rest.plane, pose.place)
        moved = met / met[2]
    else:
        moved = rest.rotation.T @ (pose.place - rest.place)
    theta, phi = math.atan2(r[1, 0], r[1, 1]), -math.asin(min(max(r[1, 2], -1.0), 1.0))
    return np.array([moved[0], moved[1], theta, phi, math.atan2(r[0, 2], r[2, 2])])


def relative_covariance(rest: TargetPose, pose: TargetPose) -> FloatArray:
    """Covariance (3, 3) of (dX, dY, theta) from those of both poses."""
    r = rest.rotation.T @ pose.rotation
    moved: FloatArray = rest.rotation.T @ (pose.place - rest.place)
    onto, depth_ratio = rest.rotation.T[:2], 1.0
    size = 6 + rest.keystone.size
    of_rest, of_pose = np.zeros((3, size)), np.zeros((3, size))
    if pose.planar:
        # The ray of ``pose`` meets the plane of the rest: rest.plane @ (x, y, 1) = depth_ratio * pose.place.
        across = np.column_stack([rest.plane[:, :2], -pose.place])
        *moved[:2], depth_ratio = np.linalg.solve(across, -rest.place)
        moved[2], onto = 0.0, np.asarray(np.linalg.inv(across))[:2]
        of_rest[:2, 6:] = -np.outer(onto[:, 2], moved[: size - 6]) * rest.place[2]
    of_pose[:2, 3:6], of_rest[:2, 3:6] = depth_ratio * onto, -onto
    # A small turn a of the rest's axes takes ``moved`` to moved - a x moved.
    of_rest[:2, :3] = onto @ rest.rotation @ _cross(moved)
    # theta = atan2(r10, r11); r goes to r (1 + [b]x), or to (1 - [a]x) r.
    scale = 1.0 / (r[1, 0] ** 2 + r[1, 1] ** 2)
    gradient = np.array([r[1, 1], -r[1, 0], 0.0]) * scale
    of_pose[2, :3] = -_cross(r[1]) @ gradient
    of_rest[2, :3] = [gradient @ r[2], 0.0, -gradient @ r[0]]
    total = of_rest @ rest.covariance @ of_rest.T + of_pose @ pose.covariance @ of_pose.T
    if pose.planar:
        # A plate that left the plane of the rest moves in the image by that share of its distance from the middle.
        sd = math.sqrt(rest.covariance[5, 5] + pose.covariance[5, 5]) / float(pose.place[2])
        wide = float(np.linalg.norm(pose.place[:2])) + _MIDDLE * float(pose.place[2]) / AFFINE_FOCAL
        total[:2, :2] += np.eye(2) * (max(abs(depth_ratio - 1.0) - _STILL * sd, 0.0) * wide) ** 2
    return np.asarray((total + total.T) / 2)


def _cross(v: FloatArray) -> FloatArray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def mean_pose(poses: list[TargetPose]) -> TargetPose:
    """Return the mean of poses that are near each other, with its covariance."""
    summed = np.sum([p.rotation for p in poses], axis=0)
    u, _, vt = np.linalg.svd(summed)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    covariance = np.mean([p.covariance for p in poses], axis=0) / len(poses)
    place, keystone = (np.mean([getattr(p, of) for p in poses], axis=0) for of in ('place', 'keystone'))
    return poses[0]._replace(rotation=rotation, place=place, keystone=keystone, covariance=covariance)


def _still(before: list[TargetPose], pose: TargetPose) -> bool:
    rest = mean_pose(before)
    off = relative(rest, pose)[:3]
    sd = np.sqrt(np.diag(relative_covariance(rest, pose)))
    return bool(np.all(np.abs(off) < _STILL * sd))
