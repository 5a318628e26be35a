# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The model of three discs in a picture: its parameters, the equations of one least squares, their covariance.

Every pixel near a rim has a signed distance s (px) from it: its ray meets the target's plane at a distance rho from
a disc's centre, and s = (radius - rho) / |grad rho|. So lens distortion and perspective, by which the centre of a
disc's picture is not the picture of its centre, are in the model and leave no bias (Heikkila 2000; Song et al. 2024).
The grey level goes from outside to inside as

    I = outside + (inside - outside) (Phi(z) - gamma(n) / 6 (z^2 - 1) phi(z)),  z = (s - t^T S t / 2 R) / sqrt(n^T S n)

with n, t the rim's normal and tangent in the image, R its radius of curvature and S (2, 2) the variance of the blur,
px^2. ``gamma`` is the skewness of the motion within the exposure along n: with it, s = 0 stays the place of the *mean*
over the exposure (Gram-Charlier) for a motion that is not uniform. ``inside`` and ``outside`` are linear in the image
for each disc, which takes uneven light; they are eliminated from the normal equations. Pixels are taken as they are,
not interpolated: their noise stays independent, and the fit reaches the Cramer-Rao bound. Pixels are kept as float32,
which is good to 1e-5 px here and twice as fast; the normal equations are in float64.

If the lens is not known, perspective is fitted as two numbers of its own ("keystone", 1/m): a point (x, y) of the
target is then farther by the factor 1 + keystone (x, y), whatever the focal length.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.camera.answer import NoPoseError, Status, plane_of
from psd_deflection.camera.lens import AFFINE_FOCAL
from psd_deflection.records import FloatArray, IntArray

THINNED = 4
"""The first steps use each pixel whose number is divisible by it."""

LIGHTS = 6
"""For each disc: constant and slopes of the light outside, then inside."""

RADIUS_SD = 0.03
"""Standard deviation of the radius that is seen against the declared one (print, exposure, response), relative."""

_SHARPEST = 0.25
"""Smallest blur, px: a pixel's own width."""

ROOT_2PI = math.sqrt(2.0 * math.pi)

Pixels = npt.NDArray[np.float32]


class PosePrior(NamedTuple):
    """What is known of the pose beforehand: tilts about the target's X and Y against ``rotation``, one ``sd``, rad.

    ``keystone``: what is expected of it, in the axes of ``rotation``, if the lens is not known.
    """

    rotation: FloatArray
    sd: float
    keystone: FloatArray


class Rims(NamedTuple):
    """The pixels near the rims, disc after disc: ``begin`` (4) of each disc, grey levels, rays (3, n), place (3, n) in
    the image as (1, u, v) from the disc's centre in units of its size; ``bend`` (3, 2, 2): d ray / d pixel there;
    ``pixel``: number of the pixel in the image."""

    begin: IntArray
    level: Pixels
    rays: Pixels
    flat: Pixels
    bend: FloatArray
    pixel: IntArray

    def thinned(self) -> Rims:
        """Return each fourth pixel, for the first steps."""
        chosen = np.s_[::THINNED]
        begin = -(-self.begin // THINNED)
        rays, flat = np.ascontiguousarray(self.rays[:, chosen]), np.ascontiguousarray(self.flat[:, chosen])
        return Rims(begin, self.level[chosen], rays, flat, self.bend, self.pixel[chosen])


class Shape(NamedTuple):
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


class Normal(NamedTuple):
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


def covariance_of(normal: Normal, variance: float, stiff: FloatArray) -> FloatArray:
    """Covariance of the parameters, if a residual has ``variance``. Raises RejectedError."""
    hessian = normal.hessian / variance
    diagonal = np.einsum('ii->i', hessian)
    diagonal += stiff
    diagonal *= 1.0 + 1e-9
    try:
        return np.asarray(np.linalg.inv(hessian), dtype=float)
    except np.linalg.LinAlgError:
        raise NoPoseError(Status.MISFIT) from None


def after(normal: Normal, rims: Rims, step: FloatArray, ways: FloatArray) -> Pixels:
    """``ways`` (q, p) @ the derivatives with the lights eliminated, then the residuals after ``step``.

    (q + 1, n), weighted as ``normal.rows`` are. The step must be small.
    """
    q, parameters = len(ways), len(step)
    onto = np.zeros((len(normal.back), q + 1, LIGHTS + parameters + 1))
    onto[:, :q, LIGHTS:-1] = ways
    onto[:, q, LIGHTS:-1] = -step
    onto[:, :, :LIGHTS] = -onto[:, :, LIGHTS:-1] @ normal.back[:, :, :-1].transpose(0, 2, 1)
    onto[:, q, :LIGHTS] -= normal.back[:, :, -1]
    onto[:, q, -1] = 1.0
    begin = rims.begin.tolist()
    out = np.empty((q + 1, begin[-1]), dtype=np.float32)
    for a, b, block in zip(begin[:-1], begin[1:], onto.astype(np.float32), strict=True):
        np.matmul(block, normal.rows[:, a:b], out=out[:, a:b])
    return out


def below(z: Pixels, bell: Pixels) -> Pixels:
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


def expected(prior: PosePrior, rotation: FloatArray) -> FloatArray:
    """Return the keystone that ``prior`` expects, in the axes of ``rotation``."""
    return np.asarray((rotation.T @ prior.rotation)[:2, :2] @ prior.keystone)


def beforehand(shape: Shape, prior: PosePrior) -> tuple[FloatArray, FloatArray]:
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
        pull[size:] = expected(prior, shape.rotation) - shape.keystone
    return stiff, pull


def moved(shape: Shape, step: FloatArray, light: FloatArray) -> Shape:
    """``shape`` after ``step`` of the parameters, within their bounds, with these lights."""
    by_xx, by_xy, by_yy = step[7:10].tolist()
    blur = np.add(shape.blur, [[by_xx, by_xy], [by_xy, by_yy]])
    small, large = eigenvalues(blur)
    if small < _SHARPEST**2 or large > 900.0:
        values, vectors = np.linalg.eigh(blur)
        blur = (vectors * np.clip(values, _SHARPEST**2, 900.0)) @ vectors.T
    skews = shape.skew.size
    return Shape(
        shape.rotation @ rotation_matrix(step[:3]),
        shape.place + step[3:6],
        min(max(shape.swell + float(step[6]), 0.7), 1.4),
        blur,
        np.clip(shape.skew + step[10 : 10 + skews], -1.5, 1.5) if skews else shape.skew,
        light,
        shape.keystone + step[10 + skews :],
    )


def rotation_matrix(v: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) about ``v`` by its length, rad (Rodrigues)."""
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


def motion_of(blur: FloatArray) -> float:
    """Standard deviation of the motion within the exposure, px: what the blur has more along one axis."""
    small, large = eigenvalues(blur)
    return math.sqrt(large - small)


def width(blur: FloatArray) -> float:
    """How far from a rim its pixels are used, px: up to where a rise of this blur has ended."""
    return max(3.2 * math.sqrt(eigenvalues(blur)[1]) + 1.7, 3.5)


def eigenvalues(blur: FloatArray) -> tuple[float, float]:
    """Return the eigenvalues of a variance (2, 2), the smaller first."""
    (xx, xy), (_, yy) = blur.tolist()
    half, apart = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    return half - apart, half + apart
