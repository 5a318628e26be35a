# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms: where a frame stands in another one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from psd_deflection.records import FloatArray


class Transform(NamedTuple):
    """A frame in its parent: ``rotation`` (3, 3), ``position`` (3,) m."""

    rotation: FloatArray
    position: FloatArray

    def __matmul__(self, inner: Transform) -> Transform:
        """``inner``, which is given in this frame, in the parent of this frame."""
        return Transform(self.rotation @ inner.rotation, self.rotation @ inner.position + self.position)

    def inverse(self) -> Transform:
        """The parent in this frame."""
        return Transform(self.rotation.T, -(self.rotation.T @ self.position))

    @property
    def rotation_vector(self) -> FloatArray:
        """Axis times angle, rad (3,)."""
        return Rotation.from_matrix(self.rotation).as_rotvec()

    @property
    def quaternion(self) -> FloatArray:
        """(x, y, z, w)."""
        return Rotation.from_matrix(self.rotation).as_quat()


IDENTITY = Transform(np.eye(3), np.zeros(3))


def of_position_and_angles(xyz: FloatArray, rpy: FloatArray) -> Transform:
    """Position (m) and roll, pitch, yaw (rad) about the parent's fixed X, Y, Z in this order, as URDF has them."""
    return Transform(Rotation.from_euler('xyz', rpy).as_matrix(), np.asarray(xyz, dtype=np.float64))


def rotation_about(axis: FloatArray, angle: float) -> Transform:
    """A rotation by ``angle`` (rad) about the unit vector ``axis``."""
    return Transform(Rotation.from_rotvec(np.asarray(axis) * angle).as_matrix(), np.zeros(3))


def shift(x: float, y: float, z: float) -> Transform:
    """A translation, m."""
    return Transform(np.eye(3), np.array([x, y, z]))


def cross_matrix(v: FloatArray) -> FloatArray:
    """(3, 3): the matrix that gives v x u for any u."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
