# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The judges: golden answers of an independent audit, and a ray/plane simulator that shares no code."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from psd_deflection.model.plate import Geometry

Array = np.ndarray[Any, Any]


class Golden:
    """``cases['G5']`` is a case; ``geometry`` the rig of all of them."""

    def __init__(self, path: Path) -> None:
        content = json.loads(path.read_text())
        self.cases: dict[str, dict[str, Any]] = {case['name']: case for case in content['cases']}
        self.constants: dict[str, Any] = content['constants']

    def geometry(self, name: str | None = None, slope_ratio: float = 1.5) -> Geometry:
        zeros = np.zeros((2, 2)) if name is None else np.array(self.cases[name]['m0'])
        return Geometry(np.array([[0.0, 0.070], [-0.100, 0.0]]), zeros, np.zeros(2), 0.585, slope_ratio)

    def dots(self, name: str) -> tuple[float, ...]:
        return tuple(float(v) for pair in self.cases[name]['readings'] for v in pair)


class RayPlane:
    """Where rays cross planes, in space, with scipy's rotations: the way from a pose to dots."""

    @staticmethod
    def rotation(theta: float, phi: float, omega: float) -> Array:
        """Ry(omega) Rx(phi) Rz(theta), each about the axes that the turns before it left."""
        matrix: Array = Rotation.from_euler('YXZ', [omega, phi, theta]).as_matrix()
        return matrix

    @staticmethod
    def cross(start: Array, direction: Array, point: Array, normal: Array) -> Array:
        return np.asarray(start + direction * ((point - start) @ normal) / (direction @ normal))

    def tip_dots(
        self,
        geometry: Geometry,
        pose: Sequence[float],
        *,
        lift: float = 0.0,
        directions: Array | None = None,
        rolls: Sequence[float] | None = None,
        gains: Array | None = None,
    ) -> Array:
        """Lasers at the base, PSDs at the tip: readings (2P,) of (dX, dY, theta, phi, omega).

        ``zeros`` are the readings before load, so that the beams' places follow from them.
        """
        count = len(geometry.centers)
        directions = np.tile((0.0, 0.0, 1.0), (count, 1)) if directions is None else directions
        rolls = [0.0] * count if rolls is None else rolls
        gains = np.ones((count, 2)) if gains is None else gains
        dx, dy, theta, phi, omega = pose
        r = self.rotation(theta, phi, omega)
        tip = np.array([dx, dy, geometry.link_length + lift])
        dots = []
        for i in range(count):
            up = np.array([0.0, 0.0, geometry.heights[i]])
            axes = Rotation.from_euler('Z', rolls[i]).as_matrix()
            center = np.array([*geometry.centers[i], 0.0])
            before = axes @ np.array([*(geometry.zeros[i] / gains[i]), 0.0]) + center + up
            start = before + np.array([0.0, 0.0, geometry.link_length])
            hit = self.cross(start, directions[i], tip + r @ up, r[:, 2])
            in_plate = r.T @ (hit - tip) - center
            dots.append((axes.T @ in_plate)[:2] * gains[i])
        return np.concatenate(dots)

    def base_dots(self, geometry: Geometry, pose: Sequence[float]) -> Array:
        """Lasers at the tip along -Z of the plate, PSDs at the base: readings (2P,)."""
        dx, dy, theta, phi, omega = pose
        r = self.rotation(theta, phi, omega)
        dots = []
        for i in range(len(geometry.centers)):
            laser = np.array([dx, dy, 0.0]) + r @ np.array([*geometry.beams[i], 0.0])
            plane = np.array([0.0, 0.0, geometry.heights[i]])
            hit = self.cross(laser, -r[:, 2], plane, np.array([0.0, 0.0, 1.0]))
            dots.append(hit[:2] - geometry.centers[i])
        return np.concatenate(dots)
