"""Fits the picture of three discs to the pixels at their rims: one least squares for the pose of the whole target.

Every pixel near a rim has a signed distance s (px) from it: its ray meets the target's plane at a distance rho from a
disc's centre, and s = (radius - rho) / |grad rho|. So lens distortion and perspective, by which the centre of a disc's
picture is not the picture of its centre, are in the model and leave no bias (Heikkila 2000; Song et al. 2024). The grey
level goes from outside to inside as

    I = outside + (inside - outside) (Phi(z) - gamma(n) / 6 (z^2 - 1) phi(z)),  z = (s - t^T S t / 2 R) / sqrt(n^T S n)

with n, t the rim's normal and tangent in the image, R its radius of curvature and S (2, 2) the variance of the blur, px^2.
``gamma`` is the skewness of the motion within the exposure along n: with it, s = 0 stays the place of the *mean* over
the exposure (Gram-Charlier) for a motion that is not uniform. ``inside`` and ``outside`` are linear in the image for each
disc, which takes uneven light; they are eliminated from the normal equations. Pixels are taken as they are, not
interpolated: their noise stays independent, and the fit reaches the Cramer-Rao bound. The first steps use each third
pixel. Pixels are kept as float32, which is good to 1e-5 px here and twice as fast; the normal equations are float64.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from psd_deflection.camera.answer import RefusedError, Status, TargetPose
from psd_deflection.camera.lens import Lens
from psd_deflection.records import FloatArray, IntArray

_STEPS = 15
_THINNED = 3
_LIGHTS = 6
_SECTORS = 16
"""Parts of a rim whose residuals are taken together: what is correlated along a rim widens the covariance."""

RADIUS_SD = 0.03
"""Standard deviation of the radius that is seen against the one that is declared: print, exposure, response. Relative."""

CENTRE_FLOOR = 0.002
"""Error of a disc's centre that no residual shows, one sd in px."""

_SKEW_BLUR = 0.6
"""Motion blur (sd, px) from which on the skewness of the motion is estimated."""

_SHARPEST = 0.25
"""Smallest blur, px: a pixel's own width."""

_ROOT_2PI = math.sqrt(2.0 * math.pi)

MOST_BLUR = 1.0
"""Longest motion blur with an answer, in units of a disc's radius."""

MEAN_OF_BLUR = 0.05
"""Error of the mean place over the exposure, one sd in units of the standard deviation of the motion within it."""

MOST_NOISE = 0.2
"""Largest rms of the residuals with an answer, in units of the contrast."""

Pixels = npt.NDArray[np.float32]


class Prior(NamedTuple):
    """What is known of the pose beforehand: tilts about the target's X and Y against ``rotation``, one ``sd``, rad."""

    rotation: FloatArray
    sd: float


class _Rims(NamedTuple):
    """The pixels near the rims, disc after disc: ``begin`` (4) of each disc, grey levels, rays x and y, place (3, n) in the
    image as (1, u, v) from the disc's centre in units of its size; ``bend`` (3, 2, 2): d ray / d pixel at the centres."""

    begin: IntArray
    level: Pixels
    x: Pixels
    y: Pixels
    flat: Pixels
    bend: FloatArray

    def thinned(self) -> _Rims:
        """Each third pixel, for the first steps."""
        chosen = np.arange(0, self.begin[-1], _THINNED)
        begin = np.searchsorted(chosen, self.begin)
        return _Rims(begin, self.level[chosen], self.x[chosen], self.y[chosen], self.flat[:, chosen], self.bend)


class _Shape(NamedTuple):
    """The parameters that are iterated; ``light`` (3, 6): outside and inside of each disc, constant and slopes."""

    rotation: FloatArray
    place: FloatArray
    swell: float
    blur: FloatArray
    skew: FloatArray
    light: FloatArray


class _Normal(NamedTuple):
    """Normal equations of the pose and blur, with the lights eliminated, and what the judgement needs.

    ``rows`` (6 + p + 1, n): derivatives by the lights and the parameters, then the residuals, all weighted.
    """

    hessian: FloatArray
    gradient: FloatArray
    inverses: list[FloatArray]
    rows: Pixels
    z: Pixels
    out: tuple[Pixels, Pixels]
    root: Pixels | None
    squares: float


class Fitter:
    """Fits the discs of one target in images of one size."""

    def __init__(self, lens: Lens, image_shape: tuple[int, int], centres: FloatArray, radius: float) -> None:
        self._lens, self._centres, self._radius = lens, centres, radius
        grid = lens.grid(image_shape)
        self._x = np.ascontiguousarray(grid[..., 0], dtype=np.float32)
        self._y = np.ascontiguousarray(grid[..., 1], dtype=np.float32)
        turn = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
        self._circle = radius * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(24)])
        self._points = np.column_stack([centres, np.zeros(len(centres))])

    def fit(self, image: Any, rotation: FloatArray, place: FloatArray, prior: Prior, full_scale: float) -> TargetPose:
        """The pose, from a first guess that is good to a pixel or two.

        ``image`` (rows, columns): grey levels; ``full_scale``: the level at which the camera saturates. Raises RefusedError.
        """
        shape = _Shape(rotation, place, 1.0, np.eye(2), np.zeros(0), np.zeros((len(self._centres), _LIGHTS)))
        pixel_radius = self._radius * self._lens.focal / float(place[2])
        half = min(4.5, 0.6 * pixel_radius)
        rims = self._gather(image, shape, half)
        shape = shape._replace(light=self._first_light(rims, shape))
        for _ in range(4):
            shape = self._converge(rims.thinned(), shape, prior)
            widest = math.sqrt(float(np.linalg.eigvalsh(shape.blur)[1]))
            wanted = min(max(3.2 * widest + 1.0, 4.0), 0.75 * pixel_radius)
            skewed = _motion(shape.blur) > _SKEW_BLUR and not shape.skew.size
            if skewed:
                shape = shape._replace(skew=np.zeros(4))
            if not skewed and wanted < 1.15 * half:
                break
            half = max(wanted, half)
            rims = self._gather(image, shape, half)
        for _ in range(3):
            normal = self._linearise(rims, shape, self._noise(rims, shape))
            shape, step, deviation = self._stepped(normal, shape, prior, len(rims.level))
            if np.all(np.abs(step) < 2.0 * deviation):
                break
        return self._judge(normal, rims, shape, step, prior, pixel_radius, full_scale)

    def _gather(self, image: Any, shape: _Shape, half: float) -> _Rims:
        rows, columns = self._x.shape
        inverse = _to_plane(shape)
        begin, parts, bends = [0], [], []
        for centre, point in zip(self._centres, self._points, strict=True):
            seen = self._lens.project((self._circle + point) @ shape.rotation.T + shape.place)
            (left, top), (right, bottom) = seen.min(axis=0) - half - 1, seen.max(axis=0) + half + 2
            if not (left >= 1 and top >= 1 and right < columns - 1 and bottom < rows - 1):
                raise RefusedError(Status.OUTSIDE)
            window = np.s_[int(top) : int(bottom), int(left) : int(right)]
            x, y = self._x[window], self._y[window]
            px, py, _ = _on_plane(inverse, x, y)
            rho = np.hypot(px - np.float32(centre[0]), py - np.float32(centre[1]))
            middle = self._lens.project(point @ shape.rotation.T + shape.place)
            bend = self._bend(middle)
            # Wide enough for the direction in which the picture is the longest.
            widest = 1.0 / float(np.linalg.norm(self._slope(inverse, centre, bend), 2))
            near = np.nonzero(np.abs(rho - self._radius) < half / widest)
            size = float(seen[:, 0].max() - seen[:, 0].min()) / 2
            u = (near[1] + (int(left) - middle[0])) / size
            v = (near[0] + (int(top) - middle[1])) / size
            parts.append((image[window][near], x[near], y[near], u, v))
            begin.append(begin[-1] + len(u))
            bends.append(bend)
        level, x, y, u, v = (np.concatenate(p).astype(np.float32) for p in zip(*parts, strict=True))
        return _Rims(np.array(begin), level, x, y, np.stack([np.ones_like(u), u, v]), np.array(bends))

    def _bend(self, pixel: FloatArray) -> FloatArray:
        """d ray / d pixel (2, 2) at a pixel."""
        ends = self._lens.rays(pixel + np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]]))
        return np.column_stack([ends[0] - ends[1], ends[2] - ends[3]])

    @staticmethod
    def _slope(inverse: FloatArray, centre: FloatArray, bend: FloatArray) -> FloatArray:
        """d plane point / d pixel (2, 2) at a disc's centre; it changes little over the disc."""
        forward = np.linalg.inv(inverse)
        ray = forward @ np.append(centre, 1.0)
        depth = float(inverse[2] @ (ray / ray[2]))
        return np.asarray((inverse[:2, :2] - np.outer(centre, inverse[2, :2])) / depth @ bend)

    def _first_light(self, rims: _Rims, shape: _Shape) -> FloatArray:
        light = np.zeros((len(self._centres), _LIGHTS))
        inverse = _to_plane(shape)
        px, py, _ = _on_plane(inverse, rims.x, rims.y)
        for k, centre in enumerate(self._centres):
            of = slice(rims.begin[k], rims.begin[k + 1])
            inside = np.hypot(px[of] - np.float32(centre[0]), py[of] - np.float32(centre[1])) < self._radius
            light[k, 0], light[k, 3] = (float(np.median(rims.level[of][side])) for side in (~inside, inside))
        return light

    def _converge(self, rims: _Rims, shape: _Shape, prior: Prior) -> _Shape:
        for _ in range(_STEPS):
            normal = self._linearise(rims, shape, None)
            shape, step, deviation = self._stepped(normal, shape, prior, len(rims.level))
            if np.all(np.abs(step) < 0.3 * deviation):
                break
        return shape

    def _stepped(
        self, normal: _Normal, shape: _Shape, prior: Prior, count: int
    ) -> tuple[_Shape, FloatArray, FloatArray]:
        """The shape after a Gauss-Newton step, the step and the standard deviations."""
        variance = max(normal.squares / max(count - 30, 1), 1e-9)
        stiff, pull = _beforehand(shape, prior)
        hessian = normal.hessian / variance + np.diag(stiff)
        gradient = normal.gradient / variance + stiff * pull
        try:
            inverse = np.linalg.inv(hessian + 1e-9 * np.diag(np.diag(hessian)))
        except np.linalg.LinAlgError:
            raise RefusedError(Status.MISFIT) from None
        step = inverse @ gradient
        if not np.all(np.isfinite(step)):
            raise RefusedError(Status.MISFIT)
        step *= min(1.0, 0.2 / max(float(np.max(np.abs(step[:3]))), 1e-12))
        light = shape.light.copy()
        for k, back in enumerate(normal.inverses):
            light[k] += back[:, -1] - back[:, :-1] @ step
        deviation = np.sqrt(np.maximum(np.diag(inverse), 0.0))
        return _moved(shape, step, light), step, deviation

    def _linearise(self, rims: _Rims, shape: _Shape, noise: tuple[float, float] | None) -> _Normal:
        """Normal equations at ``shape``; ``noise``: variances outside and inside, None: equal."""
        lengths = np.diff(rims.begin)
        inverse = _to_plane(shape)
        px, py, _ = _on_plane(inverse, rims.x, rims.y)

        def each(values: FloatArray) -> Pixels:
            """One number a disc to one a pixel."""
            return np.repeat(values.astype(np.float32), lengths)

        ox, oy = px - each(self._centres[:, 0]), py - each(self._centres[:, 1])
        rho = np.sqrt(ox * ox + oy * oy)
        ox /= rho
        oy /= rho
        slopes = np.array([self._slope(inverse, c, b) for c, b in zip(self._centres, rims.bend, strict=True)])
        nx = ox * each(slopes[:, 0, 0]) + oy * each(slopes[:, 1, 0])
        ny = ox * each(slopes[:, 0, 1]) + oy * each(slopes[:, 1, 1])
        steep = np.sqrt(nx * nx + ny * ny)
        nx /= steep
        ny /= steep
        bxx, bxy, byy = (float(b) for b in (shape.blur[0, 0], shape.blur[0, 1], shape.blur[1, 1]))
        xx, xy, yy = nx * nx, 2 * nx * ny, ny * ny
        across = bxx * xx + bxy * xy + byy * yy
        per_sigma = 1.0 / np.sqrt(across)
        # The rim's curvature moves the half level by the blur along it.
        z = (self._radius * shape.swell - rho) / steep - (bxx + byy - across) * steep * (0.5 / self._radius)
        z *= per_sigma
        bell = np.exp(-0.5 * z * z) * (1.0 / _ROOT_2PI)
        rise = bell * per_sigma
        level = ndtr(z)
        count = 10 + shape.skew.size
        rows = np.empty((_LIGHTS + count + 1, len(z)), dtype=np.float32)
        parameters = rows[_LIGHTS:-1]
        if shape.skew.size:
            cubes = np.stack([xx * nx, xx * ny, nx * yy, yy * ny])
            skew = np.asarray(shape.skew.astype(np.float32) @ cubes)
            zz = z * z
            level = level - skew * (zz - 1) * bell * (1 / 6)
            rise = rise - skew * z * (3 - zz) * bell * per_sigma * (1 / 6)
            parameters[10:] = cubes * ((1 - zz) * bell * (1 / 6))
        r = shape.rotation
        # The ray's direction in the target's axes; a small turn or shift moves the target's point along the normal.
        dx, dy, dz = (float(r[0, i]) * rims.x + float(r[1, i]) * rims.y + float(r[2, i]) for i in range(3))
        towards = (ox * dx + oy * dy) / dz
        by_rho = rise / steep
        side = towards * by_rho
        parameters[0] = -py * side
        parameters[1] = px * side
        parameters[2] = (oy * px - ox * py) * by_rho
        ox_rise, oy_rise = ox * by_rho, oy * by_rho
        for i in range(3):
            parameters[3 + i] = float(r[i, 0]) * ox_rise + float(r[i, 1]) * oy_rise - float(r[i, 2]) * side
        parameters[6] = by_rho * self._radius
        widening = z * rise * per_sigma * -0.5
        parameters[7], parameters[8], parameters[9] = widening * xx, widening * xy, widening * yy
        rows[:3] = rims.flat * (1 - level)
        rows[3:6] = rims.flat * level
        root = None
        if noise is not None:
            root = 1.0 / np.sqrt(noise[0] + (noise[1] - noise[0]) * np.clip((z + 1.5) / 3.0, 0.0, 1.0))
        for k, light in enumerate(shape.light.astype(np.float32)):
            of = slice(rims.begin[k], rims.begin[k + 1])
            parameters[:, of] *= (light[3:] - light[:3]) @ rims.flat[:, of]
            rows[-1, of] = rims.level[of] - light @ rows[:6, of]
        if root is not None:
            rows *= root
        return self._eliminated(rims, rows, z, (ox, oy), root)

    def _eliminated(
        self, rims: _Rims, rows: Pixels, z: Pixels, out: tuple[Pixels, Pixels], root: Pixels | None
    ) -> _Normal:
        count = len(rows) - _LIGHTS - 1
        hessian, gradient, inverses, squares = np.zeros((count, count)), np.zeros(count), [], 0.0
        for k in range(len(self._centres)):
            part = rows[:, rims.begin[k] : rims.begin[k + 1]]
            gram = (part @ part.T).astype(float)
            lights = gram[:_LIGHTS, :_LIGHTS]
            back = np.linalg.solve(lights + 1e-7 * np.trace(lights) * np.eye(_LIGHTS), gram[:_LIGHTS, _LIGHTS:])
            rest = gram[_LIGHTS:, _LIGHTS:] - gram[_LIGHTS:, :_LIGHTS] @ back
            hessian += rest[:-1, :-1]
            gradient += rest[:-1, -1]
            squares += max(float(rest[-1, -1]), 0.0)
            inverses.append(back)
        return _Normal(hessian, gradient, inverses, rows, z, out, root, squares)

    def _noise(self, rims: _Rims, shape: _Shape) -> tuple[float, float] | None:
        """Variances outside and inside the discs: bright pixels may be noisier than dark ones."""
        thin = rims.thinned()
        normal = self._linearise(thin, shape, None)
        dark, bright = normal.rows[-1][normal.z < -1.5], normal.rows[-1][normal.z > 1.5]
        if min(len(dark), len(bright)) < 30:
            return None
        # Quantisation alone is 1/12. A side that clips is not much better than the other.
        low, high = max(float(np.mean(dark * dark)), 0.1), max(float(np.mean(bright * bright)), 0.1)
        return max(low, high / 9), max(high, low / 9)

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
        """The pose with the covariance that the residuals show. Raises RefusedError if they show that this is no target."""
        contrast = shape.light[:, 3] - shape.light[:, 0]
        if contrast.min() <= 0.0 or contrast.min() < 0.3 * contrast.max():
            raise RefusedError(Status.HIDDEN)
        motion = _motion(shape.blur)
        sharp = math.sqrt(float(np.linalg.eigvalsh(shape.blur)[0]))
        if math.sqrt(12.0) * motion > MOST_BLUR * pixel_radius:
            raise RefusedError(Status.BLURRED)
        if sharp > 0.3 * pixel_radius:
            raise RefusedError(Status.DEFOCUSED)
        # The residuals after the last step, which was small.
        residual = normal.rows[-1].copy()
        scored = normal.rows[_LIGHTS:-1].copy()
        for k, back in enumerate(normal.inverses):
            of = slice(rims.begin[k], rims.begin[k + 1])
            part = back.astype(np.float32)
            scored[:, of] -= part[:, :-1].T @ normal.rows[:_LIGHTS, of]
            residual[of] -= part[:, -1] @ normal.rows[:_LIGHTS, of]
        residual -= step.astype(np.float32) @ scored
        raw = residual if normal.root is None else residual / normal.root
        sector = _sectors(normal.out, rims)
        self._refuse_misfit(normal.z, raw / float(contrast.mean()), sector, rims, shape.swell, full_scale)
        count = len(residual)
        chi_square = float(residual @ residual) / (count - 30)
        stiff, pull = _beforehand(shape, prior)
        inverse = np.linalg.inv(normal.hessian / chi_square + np.diag(stiff))
        scored *= residual
        scores = np.array([np.bincount(sector, row, 3 * _SECTORS) for row in scored]) / chi_square
        sandwich = inverse @ (scores @ scores.T) @ inverse
        wider = np.sqrt(np.maximum(np.diag(sandwich)[:6] / np.diag(inverse)[:6], 1.0))
        covariance = inverse[:6, :6] * np.outer(wider, wider)
        # What the first three moments of the motion do not say of its mean.
        covariance += self._moved_centres(shape, math.hypot(CENTRE_FLOOR, MEAN_OF_BLUR * motion))
        noise = float(np.sqrt(np.mean(raw * raw)))
        return TargetPose(
            shape.rotation,
            shape.place,
            covariance,
            2 * count * math.log(max(noise, 1e-3)) + float(np.sum(stiff * pull**2)),
            self._lens.project(self._points @ shape.rotation.T + shape.place),
            math.sqrt(12.0) * motion,
            shape.swell,
            noise,
            planar=not self._lens.known,
        )

    def _moved_centres(self, shape: _Shape, pixels: float) -> FloatArray:
        """Covariance (6, 6) of an error of ``pixels`` at each disc: in place, and about the normal."""
        variance = (pixels * float(shape.place[2]) / self._lens.focal) ** 2
        out = np.zeros((6, 6))
        out[2, 2] = variance / float(np.sum(self._centres**2))
        out[3:, 3:] = shape.rotation @ np.diag([variance, variance, 0.0]) @ shape.rotation.T / len(self._centres)
        return out

    @staticmethod
    def _refuse_misfit(z: Pixels, raw: Pixels, sector: IntArray, rims: _Rims, swell: float, full_scale: float) -> None:
        """``raw``: residuals in units of the contrast."""
        full = float(np.mean(rims.level[z > 1.5] >= full_scale - 1.0))
        # Blooming: the rise ends at full scale before it has reached its level.
        if full > 0.5:
            high, low = (z > 0.3) & (z < 1.2), (z < -0.3) & (z > -1.2)
            uneven = abs(float(np.mean(raw[high]) + np.mean(raw[low])) / 2) if high.any() and low.any() else 0.0
            if uneven > 0.02 or abs(swell - 1.0) > 0.06:
                raise RefusedError(Status.SATURATED)
        parts = 3 * _SECTORS
        count = np.maximum(np.bincount(sector, minlength=parts), 1)
        rms = np.sqrt(np.bincount(sector, raw * raw, parts) / count)
        mean = np.abs(np.bincount(sector, raw, parts)) / count
        usual = float(np.median(rms))
        # A rim that something covers in part has sectors of another picture.
        if np.any(rms > 3.0 * usual + 0.06) or np.any(mean > 5.0 * usual / np.sqrt(count) + 0.04):
            raise RefusedError(Status.HIDDEN)
        if math.sqrt(float(np.mean(raw * raw))) > MOST_NOISE:
            raise RefusedError(Status.MISFIT)


def _to_plane(shape: _Shape) -> FloatArray:
    """The homography (3, 3) from rays to the target's plane."""
    return np.asarray(np.linalg.inv(np.column_stack([shape.rotation[:, 0], shape.rotation[:, 1], shape.place])))


def _on_plane(inverse: FloatArray, x: Pixels, y: Pixels) -> tuple[Pixels, Pixels, Pixels]:
    """Plane points and depths of rays."""
    h = [[float(v) for v in row] for row in inverse]
    depth = 1.0 / (h[2][0] * x + h[2][1] * y + h[2][2])
    return (h[0][0] * x + h[0][1] * y + h[0][2]) * depth, (h[1][0] * x + h[1][1] * y + h[1][2]) * depth, depth


def _beforehand(shape: _Shape, prior: Prior) -> tuple[FloatArray, FloatArray]:
    """What is known without this image: inverse variances of the parameters, and how far each is from its expectation."""
    stiff, pull = np.zeros(10 + shape.skew.size), np.zeros(10 + shape.skew.size)
    # The tilt against the prior's plane in the target's own axes: a turn in the plane does not change it.
    off = prior.rotation.T @ shape.rotation
    stiff[:2], pull[:2] = prior.sd**-2, (-off[2, 1], off[2, 0])
    stiff[6], pull[6] = RADIUS_SD**-2, 1.0 - shape.swell
    # No motion is skewed by more than about one.
    stiff[10:], pull[10:] = 1.0, -shape.skew
    return stiff, pull


def _moved(shape: _Shape, step: FloatArray, light: FloatArray) -> _Shape:
    blur = shape.blur + np.array([[step[7], step[8]], [step[8], step[9]]])
    values, vectors = np.linalg.eigh(blur)
    blur = (vectors * np.clip(values, _SHARPEST**2, 900.0)) @ vectors.T
    return _Shape(
        shape.rotation @ turned(step[:3]),
        shape.place + step[3:6],
        float(np.clip(shape.swell + step[6], 0.7, 1.4)),
        blur,
        np.clip(shape.skew + step[10:], -1.5, 1.5),
        light,
    )


def turned(v: FloatArray) -> FloatArray:
    """The rotation (3, 3) about ``v`` by its length, rad (Rodrigues)."""
    angle = float(np.linalg.norm(v))
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    if angle < 1e-9:
        return np.eye(3) + cross
    return np.eye(3) + math.sin(angle) / angle * cross + (1.0 - math.cos(angle)) / angle**2 * cross @ cross


def _motion(blur: FloatArray) -> float:
    """Standard deviation of the motion within the exposure, px: what the blur has more along one axis."""
    small, large = np.linalg.eigvalsh(blur)
    return math.sqrt(max(float(large - small), 0.0))


def _sectors(out: tuple[Pixels, Pixels], rims: _Rims) -> IntArray:
    """The part of a rim to which each pixel belongs, counted through all discs."""
    part = np.floor((np.arctan2(out[1], out[0]) * (0.5 / np.pi) + 0.5) * _SECTORS).astype(int)
    of = np.repeat(np.arange(len(rims.begin) - 1), np.diff(rims.begin))
    return of * _SECTORS + np.minimum(part, _SECTORS - 1)
