# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The lens: pixel <-> ray, with OpenCV's distortion model, solved to rounding.

Pixel (0, 0) is the centre of the first pixel. A ray is (x, y) with the direction (x, y, 1) in the camera's axes:
x to the right of the image, y down, z away from the camera.
Source: the equations in OpenCV's ``calib3d`` documentation (radial k1..k6, tangential p1, p2, thin prism s1..s4).
"""

from __future__ import annotations

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.records import FloatArray

AFFINE_FOCAL = 1000.0
"""Focal length in image widths that stands for a camera of unknown focal length: perspective is then negligible."""

_ITERATIONS = 50


class Lens:
    """Camera matrix (3, 3) and distortion (0, 4, 5, 8 or 12 numbers in OpenCV's order) of a pinhole camera.

    ``known``: False if no camera matrix was given (:meth:`unknown`).
    Raises ConfigError for a matrix that is none of a camera, or another number of coefficients.
    """

    def __init__(self, matrix: FloatArray, distortion: FloatArray, *, known: bool = True) -> None:
        if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)) or min(matrix[0, 0], matrix[1, 1]) <= 0.0:
            raise ConfigError('camera.matrix: must be nine numbers, row by row, with positive focal lengths')
        if distortion.size not in (0, 4, 5, 8, 12) or not np.all(np.isfinite(distortion)):
            raise ConfigError('camera.distortion: must have 0, 4, 5, 8 or 12 numbers, in the order of OpenCV')
        self.matrix, self.known = matrix, known
        self.distortion = np.concatenate([distortion, np.zeros(12 - distortion.size)])
        self._straight = not self.distortion.any()
        self._inverse = np.linalg.inv(matrix)
        self._grids: dict[tuple[int, int], FloatArray] = {}  # Bound: one size of image a camera.

    @classmethod
    def unknown(cls, shape: tuple[int, int]) -> Lens:
        """A camera of which nothing is known: no distortion, no perspective; ``shape``: height, width of its images."""
        focal = AFFINE_FOCAL * max(shape)
        rows, columns = shape
        matrix = np.array([[focal, 0.0, (columns - 1) / 2], [0.0, focal, (rows - 1) / 2], [0.0, 0.0, 1.0]])
        return cls(matrix, np.zeros(0), known=False)

    @property
    def focal(self) -> float:
        """Mean focal length, px."""
        return float(self.matrix[0, 0] + self.matrix[1, 1]) / 2

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Rays (..., 2) of pixels (..., 2)."""
        bent: FloatArray = pixels @ self._inverse[:2, :2].T + self._inverse[:2, 2]
        if self._straight:
            return bent
        ray: FloatArray = bent
        for _ in range(_ITERATIONS):
            step = bent - self._bend(ray)
            ray = ray + step
            if np.max(np.abs(step), initial=0.0) < 1e-13:
                break
        return ray

    def grid(self, shape: tuple[int, int]) -> FloatArray:
        """Rays (rows, columns, 2) of every pixel of an image; computed once for a size."""
        if shape not in self._grids:
            rows, columns = np.mgrid[: shape[0], : shape[1]]
            self._grids[shape] = self.rays(np.stack([columns, rows], axis=-1).astype(float))
        return self._grids[shape]

    def pixels(self, rays: FloatArray) -> FloatArray:
        """Pixels (..., 2) of rays (..., 2)."""
        return np.asarray(self._bend(rays) @ self.matrix[:2, :2].T + self.matrix[:2, 2])

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) in the camera's axes, m."""
        return self.pixels(points[..., :2] / points[..., 2:])

    def _bend(self, rays: FloatArray) -> FloatArray:
        if self._straight:
            return rays
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self.distortion
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
        bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
        return np.stack([bent_x, bent_y], axis=-1)
