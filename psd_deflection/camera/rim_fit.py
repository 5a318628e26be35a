"""Fits the picture of three discs to the pixels at their rims: one least squares for the pose of the whole target.

Every pixel near a rim has a signed distance s (px) from it: its ray meets the target's plane at a distance rho from
a disc's centre, and s = (radius - rho) / |grad rho|. So lens distortion and perspective, by which the centre of a
disc's picture is not the picture of its centre, are in the model and leave no bias (Heikkila 2000; Song et al. 2024).
The grey level goes from outside to inside as

    I = outside + (inside - outside) (Phi(z) - gamma(n) / 6 (z^2 - 1) phi(z)),  z = (s - t^T S t / 2 R) / sqrt(n^T S n)

with n, t the rim's normal and tangent in the image, R its radius of curvature and S (2, 2) the variance of the blur,
px^2. ``gamma`` is the skewness of the motion within the exposure along n: with it, s = 0 stays the place of the *mean*
over the exposure (Gram-Charlier) for a motion that is not uniform. ``inside`` and ``outside`` are linear in the image
for each disc, which takes uneven light; they are eliminated from the normal equations. Pixels are taken as they are,
not interpolated: their noise stays independent, and the fit reaches the Cramer-Rao bound. The first steps use each
fourth pixel. Pixels are kept as float32, which is good to 1e-5 px here and twice as fast; the normal equations are in
float64.

If the lens is not known, perspective is fitted as two numbers of its own ("keystone", 1/m): a point (x, y) of the
target is then farther by the factor 1 + keystone (x, y), whatever the focal length.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.camera.answer import RefusedError, Status, TargetPose, plane_of
from psd_deflection.camera.lens import AFFINE_FOCAL, Lens
from psd_deflection.records import FloatArray, IntArray

_STEPS = 15
_SETTLED = 10.0
"""A step of fewer standard deviations is the last once the picture fits: over it the model is linear."""
_NEAR, _LINEAR = 30.0, 0.2
"""The same of some of the pixels, which all of them will correct: as many as change the blur by this share of it, and
three at least."""
_THINNED = 4
_LIGHTS = 6
_HALF_OCTANT = math.tan(math.pi / 8)
_SECTORS = 16
"""Parts of a rim whose residuals are taken together: what is correlated along a rim widens the covariance."""

RADIUS_SD = 0.03
"""Standard deviation of the radius that is seen against the declared one (print, exposure, response), relative."""

CENTRE_FLOOR = 0.002
"""Error of a disc's centre that no residual shows, one sd in px."""

_SKEW_BLUR = 0.6
"""Motion blur (sd, px) from which on the skewness of the motion is estimated."""

_SHARPEST = 0.25
"""Smallest blur, px: a pixel's own width."""

_ROOT_2PI = math.sqrt(2.0 * math.pi)

_FAR = 1e6
"""Farther than any pixel, px."""

MOST_BLUR = 1.0
"""Longest motion blur with an answer, in units of a disc's radius."""

MEAN_OF_BLUR = 0.2
"""Error of the mean place over the exposure, one sd in units of the standard deviation of the motion within it.
The worst is two pictures of like strength, of which one is taken: by one standard deviation of the motion."""

MOST_DEFOCUS = 0.15
"""Largest blur (sd) of an image at rest with an answer, in units of a disc's radius."""

MOST_MISFIT, MISFIT_OF_BLUR = 0.012, 0.03
"""Largest difference between picture and model beyond noise with an answer, rms in units of the contrast; and what a
motion blur adds to it, whose profile is not Gaussian."""

HIDDEN_SECTOR = 0.04
"""The same for one sector of one rim."""

UNEVEN = 0.004
"""Largest unevenness of the rise of a disc that reaches full scale, in units of the contrast."""

DIP = 0.75
"""Two peaks of the time at a place, with less than this share of the lower one between them, are two pictures."""

_ZONES = 8
_DWELL = 24
_DOUBLED_FROM = 0.5

MOST_NOISE = 0.2
"""Largest rms of the residuals with an answer, in units of the contrast."""

Pixels = npt.NDArray[np.float32]


class Prior(NamedTuple):
    """What is known of the pose beforehand: tilts about the target's X and Y against ``rotation``, one ``sd``, rad.

    ``keystone``: what is expected of it, in the axes of ``rotation``, if the lens is not known.
    """

    rotation: FloatArray
    sd: float
    keystone: FloatArray


class _Rims(NamedTuple):
    """The pixels near the rims, disc after disc: ``begin`` (4) of each disc, grey levels, rays (3, n), place (3, n) in
    the image as (1, u, v) from the disc's centre in units of its size; ``bend`` (3, 2, 2): d ray / d pixel there;
    ``pixel``: number of the pixel in the image."""

    begin: IntArray
    level: Pixels
    rays: Pixels
    flat: Pixels
    bend: FloatArray
    pixel: IntArray

    def thinned(self) -> _Rims:
        """Each fourth pixel, for the first steps."""
        chosen = np.s_[::_THINNED]
        begin = -(-self.begin // _THINNED)
        rays, flat = np.ascontiguousarray(self.rays[:, chosen]), np.ascontiguousarray(self.flat[:, chosen])
        return _Rims(begin, self.level[chosen], rays, flat, self.bend, self.pixel[chosen])


class _Shape(NamedTuple):
    """The parameters that are iterated; ``light`` (3, 6): outside and inside of each disc, constant and slopes."""

    rotation: FloatArray
    place: FloatArray
    swell: float
    blur: FloatArray
    skew: FloatArray
    light: FloatArray
    keystone: FloatArray

    @property
    def plane(self) -> FloatArray:
        """(3, 3): (x, y, 1) on the target to its ray."""
        return plane_of(self.rotation, self.place, self.keystone)


class _Normal(NamedTuple):
    """Normal equations of the pose and blur, with the lights eliminated, and what the judgement needs.

    ``rows`` (6 + p + 1, n): derivatives by the lights and the parameters, then the residuals, all weighted.
    """

    hessian: FloatArray
    gradient: FloatArray
    back: FloatArray
    rows: Pixels
    z: Pixels
    side: tuple[Pixels, Pixels]
    root: Pixels | None
    squares: float


class Fitter:
    """Fits the discs of one target in images of one size."""

    def __init__(self, lens: Lens, image_shape: tuple[int, int], centres: FloatArray, radius: float) -> None:
        self._lens, self._centres, self._radius = lens, centres, radius
        grid = lens.grid(image_shape)
        self._rows, self._columns = image_shape
        self._rays = np.ascontiguousarray(grid.reshape(-1, 2).T, dtype=np.float32)
        self._points = np.column_stack([centres, np.ones(len(centres))])
        self._blur = np.eye(2)

    def fit(self, image: Any, rotation: FloatArray, place: FloatArray, prior: Prior, full_scale: float) -> TargetPose:
        """The pose, from a first guess that is good to a pixel or two, and from the blur of the last answer.

        ``image`` (rows, columns): grey levels; ``full_scale``: where the camera saturates. Raises RefusedError.
        """
        light = np.zeros((len(self._centres), _LIGHTS))
        shape = _Shape(rotation, place, 1.0, self._blur, np.zeros(0), light, np.zeros(0))
        if not self._lens.known:
            shape = shape._replace(keystone=_expected(prior, rotation))
        pixel_radius = self._radius * self._lens.focal / float(place[2])
        half = min(_width(self._blur), 0.6 * pixel_radius)
        rims, light = self._gather(image, shape, half)
        shape = shape._replace(light=light)
        for _ in range(4):
            shape, noise = self._converge(rims.thinned(), shape, prior)
            wanted = min(_width(shape.blur), 0.75 * pixel_radius)
            skewed = _motion(shape.blur) > _SKEW_BLUR and not shape.skew.size
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
        found = self._judge(normal, rims, shape, step, prior, pixel_radius, full_scale)
        if _motion(shape.blur) < _SKEW_BLUR:
            self._blur = shape.blur
        return found

    def _gather(self, image: Any, shape: _Shape, half: float) -> tuple[_Rims, FloatArray]:
        """The pixels nearer than ``half`` to a rim, and first lights by the means well in and out of it."""
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
            raise RefusedError(Status.OUTSIDE)
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
        near = np.flatnonzero((away > least) & (away < most))
        line = near // wide
        along = near - wide * line
        begin = np.searchsorted(line, np.arange(4) * tall)
        corner = starts[:, 0] + starts[:, 1] * self._columns
        chosen = (corner[:, None] + self._columns * np.arange(tall)).astype(int).ravel()[line]
        chosen += along
        level = image.ravel()[chosen].astype(np.float32)
        rays, flat = np.empty((2, 3, len(near)), dtype=np.float32)
        rays[2] = flat[0] = 1.0
        np.take(self._rays[0], chosen, out=rays[0], mode='clip')
        np.take(self._rays[1], chosen, out=rays[1], mode='clip')
        size = np.float32(1.0 / reach[:, 0].max())
        np.multiply(along, size, out=flat[1], casting='unsafe')
        flat[1] += np.repeat((u[:, 0] * size).astype(np.float32), np.diff(begin))
        np.take((v.ravel() * size).astype(np.float32), line, out=flat[2], mode='clip')
        # The rise lies between: its pixels would make the contrast too small and the first step too long.
        some, seen = away.ravel()[near[::_THINNED]], level[::_THINNED]
        first = -(-begin // _THINNED)
        light = np.zeros((3, _LIGHTS))
        for k, (a, b, band) in enumerate(zip(first[:-1].tolist(), first[1:].tolist(), bands.tolist(), strict=True)):
            inner = some[a:b] < max(self._radius - band / 2, self._radius / 2) ** 2
            outer = some[a:b] > (self._radius + band / 2) ** 2
            light[k, 0] = float(seen[a:b] @ outer) / max(int(np.count_nonzero(outer)), 1)
            light[k, 3] = float(seen[a:b] @ inner) / max(int(np.count_nonzero(inner)), 1)
        return _Rims(begin, level, rays, flat, bends, chosen), light

    def _bends(self, pixels: FloatArray) -> FloatArray:
        """d ray / d pixel (n, 2, 2) at pixels (n, 2)."""
        offsets = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        ends = self._lens.rays(pixels[:, None] + offsets)
        return np.stack([ends[:, 0] - ends[:, 1], ends[:, 2] - ends[:, 3]], axis=-1)

    def _slopes(self, plane: FloatArray, inverse: FloatArray, bends: FloatArray) -> FloatArray:
        """d plane point / d pixel (n, 2, 2) at the discs' centres; it changes little over a disc."""
        far = self._points @ plane[2]
        forward = inverse[:2, :2] - self._centres[:, :, None] * inverse[2, :2]
        return np.asarray((forward * far[:, None, None]) @ bends)

    def _converge(self, rims: _Rims, shape: _Shape, prior: Prior) -> tuple[_Shape, tuple[float, float] | None]:
        """The shape by some of the pixels, and the noise outside and inside."""
        for _ in range(_STEPS):
            normal = self._linearise(rims, shape, None)
            shape, step, deviation = self._stepped(normal, shape, prior, len(rims.level))
            many = _LINEAR * float(np.trace(shape.blur)) / float(deviation[7] + deviation[9] + 1e-12)
            if (np.abs(step) < min(max(many, 3.0), _NEAR) * deviation).all():
                break
        return shape, _noise(normal, rims, step)

    def _stepped(
        self, normal: _Normal, shape: _Shape, prior: Prior, count: int
    ) -> tuple[_Shape, FloatArray, FloatArray]:
        """The shape after a Gauss-Newton step, the step and the standard deviations."""
        variance = max(normal.squares / max(count - 30, 1), 1e-9)
        stiff, pull = _beforehand(shape, prior)
        inverse = _covariance(normal, variance, stiff)
        gradient = normal.gradient / variance + stiff * pull
        step = inverse @ gradient
        if not np.isfinite(step).all():
            raise RefusedError(Status.MISFIT)
        step *= min(1.0, 0.2 / max(*np.abs(step[:3]).tolist(), 1e-12))
        light = shape.light + normal.back[:, :, -1] - normal.back[:, :, :-1] @ step
        deviation = np.sqrt(np.maximum(inverse.diagonal(), 0.0))
        return _moved(shape, step, light), step, deviation

    def _linearise(self, rims: _Rims, shape: _Shape, noise: tuple[float, float] | None) -> _Normal:
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
        bell *= 1.0 / _ROOT_2PI
        level = _below(z, bell)
        rows = np.empty((_LIGHTS + 11 + shape.skew.size + shape.keystone.size, len(z)), dtype=np.float32)
        parameters = rows[_LIGHTS:-1]
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
            far = parameters[5] * float(shape.place[2])
            np.multiply(far, px, out=parameters[-2])
            np.multiply(far, py, out=parameters[-1])
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
        self, rims: _Rims, rows: Pixels, z: Pixels, side: tuple[Pixels, Pixels], root: Pixels | None
    ) -> _Normal:
        spans = zip(rims.begin[:-1].tolist(), rims.begin[1:].tolist(), strict=True)
        gram = np.stack([part @ part.T for part in (rows[:, a:b] for a, b in spans)]).astype(float)
        lights = gram[:, :_LIGHTS, :_LIGHTS]
        diagonal = np.einsum('kii->ki', lights)
        diagonal += 1e-7 * diagonal.sum(axis=1, keepdims=True)
        back = np.linalg.solve(lights, gram[:, :_LIGHTS, _LIGHTS:])
        rest = (gram[:, _LIGHTS:, _LIGHTS:] - gram[:, _LIGHTS:, :_LIGHTS] @ back).sum(axis=0)
        return _Normal(rest[:-1, :-1], rest[:-1, -1], back, rows, z, side, root, max(float(rest[-1, -1]), 0.0))

    def _judge(
        self,
        normal: _Normal,
        rims: _Rims,
        shape: _Shape,
        step: FloatArray,
        prior: Prior,
        pixel_radius: float,
        full_scale: float,
    ) -> TargetPose:
        """The pose with the covariance that the residuals show. Raises RefusedError if they show another picture."""
        contrast = shape.light[:, 3] - shape.light[:, 0]
        if contrast.min() <= 0.0 or contrast.min() < 0.3 * contrast.max():
            raise RefusedError(Status.HIDDEN)
        motion = _motion(shape.blur)
        sharp = math.sqrt(_spread(shape.blur)[0])
        if math.sqrt(12.0) * motion > MOST_BLUR * pixel_radius:
            raise RefusedError(Status.BLURRED)
        if sharp > MOST_DEFOCUS * pixel_radius:
            raise RefusedError(Status.DEFOCUSED)
        count = len(rims.level)
        stiff, pull = _beforehand(shape, prior)
        left = normal.squares - float(step @ (2.0 * normal.gradient - normal.hessian @ step))
        chi_square = max(left / (count - 30), 1e-9)
        inverse = _covariance(normal, chi_square, stiff)
        pose = [*range(6), *range(10 + shape.skew.size, len(inverse))]
        *pulls, residual = _after(normal, rims, step, inverse[pose])
        raw = residual if normal.root is None else residual / normal.root
        sector = _sectors(normal.side, rims)
        relative = raw / float(contrast.mean())
        if motion > _DOUBLED_FROM * max(sharp, 0.5) and self._doubled(normal, relative, shape.blur):
            raise RefusedError(Status.GHOST)
        misfit = self._misfit(normal.z, relative, sector, rims, full_scale)
        if misfit > MOST_MISFIT + MISFIT_OF_BLUR * min(max(motion / sharp - 0.5, 0.0), 1.5):
            raise RefusedError(Status.MISFIT)
        # What the model does not say: a level that is off by the misfit moves the rim by that over the steepest rise.
        # It may be one disc's alone, and moves a rim more easily than it bends one.
        wrong = 4.0 * misfit * _ROOT_2PI * math.hypot(sharp, motion)
        bent = inverse @ _of_bent_rims(normal, rims) / (pixel_radius * chi_square)
        bent[:, :6] *= math.hypot(CENTRE_FLOOR, wrong)
        bent[:, 6:] *= 0.5 * wrong
        # Pixels may be wrong together: along a rim, or along the rows or columns in which a camera is read.
        weighted = residual / np.float32(chi_square)
        line = rims.pixel // self._columns
        column = rims.pixel - self._columns * line
        squares = np.zeros(len(pose))
        # Pixels of one line follow each other.
        begin = np.concatenate([[0], 1 + np.flatnonzero(line[1:] != line[:-1])])
        lines = line[begin]
        for k, one in enumerate(pulls):
            one *= weighted
            totals = (
                np.bincount(sector, one),
                np.bincount(column, one),
                np.bincount(lines, np.add.reduceat(one, begin)),
            )
            squares[k] = max(float(total @ total) for total in totals)
        inverse = inverse[pose][:, pose]
        wider = np.sqrt(np.maximum(squares / inverse.diagonal(), 1.0))
        covariance = inverse * np.outer(wider, wider)
        covariance += bent[pose] @ bent[pose].T
        # What the first three moments of the motion do not say of its mean.
        covariance[:6, :6] += self._moved_centres(shape, MEAN_OF_BLUR * max(motion - 0.15, 0.0))
        noise = math.sqrt(float(raw @ raw) / count)
        return TargetPose(
            shape.rotation,
            shape.place,
            covariance,
            2 * math.log(max(noise, 1e-3)) + float(np.sum(stiff * pull**2)) / count,
            count,
            self._lens.project(self._points @ shape.plane.T),
            math.sqrt(12.0) * motion,
            shape.swell,
            noise,
            planar=not self._lens.known,
            misfit=misfit,
            keystone=shape.keystone,
        )

    def _moved_centres(self, shape: _Shape, pixels: float) -> FloatArray:
        """Covariance (6, 6) of an error of ``pixels`` that the discs share, or that turns them about the normal."""
        variance = (pixels * float(shape.place[2]) / self._lens.focal) ** 2
        out = np.zeros((6, 6))
        out[2, 2] = variance / float(np.sum(self._centres**2))
        out[3:, 3:] = shape.rotation @ np.diag([variance, variance, 0.0]) @ shape.rotation.T
        return out

    @staticmethod
    def _misfit(z: Pixels, raw: Pixels, sector: IntArray, rims: _Rims, full_scale: float) -> float:
        """How far the picture is from the model beyond noise, rms in units of the contrast, as ``raw`` is.

        Pixels are taken together by sector and by their distance from the rim. What all sectors have in common is the
        camera's own profile, which moves no centre. Raises RefusedError.
        """
        parts, worst = 3 * _SECTORS, 0.0
        if rims.level.max() >= full_scale - 1.0:
            worst = _unevenness(z, raw, rims, full_scale)
            if worst > UNEVEN:
                raise RefusedError(Status.SATURATED)
        if math.sqrt(float(raw @ raw) / len(raw)) > MOST_NOISE:
            raise RefusedError(Status.MISFIT)
        zone = np.clip((z + 3.0) * (_ZONES / 6.0), 0, _ZONES - 1).astype(int)
        cell = sector * _ZONES + zone
        count = np.bincount(cell, minlength=parts * _ZONES).reshape(parts, _ZONES).astype(float)
        total = np.bincount(cell, raw, parts * _ZONES).reshape(parts, _ZONES)
        squares = float(raw @ raw)
        mean = total / np.maximum(count, 1.0)
        common = total.sum(axis=0) / np.maximum(count.sum(axis=0), 1.0)
        within = max(float((squares - (mean * total).sum()) / max(count.sum() - np.count_nonzero(count), 1.0)), 0.0)
        filled = count > 3
        excess = np.where(filled, (mean - common) ** 2 - within / np.maximum(count, 1.0), 0.0)
        by_sector = excess.sum(axis=1) / np.maximum(filled.sum(axis=1), 1)
        usual = within * np.sqrt(2.0 / np.maximum(filled.sum(axis=1), 1)) / np.maximum(count.sum(axis=1) / _ZONES, 1.0)
        # A rim that something covers in part has sectors of another picture.
        if np.any(by_sector > HIDDEN_SECTOR**2 + 6.0 * usual):
            raise RefusedError(Status.HIDDEN)
        return math.hypot(math.sqrt(max(float(excess.sum() / max(filled.sum(), 1)), 0.0)), worst)

    @staticmethod
    def _doubled(normal: _Normal, raw: Pixels, blur: FloatArray) -> bool:
        """Whether the plate was seen in two places, not in motion: the places between were not exposed.

        The rims that lie across the blur show how long it was where, as the steepness of the grey level there.
        """
        along = np.linalg.eigh(blur)[1][:, 1]
        across = normal.side[0] * float(along[0]) + normal.side[1] * float(along[1])
        level = normal.rows[3] if normal.root is None else normal.rows[3] / normal.root
        seen = level + raw
        dwell = np.zeros(_DWELL)
        for end in (1.0, -1.0):
            of = across * end > 0.9
            place = np.clip((normal.z[of] * end + 3.0) * (_DWELL / 6.0), 0, _DWELL).astype(int)
            count = np.bincount(place, minlength=_DWELL + 1)
            if count[:-1].min() < 4:
                return False
            mean = np.bincount(place, seen[of], _DWELL + 1) / np.maximum(count, 1)
            dwell[1:] += end * np.diff(mean[:-1])
        # The two highest places with the lowest between them.
        left = np.maximum.accumulate(dwell)
        right = np.maximum.accumulate(dwell[::-1])[::-1]
        return bool(np.any(dwell[1:-1] < DIP * np.minimum(left[:-2], right[2:]) - 0.015))


def _covariance(normal: _Normal, variance: float, stiff: FloatArray) -> FloatArray:
    """Of the parameters, if a residual has ``variance``. Raises RefusedError."""
    hessian = normal.hessian / variance
    diagonal = np.einsum('ii->i', hessian)
    diagonal += stiff
    diagonal *= 1.0 + 1e-9
    try:
        return np.asarray(np.linalg.inv(hessian), dtype=float)
    except np.linalg.LinAlgError:
        raise RefusedError(Status.MISFIT) from None


def _after(normal: _Normal, rims: _Rims, step: FloatArray, ways: FloatArray) -> Pixels:
    """``ways`` (q, p) @ the derivatives with the lights eliminated, then the residuals after ``step``.

    (q + 1, n), weighted as ``normal.rows`` are. The step must be small.
    """
    q, parameters = len(ways), len(step)
    onto = np.zeros((len(normal.back), q + 1, _LIGHTS + parameters + 1))
    onto[:, :q, _LIGHTS:-1] = ways
    onto[:, q, _LIGHTS:-1] = -step
    onto[:, :, :_LIGHTS] = -onto[:, :, _LIGHTS:-1] @ normal.back[:, :, :-1].transpose(0, 2, 1)
    onto[:, q, :_LIGHTS] -= normal.back[:, :, -1]
    onto[:, q, -1] = 1.0
    begin = rims.begin.tolist()
    out = np.empty((q + 1, begin[-1]), dtype=np.float32)
    for a, b, one in zip(begin[:-1], begin[1:], onto.astype(np.float32), strict=True):
        np.matmul(one, normal.rows[:, a:b], out=out[:, a:b])
    return out


def _noise(normal: _Normal, rims: _Rims, step: FloatArray) -> tuple[float, float] | None:
    """Variances outside and inside the discs after ``step``: bright pixels may be noisier than dark ones."""
    residual = _after(normal, rims, step, np.zeros((0, len(step))))[0]
    dark, bright = residual[normal.z < -1.5], residual[normal.z > 1.5]
    if min(len(dark), len(bright)) < 30:
        return None
    # Quantisation alone is 1/12. A side that clips is not much better than the other.
    low, high = max(float(dark @ dark) / len(dark), 0.1), max(float(bright @ bright) / len(bright), 0.1)
    return max(low, high / 9), max(high, low / 9)


def _unevenness(z: Pixels, raw: Pixels, rims: _Rims, full_scale: float) -> float:
    """Of the rises of discs that reach full scale: blooming ends a rise before it has reached its level."""
    worst = 0.0
    for a, b in zip(rims.begin[:-1].tolist(), rims.begin[1:].tolist(), strict=True):
        here, off = z[a:b], raw[a:b]
        if float(np.mean(rims.level[a:b][here > 1.0] >= full_scale - 1.0)) > 0.1:
            high, low = off[(here > 0.3) & (here < 1.2)], off[(here < -0.3) & (here > -1.2)]
            if len(high) and len(low):
                worst = max(worst, abs(float(high.mean() + low.mean())) / 2)
    return worst


def _of_bent_rims(normal: _Normal, rims: _Rims) -> FloatArray:
    """What rims that are not where the model has them do to the gradient (p, 15), for a shift of the pixel radius.

    Of each disc the shifts by the cosine and sine of the angle around it (columns 0 to 5), by those of twice the angle,
    which are a tilt, and all around.
    """
    # Some of the pixels are enough for what only widens the covariance.
    x, y = (side[::_THINNED] for side in normal.side)
    rows = np.ascontiguousarray(normal.rows[:-1, ::_THINNED])
    # The derivative by the radius is that by a shift of the whole rim.
    around = np.empty((5, len(x)), dtype=np.float32)
    np.multiply(rows[_LIGHTS + 6], _THINNED, out=around[4])
    np.multiply(x, around[4], out=around[0])
    np.multiply(y, around[4], out=around[1])
    np.multiply(x, around[0], out=around[2])
    around[2] -= y * around[1]
    np.multiply(y, around[0], out=around[3])
    around[3] *= 2.0
    begin = (-(-rims.begin // _THINNED)).tolist()
    by_row = np.array([rows[:, a:b] @ around[:, a:b].T for a, b in itertools.pairwise(begin)])
    by_shape = by_row[:, _LIGHTS:] - normal.back[:, :, :-1].transpose(0, 2, 1) @ by_row[:, :_LIGHTS]
    return np.hstack([*by_shape[:, :, :2], *by_shape[:, :, 2:]])


def _below(z: Pixels, bell: Pixels) -> Pixels:
    """The normal distribution up to ``z``, whose density is ``bell``, to 3e-7: Abramowitz and Stegun, 26.2.17."""
    t: Pixels = np.abs(z)
    t *= 0.2316419
    t += 1.0
    np.reciprocal(t, out=t)
    tail: Pixels = t * np.float32(1.330274429)
    for coefficient in (-1.821255978, 1.781477937, -0.356563782, 0.319381530):
        tail += coefficient
        tail *= t
    tail *= bell
    np.subtract(0.5, tail, out=tail)
    np.copysign(tail, z, out=tail)
    tail += 0.5
    return tail


def _expected(prior: Prior, rotation: FloatArray) -> FloatArray:
    """The keystone that ``prior`` expects, in the axes of ``rotation``."""
    return np.asarray((rotation.T @ prior.rotation)[:2, :2] @ prior.keystone)


def _beforehand(shape: _Shape, prior: Prior) -> tuple[FloatArray, FloatArray]:
    """What is known without this image: inverse variances of the parameters; how far each is from what is expected."""
    size = 10 + shape.skew.size
    stiff, pull = np.zeros((2, size + shape.keystone.size))
    # The tilt against the prior's plane in the target's own axes: a turn in the plane does not change it.
    x, y, _ = (prior.rotation[:, 2] @ shape.rotation).tolist()
    stiff[0] = stiff[1] = prior.sd**-2
    pull[0], pull[1] = -y, x
    stiff[6], pull[6] = RADIUS_SD**-2, 1.0 - shape.swell
    if shape.skew.size:
        # No motion is skewed by more than about one.
        stiff[10:size], pull[10:size] = 1.0, -shape.skew
    if shape.keystone.size:
        # That of a tilt of one sd, seen by a focal length of one image width.
        stiff[size:] = (prior.sd * AFFINE_FOCAL / float(shape.place[2])) ** -2
        pull[size:] = _expected(prior, shape.rotation) - shape.keystone
    return stiff, pull


def _moved(shape: _Shape, step: FloatArray, light: FloatArray) -> _Shape:
    by_xx, by_xy, by_yy = step[7:10].tolist()
    blur = np.add(shape.blur, [[by_xx, by_xy], [by_xy, by_yy]])
    small, large = _spread(blur)
    if small < _SHARPEST**2 or large > 900.0:
        values, vectors = np.linalg.eigh(blur)
        blur = (vectors * np.clip(values, _SHARPEST**2, 900.0)) @ vectors.T
    skews = shape.skew.size
    return _Shape(
        shape.rotation @ turned(step[:3]),
        shape.place + step[3:6],
        min(max(shape.swell + float(step[6]), 0.7), 1.4),
        blur,
        np.clip(shape.skew + step[10 : 10 + skews], -1.5, 1.5) if skews else shape.skew,
        light,
        shape.keystone + step[10 + skews :],
    )


def turned(v: FloatArray) -> FloatArray:
    """The rotation (3, 3) about ``v`` by its length, rad (Rodrigues)."""
    x, y, z = v.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    sine, versed = (math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2) if angle > 1e-9 else (1.0, 0.5)
    sx, sy, sz, vx, vy, vz = sine * x, sine * y, sine * z, versed * x, versed * y, versed * z
    return np.array(
        [
            [1.0 - vy * y - vz * z, vx * y - sz, vx * z + sy],
            [vx * y + sz, 1.0 - vx * x - vz * z, vy * z - sx],
            [vx * z - sy, vy * z + sx, 1.0 - vx * x - vy * y],
        ]
    )


def _motion(blur: FloatArray) -> float:
    """Standard deviation of the motion within the exposure, px: what the blur has more along one axis."""
    small, large = _spread(blur)
    return math.sqrt(large - small)


def _sectors(side: tuple[Pixels, Pixels], rims: _Rims) -> IntArray:
    """The part of a rim to which each pixel belongs, counted through all discs: 16 parts of equal angle."""
    x, y = np.abs(side[0]), np.abs(side[1])
    part = (np.minimum(x, y) > _HALF_OCTANT * np.maximum(x, y)).astype(np.uint8)
    for bit in (y > x, side[1] > 0, side[0] > 0):
        part += part
        part += bit
    return np.asarray(np.repeat(_SECTORS * np.arange(len(rims.begin) - 1), np.diff(rims.begin)) + part)


def _width(blur: FloatArray) -> float:
    """How far from a rim its pixels are used, px: up to where a rise of this blur has ended."""
    return max(3.2 * math.sqrt(_spread(blur)[1]) + 1.7, 3.5)


def _spread(blur: FloatArray) -> tuple[float, float]:
    """The eigenvalues of a variance (2, 2), the smaller first."""
    (xx, xy), (_, yy) = blur.tolist()
    half, apart = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    return half - apart, half + apart
