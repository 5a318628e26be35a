# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draws what a camera sees of the target on the tip plate: the judge of the detector, written apart from it."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

Array = npt.NDArray[np.float64]
PARTS = 5
CUTS = 3  # Parts of a pixel on a side before the blur; parts of such a part at a rim.


@dataclass(frozen=True)
class Pose:
    """The tip against its rest: m and rad; ``z`` is away from the base."""

    dx: float = 0.0
    dy: float = 0.0
    theta: float = 0.0
    phi: float = 0.0
    omega: float = 0.0
    z: float = 0.0


@dataclass(frozen=True)
class Scene:
    """Camera, target and light. ``roll``: of the camera about its axis; ``tilt``: of the camera about X and Y."""

    width: int = 640
    height: int = 480
    focal: float = 2000.0
    centre: tuple[float, float] = (330.0, 228.0)
    distortion: Sequence[float] = ()
    distance: float = 0.4
    roll: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    aim: tuple[float, float] = (0.0, 0.0)
    view: str = 'outside'
    spacing: float = 0.025
    radius: float = 0.008
    black: float = 20.0
    white: float = 200.0
    slope: tuple[float, float] = (0.0, 0.0)
    blur: float = 0.7
    read_noise: float = 2.0
    shot_noise: float = 0.0
    hide: Sequence[tuple[float, float, float, float]] = field(default=())
    discs: int = 3

    @property
    def matrix(self) -> list[float]:
        return [self.focal, 0.0, self.centre[0], 0.0, self.focal, self.centre[1], 0.0, 0.0, 1.0]


def about(axis: int, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[i, i] = out[j, j] = c
    out[j, i], out[i, j] = s, -s
    return out


def camera_of(scene: Scene) -> tuple[Array, Array]:
    facing = np.diag([1.0, -1.0, -1.0]) if scene.view == 'outside' else np.diag([-1.0, -1.0, 1.0])
    rotation = about(2, scene.roll) @ about(0, scene.tilt[0]) @ about(1, scene.tilt[1]) @ facing
    return rotation, np.array([scene.aim[0], scene.aim[1], scene.distance])


def distort(x: Array, y: Array, distortion: Sequence[float]) -> tuple[Array, Array]:
    """Where the lens puts a ray."""
    k1, k2, p1, p2, k3 = [*distortion, *([0.0] * 5)][:5]
    rr = x**2 + y**2
    f = 1 + k1 * rr + k2 * rr**2 + k3 * rr**3
    return (x * f + 2 * p1 * x * y + p2 * (rr + 2 * x**2), y * f + p1 * (rr + 2 * y**2) + 2 * p2 * x * y)


def undistort(x: Array, y: Array, distortion: Sequence[float]) -> tuple[Array, Array]:
    """Newton's method with a numeric derivative: not the detector's way."""
    if not any(distortion):
        return x, y
    a, b, h = x.copy(), y.copy(), 1e-6
    for _ in range(4):
        fx, fy = distort(a, b, distortion)
        xx, yx = distort(a + h, b, distortion)
        xy, yy = distort(a, b + h, distortion)
        j11, j12, j21, j22 = (xx - fx) / h, (xy - fx) / h, (yx - fy) / h, (yy - fy) / h
        det = j11 * j22 - j12 * j21
        ex, ey = x - fx, y - fy
        a += (j22 * ex - j12 * ey) / det
        b += (j11 * ey - j21 * ex) / det
    return a, b


@functools.lru_cache(maxsize=64)
def rays(
    box: tuple[int, int, int, int], focal: float, centre: tuple[float, float], distortion: tuple[float, ...]
) -> tuple[Array, Array, Array]:
    """Rays x and y (rows, columns) of the pixels in ``box`` (left, top, right, bottom), and d (x, y) / d (u, v)."""
    v, u = np.mgrid[box[1] : box[3], box[0] : box[2]].astype(float)
    x, y = undistort((u - centre[0]) / focal, (v - centre[1]) / focal, distortion)
    return x, y, np.stack([np.gradient(of, axis=axis) for of in (x, y) for axis in (1, 0)])


def on_plate(scene: Scene, pose: Pose, x: Array, y: Array) -> tuple[Array, Array]:
    """Return the point of the tip plate, in its own axes, that the ray (x, y) meets."""
    rotation, origin = camera_of(scene)
    tip = rotation @ about(1, pose.omega) @ about(0, pose.phi) @ about(2, pose.theta)
    at = origin + rotation @ np.array([pose.dx, pose.dy, pose.z])
    normal = tip[:, 2]
    depth = (normal @ at) / (normal[0] * x + normal[1] * y + normal[2])
    px, py, pz = depth * x - at[0], depth * y - at[1], depth - at[2]
    return (tip[0, 0] * px + tip[1, 0] * py + tip[2, 0] * pz, tip[0, 1] * px + tip[1, 1] * py + tip[2, 1] * pz)


def pixels_of(scene: Scene, pose: Pose, points: Array) -> Array:
    """Pixels (n, 2) of points (n, 2) of the tip plate."""
    rotation, origin = camera_of(scene)
    tip = rotation @ about(1, pose.omega) @ about(0, pose.phi) @ about(2, pose.theta)
    at = origin + rotation @ np.array([pose.dx, pose.dy, pose.z]) + points @ tip[:, :2].T
    a, b = distort(at[:, 0] / at[:, 2], at[:, 1] / at[:, 2], scene.distortion)
    return scene.focal * np.column_stack((a, b)) + scene.centre


def pixel_of(scene: Scene, pose: Pose, x: float, y: float) -> tuple[float, float]:
    """Pixel of a point (x, y) of the tip plate."""
    u, v = pixels_of(scene, pose, np.array([[x, y]]))[0]
    return float(u), float(v)


def centres_of(scene: Scene) -> list[tuple[float, float]]:
    """Of the discs, on the plate, from the top, m."""
    half = (scene.discs - 1) / 2
    return [(0.0, (half - i) * scene.spacing) for i in range(scene.discs)]


def cover(out: Array, scene: Scene, pose: Pose, parts: int) -> None:
    """Add to ``out`` (rows, columns) the share of each pixel that is white; rims are cut in ``parts`` x ``parts``."""
    offsets = (np.arange(parts) + 0.5) / parts - 0.5
    du, dv = np.meshgrid(offsets, offsets)
    for cx, cy in centres_of(scene):
        angles = np.linspace(0, 2 * np.pi, 60)
        rim = pixels_of(scene, pose, (cx, cy) + scene.radius * np.column_stack((np.cos(angles), np.sin(angles))))
        u0, v0 = np.maximum(np.floor(rim.min(axis=0)).astype(int) - 2, 0)
        u1, v1 = np.ceil(rim.max(axis=0)).astype(int) + 3
        u1, v1 = min(u1, scene.width), min(v1, scene.height)
        if u1 <= u0 or v1 <= v0:
            continue
        # Boxes of a coarse grid: the discs of the next pose are mostly in the same.
        left, top, right, bottom = 48 * (u0 // 48), 48 * (v0 // 48), 48 * (u1 // 48 + 1), 48 * (v1 // 48 + 1)
        around = rays((left, top, right, bottom), scene.focal, tuple(scene.centre), tuple(scene.distortion))
        ray_x, ray_y, slope = (a[..., v0 - top : v1 - top, u0 - left : u1 - left] for a in around)
        x, y = on_plate(scene, pose, ray_x, ray_y)
        away = np.hypot(x - cx, y - cy) - scene.radius
        pixel = scene.radius * 2 * math.pi / float(np.sum(np.hypot(*np.diff(rim, axis=0).T)))
        part = (away < 0).astype(float)
        edge = np.abs(away) < 1.0 * pixel
        # Within a pixel the lens is linear to a millionth of it.
        k = slope[:, edge][..., None]
        sub_x = ray_x[edge][:, None] + k[0] * du.ravel() + k[1] * dv.ravel()
        sub_y = ray_y[edge][:, None] + k[2] * du.ravel() + k[3] * dv.ravel()
        ex, ey = on_plate(scene, pose, sub_x, sub_y)
        part[edge] = np.mean(np.hypot(ex - cx, ey - cy) < scene.radius, axis=1)
        out[v0:v1, u0:u1] += part
    for left, top, right, bottom in scene.hide:
        out[int(top) : int(bottom), int(left) : int(right)] = 0.0


def cut(scene: Scene) -> Scene:
    """Return the same scene by a camera whose pixels are smaller."""
    x, y = (CUTS * c + (CUTS - 1) / 2 for c in scene.centre)
    hide = [(CUTS * a, CUTS * b, CUTS * c, CUTS * d) for a, b, c, d in scene.hide]
    size = {name: CUTS * getattr(scene, name) for name in ('width', 'height', 'focal')}
    return replace(scene, centre=(x, y), hide=hide, **size)


def together(fine: Array, scene: Scene) -> Array:
    """Return the share that is white of each pixel of ``scene``, blurred, from that of the pixels of ``cut(scene)``."""
    out = np.zeros((scene.height, scene.width))
    lit = [np.flatnonzero(fine.any(axis=axis)) for axis in (1, 0)]
    if not lit[0].size:
        return out
    reach = math.ceil(5.0 * scene.blur) + 1
    (top, bottom), (left, right) = ((max(a[0] // CUTS - reach, 0), a[-1] // CUTS + 1 + reach) for a in lit)
    part = fine[CUTS * top : CUTS * bottom, CUTS * left : CUTS * right].astype(np.float32)
    blurred = gaussian_filter(part, CUTS * scene.blur, mode='nearest', truncate=5.0)
    rows, columns = (n // CUTS for n in part.shape)
    small = blurred.reshape(rows, CUTS, columns, CUTS).mean(axis=(1, 3), dtype=float)
    out[top : top + rows, left : left + columns] = small
    return out


def clean(scene: Scene, poses: Sequence[Pose]) -> Array:
    """Grey levels without noise: the mean over ``poses``, which are equal parts of the exposure."""
    parts, fine = max(round(PARTS / math.sqrt(len(poses))), 2), cut(scene)
    exposed = np.zeros((fine.height, fine.width))
    for pose in poses:
        cover(exposed, fine, pose, parts)
    part = together(exposed / len(poses), scene)
    v, u = np.mgrid[: scene.height, : scene.width]
    light = 1 + scene.slope[0] * (u / scene.width - 0.5) + scene.slope[1] * (v / scene.height - 0.5)
    return np.asarray(light * (scene.black + (scene.white - scene.black) * part))


def photograph(scene: Scene, poses: Sequence[Pose], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    return developed(scene, clean(scene, poses), rng)


def developed(scene: Scene, grey: Array, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Clean grey levels with noise, as whole numbers."""
    sd = np.sqrt(scene.read_noise**2 + scene.shot_noise**2 * np.maximum(grey, 0.0))
    return np.clip(np.rint(grey + sd * rng.standard_normal(grey.shape)), 0, 255).astype(np.uint8)


def board(scene: Scene, pose: Pose, texture: Array, size: tuple[float, float]) -> Array:
    """Grey levels without noise of a flat picture on the tip plate in place of discs: ``texture`` is its white share,
    ``size`` m, its middle at the origin. A pixel whose corners and middle are not all alike is sampled at the 21 places
    of a Fibonacci lattice in each of its parts, no two of which are in a row or a column: an edge along the rows of the
    image is then as fine as any other."""
    box = (0, 0, scene.width, scene.height)
    ray_x, ray_y, k = rays(box, scene.focal, tuple(scene.centre), tuple(scene.distortion))
    sign = 1.0 if scene.view == 'outside' else -1.0
    high, wide = texture.shape

    def sampled(of: npt.NDArray[np.bool_], du: float, dv: float) -> Array:
        rx, ry = (r[of] + a[of] * du + b[of] * dv for r, a, b in ((ray_x, k[0], k[1]), (ray_y, k[2], k[3])))
        x, y = on_plate(scene, pose, rx, ry)
        column = np.floor((sign * x / size[0] + 0.5) * wide).astype(int)
        row = np.floor((0.5 - y / size[1]) * high).astype(int)
        on = (column >= 0) & (column < wide) & (row >= 0) & (row < high)
        return np.where(on, texture[np.clip(row, 0, high - 1), np.clip(column, 0, wide - 1)], 1.0)

    everywhere = np.ones((scene.height, scene.width), dtype=bool)
    middle = sampled(everywhere, 0.0, 0.0).reshape(everywhere.shape)
    ends = [sampled(everywhere, du, dv).reshape(middle.shape) for du in (-0.5, 0.5) for dv in (-0.5, 0.5)]
    edge = np.any(np.array(ends) != middle, axis=0)
    offsets = [((i + 0.5) / 21, (13 * i % 21 + 0.5) / 21) for i in range(21)]
    fine = np.repeat(np.repeat(middle, CUTS, axis=0), CUTS, axis=1)
    for i in range(CUTS):
        for j in range(CUTS):
            parts = [sampled(edge, (j + du) / CUTS - 0.5, (i + dv) / CUTS - 0.5) for du, dv in offsets]
            fine[i::CUTS, j::CUTS][edge] = np.mean(parts, axis=0)
    return np.asarray(scene.black + (scene.white - scene.black) * together(fine, scene))


def over_exposure(motion: Callable[[float], Pose], t: float, exposure: float, instants: int = 12) -> list[Pose]:
    """Return the poses at the middles of equal parts of an exposure that begins at ``t``."""
    return [motion(t + exposure * (i + 0.5) / instants) for i in range(instants)]


def mean_of(poses: Sequence[Pose]) -> tuple[float, float, float]:
    dx, dy, theta = (float(np.mean([getattr(p, name) for p in poses])) for name in ('dx', 'dy', 'theta'))
    return dx, dy, theta
