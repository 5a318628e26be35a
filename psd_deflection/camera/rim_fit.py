# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fits the picture of three discs to the pixels at their rims: one least squares for the pose of the whole target.

The model is that of :mod:`.rim_model`; :mod:`.rim_classifier` decides whether the fit is an answer.
"""

from typing import Any

import numpy as np

from psd_deflection.camera.answer import NoPoseError, Status, TargetPose
from psd_deflection.camera.lens import Lens
from psd_deflection.camera.rim_classifier import RimClassifier
from psd_deflection.camera.rim_model import (
    LIGHTS,
    ROOT_2PI,
    THINNED,
    Normal,
    Pixels,
    PosePrior,
    Rims,
    Shape,
    after,
    beforehand,
    below,
    covariance_of,
    expected,
    motion_of,
    moved,
    width,
)
from psd_deflection.records import FloatArray

_STEPS = 15
_SETTLED = 10.0
"""A step of fewer standard deviations is the last once the picture fits: over it the model is linear."""

_NEAR, _LINEAR = 30.0, 0.2
"""The same of some of the pixels, which all of them will correct: as many as change the blur by this share of it, and
three at least."""

_SKEW_BLUR = 0.6
"""Motion blur (sd, px) from which on the skewness of the motion is estimated."""

_FAR = 1e6
"""Farther than any pixel, px."""


class Fitter:
    """Fits the discs of one target in images of one size."""

    def __init__(self, lens: Lens, image_shape: tuple[int, int], centres: FloatArray, radius: float) -> None:
        self._lens, self._centres, self._radius = lens, centres, radius
        grid = lens.grid(image_shape)
        self._rows, self._columns = image_shape
        self._rays = np.ascontiguousarray(grid.reshape(-1, 2).T, dtype=np.float32)
        self._points = np.column_stack([centres, np.ones(len(centres))])
        self._classifier = RimClassifier(lens, self._columns, centres)
        self._blur = np.eye(2)

    def fit(
        self, image: Any, rotation: FloatArray, place: FloatArray, prior: PosePrior, full_scale: float
    ) -> TargetPose:
        """Return the pose, from a first guess that is good to a pixel or two, and from the blur of the last answer.

        ``image`` (rows, columns): grey levels; ``full_scale``: where the camera saturates. Raises RejectedError.
        """
        light = np.zeros((len(self._centres), LIGHTS))
        shape = Shape(rotation, place, 1.0, self._blur, np.zeros(0), light, np.zeros(0))
        if not self._lens.known:
            shape = shape._replace(keystone=expected(prior, rotation))
        pixel_radius = self._radius * self._lens.focal / float(place[2])
        half = min(width(self._blur), 0.6 * pixel_radius)
        rims, light = self._gather(image, shape, half)
        shape = shape._replace(light=light)
        for _ in range(4):
            shape, noise = self._converge(rims.thinned(), shape, prior)
            wanted = min(width(shape.blur), 0.75 * pixel_radius)
            skewed = motion_of(shape.blur) > _SKEW_BLUR and not shape.skew.size
            if skewed:
                shape = shape._replace(skew=np.zeros(4))
            if not skewed and wanted < 1.15 * half:
                break
            half = max(wanted, half)
            rims, _ = self._gather(image, shape, half)
        for _ in range(3):
            normal = self._linearise(rims, shape, noise)
            shape, step, deviation = self._stepped(normal, shape, prior, len(rims.level))
            if (np.abs(step) < _SETTLED * deviation).all():
                break
        pose = self._classifier.pose(normal, rims, shape, step, prior, pixel_radius, full_scale)
        if motion_of(shape.blur) < _SKEW_BLUR:
            self._blur = shape.blur
        return pose

    def _gather(self, image: Any, shape: Shape, half: float) -> tuple[Rims, FloatArray]:
        """Return the pixels nearer than ``half`` to a rim, and first lights by the means well in and out of it."""
        plane = shape.plane
        middles = self._lens.project(self._points @ plane.T)
        bends = self._bends(middles)
        # Over a disc the way from the image to the plane is nearly affine: good enough to choose pixels.
        slopes = self._slopes(plane, np.asarray(np.linalg.inv(plane), dtype=float), bends)
        squares = slopes.transpose(0, 2, 1) @ slopes
        xx, xy, yy = squares[:, 0, 0], squares[:, 0, 1], squares[:, 1, 1]
        reach = self._radius * np.sqrt(np.stack([yy, xx], axis=1) / (xx * yy - xy * xy)[:, None])
        limits = (self._columns - half - 3, self._rows - half - 3)
        if (middles - reach).min() < half + 2 or (middles + reach > limits).any():
            raise NoPoseError(Status.OUTSIDE)
        # Wide enough for the direction in which the picture is the longest.
        bands = half * np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))
        starts = np.floor(middles - reach - half - 1)
        wide, tall = (int(n) for n in np.ceil((middles + reach - starts).max(axis=0) + half + 2).tolist())
        # All discs at once, in boxes of one size; of the smaller ones not all is used.
        u = np.arange(wide) + (starts - middles)[:, :1]
        v = np.arange(tall) + (starts - middles)[:, 1:]
        ends = reach + half + 2
        u[u >= ends[:, :1]], v[v >= ends[:, 1:]] = _FAR, _FAR
        away = ((2 * xy)[:, None] * v).astype(np.float32)[:, :, None] * u.astype(np.float32)[:, None, :]
        away += (xx[:, None] * u * u).astype(np.float32)[:, None, :]
        away += (yy[:, None] * v * v).astype(np.float32)[:, :, None]
        squared = np.square([np.maximum(self._radius - bands, 0.0), self._radius + bands]).astype(np.float32)
        least, most = squared[:, :, None, None]
        selected = np.flatnonzero((away > least) & (away < most))
        line = selected // wide
        along = selected - wide * line
        begin = np.searchsorted(line, np.arange(4) * tall)
        corner = starts[:, 0] + starts[:, 1] * self._columns
        chosen = (corner[:, None] + self._columns * np.arange(tall)).astype(int).ravel()[line]
        chosen += along
        level = image.ravel()[chosen].astype(np.float32)
        rays, flat = np.empty((2, 3, len(selected)), dtype=np.float32)
        rays[2] = flat[0] = 1.0
        np.take(self._rays[0], chosen, out=rays[0], mode='clip')
        np.take(self._rays[1], chosen, out=rays[1], mode='clip')
        size = np.float32(1.0 / reach[:, 0].max())
        np.multiply(along, size, out=flat[1], casting='unsafe')
        flat[1] += np.repeat((u[:, 0] * size).astype(np.float32), np.diff(begin))
        np.take((v.ravel() * size).astype(np.float32), line, out=flat[2], mode='clip')
        # The rise lies between: its pixels would make the contrast too small and the first step too long.
        sampled, observed = away.ravel()[selected[::THINNED]], level[::THINNED]
        first = -(-begin // THINNED)
        light = np.zeros((3, LIGHTS))
        for k, (a, b, band) in enumerate(zip(first[:-1].tolist(), first[1:].tolist(), bands.tolist(), strict=True)):
            inner = sampled[a:b] < max(self._radius - band / 2, self._radius / 2) ** 2
            outer = sampled[a:b] > (self._radius + band / 2) ** 2
            light[k, 0] = float(observed[a:b] @ outer) / max(int(np.count_nonzero(outer)), 1)
            light[k, 3] = float(observed[a:b] @ inner) / max(int(np.count_nonzero(inner)), 1)
        return Rims(begin, level, rays, flat, bends, chosen), light

    def _bends(self, pixels: FloatArray) -> FloatArray:
        """d ray / d pixel (n, 2, 2) at pixels (n, 2)."""
        offsets = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        ends = self._lens.rays(pixels[:, None] + offsets)
        return np.stack([ends[:, 0] - ends[:, 1], ends[:, 2] - ends[:, 3]], axis=-1)

    def _slopes(self, plane: FloatArray, inverse: FloatArray, bends: FloatArray) -> FloatArray:
        """d plane point / d pixel (n, 2, 2) at the discs' centres; it changes little over a disc."""
        depth = self._points @ plane[2]
        forward = inverse[:2, :2] - self._centres[:, :, None] * inverse[2, :2]
        return np.asarray((forward * depth[:, None, None]) @ bends)

    def _converge(self, rims: Rims, shape: Shape, prior: PosePrior) -> tuple[Shape, tuple[float, float] | None]:
        """Return the shape by some of the pixels, and the noise outside and inside."""
        for _ in range(_STEPS):
            normal = self._linearise(rims, shape, None)
            shape, step, deviation = self._stepped(normal, shape, prior, len(rims.level))
            many = _LINEAR * float(np.trace(shape.blur)) / float(deviation[7] + deviation[9] + 1e-12)
            if (np.abs(step) < min(max(many, 3.0), _NEAR) * deviation).all():
                break
        return shape, _noise(normal, rims, step)

    def _stepped(
        self, normal: Normal, shape: Shape, prior: PosePrior, count: int
    ) -> tuple[Shape, FloatArray, FloatArray]:
        """Return the shape after a Gauss-Newton step, the step and the standard deviations."""
        variance = max(normal.squares / max(count - 30, 1), 1e-9)
        stiff, pull = beforehand(shape, prior)
        inverse = covariance_of(normal, variance, stiff)
        gradient = normal.gradient / variance + stiff * pull
        step = inverse @ gradient
        if not np.isfinite(step).all():
            raise NoPoseError(Status.MISFIT)
        step *= min(1.0, 0.2 / max(*np.abs(step[:3]).tolist(), 1e-12))
        light = shape.light + normal.back[:, :, -1] - normal.back[:, :, :-1] @ step
        deviation = np.sqrt(np.maximum(inverse.diagonal(), 0.0))
        return moved(shape, step, light), step, deviation

    def _linearise(self, rims: Rims, shape: Shape, noise: tuple[float, float] | None) -> Normal:
        """Normal equations at ``shape``; ``noise``: variances outside and inside, None: equal."""
        plane = shape.plane
        inverse: FloatArray = np.asarray(np.linalg.inv(plane), dtype=float)
        slopes = self._slopes(plane, inverse, rims.bend)
        curved = (slopes[:, 0, 0] * slopes[:, 1, 1] - slopes[:, 0, 1] * slopes[:, 1, 0]) ** 2 * (0.5 / self._radius)
        discs = np.empty((7, len(slopes)), dtype=np.float32)
        discs[:2], discs[2:6], discs[6] = self._centres.T, slopes.reshape(-1, 4).T, curved
        # One number a disc to one a pixel.
        centre_x, centre_y, uu, vu, uv, vv, curved = np.repeat(discs, rims.begin[1:] - rims.begin[:-1], axis=1)
        px, py, depth = inverse.astype(np.float32) @ rims.rays
        px /= depth
        py /= depth
        ox, oy = np.subtract(px, centre_x, out=centre_x), np.subtract(py, centre_y, out=centre_y)
        rho = ox * ox
        rho += oy * oy
        np.sqrt(rho, out=rho)
        ox /= rho
        oy /= rho
        nx, ny = ox * uu, ox * vu
        nx += oy * uv
        ny += oy * vv
        flat = nx * nx
        flat += ny * ny
        np.sqrt(flat, out=flat)
        np.reciprocal(flat, out=flat)
        nx *= flat
        ny *= flat
        (bxx, bxy), (_, byy) = shape.blur.tolist()
        xx, xy, yy = nx * nx, nx * ny, ny * ny
        xy += xy
        across = bxx * xx
        across += bxy * xy
        across += byy * yy
        per_sigma = np.reciprocal(np.sqrt(across))
        # The rim's curvature, det(slopes)^2 / (radius |slope|^3), moves the half level by the blur along it.
        curved *= flat * flat
        curved *= (bxx + byy) - across
        z = self._radius * shape.swell - rho
        z -= curved
        z *= flat
        z *= per_sigma
        bell = -0.5 * z
        bell *= z
        np.exp(bell, out=bell)
        bell *= 1.0 / ROOT_2PI
        level = below(z, bell)
        rows = np.empty((LIGHTS + 11 + shape.skew.size + shape.keystone.size, len(z)), dtype=np.float32)
        parameters = rows[LIGHTS:-1]
        contrast = np.empty_like(z)
        begin = rims.begin.tolist()
        for k, light in enumerate(shape.light.astype(np.float32)):
            of = slice(begin[k], begin[k + 1])
            np.matmul(light[3:] - light[:3], rims.flat[:, of], out=contrast[of])
            np.matmul(light[:3], rims.flat[:, of], out=rows[-1, of])
        if shape.skew.size:
            cubes = np.stack([xx * nx, xx * ny, nx * yy, yy * ny])
            skew = np.asarray(shape.skew.astype(np.float32) @ cubes)
            zz = z * z
            level = level - skew * (zz - 1) * bell * (1 / 6)
            rise = (1 - skew * z * (3 - zz) * (1 / 6)) * (bell * per_sigma * contrast)
            parameters[10 : 10 + len(cubes)] = cubes * ((1 - zz) * bell * contrast * (1 / 6))
        else:
            rise = bell * per_sigma
            rise *= contrast
        np.multiply(rims.flat, level, out=rows[3:6])
        np.subtract(rims.flat, rows[3:6], out=rows[:3])
        rows[-1] += contrast * level
        np.subtract(rims.level, rows[-1], out=rows[-1])
        # If a point (x, y, 1) of the target moves by v, its ray meets the old target at (x, y) + q - (x, y) q_z with
        # q = inverse v.
        by_rho = rise * flat
        inwards = np.empty((3, len(z)), dtype=np.float32)
        np.multiply(ox, by_rho, out=inwards[0])
        np.multiply(oy, by_rho, out=inwards[1])
        np.multiply(inwards[0], px, out=inwards[2])
        inwards[2] += inwards[1] * py
        np.negative(inwards[2], out=inwards[2])
        np.matmul(inverse.T.astype(np.float32), inwards, out=parameters[3:6])
        ways = (inverse @ shape.rotation).T.astype(np.float32) @ inwards
        if shape.keystone.size:
            slope = parameters[5] * float(shape.place[2])
            np.multiply(slope, px, out=parameters[-2])
            np.multiply(slope, py, out=parameters[-1])
        np.multiply(py, ways[2], out=parameters[0])
        np.multiply(px, -ways[2], out=parameters[1])
        np.multiply(ways[1], px, out=parameters[2])
        parameters[2] -= ways[0] * py
        np.multiply(by_rho, self._radius, out=parameters[6])
        rise *= z
        rise *= per_sigma
        rise *= -0.5
        for row, square in zip(parameters[7:10], (xx, xy, yy), strict=True):
            np.multiply(rise, square, out=row)
        root = None
        if noise is not None:
            root = z * ((noise[1] - noise[0]) / 3.0)
            root += sum(noise) / 2
            np.clip(root, min(noise), max(noise), out=root)
            np.reciprocal(np.sqrt(root, out=root), out=root)
            rows *= root
        return self._eliminated(rims, rows, z, (nx, ny), root)

    def _eliminated(
        self, rims: Rims, rows: Pixels, z: Pixels, side: tuple[Pixels, Pixels], root: Pixels | None
    ) -> Normal:
        spans = zip(rims.begin[:-1].tolist(), rims.begin[1:].tolist(), strict=True)
        gram = np.stack([part @ part.T for part in (rows[:, a:b] for a, b in spans)]).astype(float)
        lights = gram[:, :LIGHTS, :LIGHTS]
        diagonal = np.einsum('kii->ki', lights)
        diagonal += 1e-7 * diagonal.sum(axis=1, keepdims=True)
        back = np.linalg.solve(lights, gram[:, :LIGHTS, LIGHTS:])
        rest = (gram[:, LIGHTS:, LIGHTS:] - gram[:, LIGHTS:, :LIGHTS] @ back).sum(axis=0)
        return Normal(rest[:-1, :-1], rest[:-1, -1], back, rows, z, side, root, max(float(rest[-1, -1]), 0.0))


def _noise(normal: Normal, rims: Rims, step: FloatArray) -> tuple[float, float] | None:
    """Variances outside and inside the discs after ``step``: bright pixels may be noisier than dark ones."""
    residual = after(normal, rims, step, np.zeros((0, len(step))))[0]
    dark, bright = residual[normal.z < -1.5], residual[normal.z > 1.5]
    if min(len(dark), len(bright)) < 30:
        return None
    # Quantisation alone is 1/12. A side that clips is not much better than the other.
    low, high = max(float(dark @ dark) / len(dark), 0.1), max(float(bright @ bright) / len(bright), 0.1)
    return max(low, high / 9), max(high, low / 9)
