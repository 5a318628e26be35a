# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Judges a fitted picture: rejects one that is not of the target at rest or in plain motion; else its covariance."""

import itertools
import math

import numpy as np

from psd_deflection.camera.answer import NoPoseError, Status, TargetPose
from psd_deflection.camera.lens import Lens
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
    covariance_of,
    eigenvalues,
    motion_of,
)
from psd_deflection.records import FloatArray, IntArray

_HALF_OCTANT = math.tan(math.pi / 8)
_SECTORS = 16
"""Parts of a rim whose residuals are taken together: what is correlated along a rim widens the covariance."""

CENTRE_FLOOR = 0.002
"""Error of a disc's centre that no residual shows, one sd in px."""

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


class RimClassifier:
    """Judges the pictures of the discs of one target by one camera."""

    def __init__(self, lens: Lens, columns: int, centres: FloatArray) -> None:
        self._lens, self._columns, self._centres = lens, columns, centres
        self._points = np.column_stack([centres, np.ones(len(centres))])

    def pose(
        self,
        normal: Normal,
        rims: Rims,
        shape: Shape,
        step: FloatArray,
        prior: PosePrior,
        pixel_radius: float,
        full_scale: float,
    ) -> TargetPose:
        """The pose with the covariance that the residuals show. Raises RejectedError if they show another picture."""
        contrast = shape.light[:, 3] - shape.light[:, 0]
        if contrast.min() <= 0.0 or contrast.min() < 0.3 * contrast.max():
            raise NoPoseError(Status.HIDDEN)
        motion = motion_of(shape.blur)
        sharp = math.sqrt(eigenvalues(shape.blur)[0])
        if math.sqrt(12.0) * motion > MOST_BLUR * pixel_radius:
            raise NoPoseError(Status.BLURRED)
        if sharp > MOST_DEFOCUS * pixel_radius:
            raise NoPoseError(Status.DEFOCUSED)
        count = len(rims.level)
        stiff, pull = beforehand(shape, prior)
        remainder = normal.squares - float(step @ (2.0 * normal.gradient - normal.hessian @ step))
        chi_square = max(remainder / (count - 30), 1e-9)
        inverse = covariance_of(normal, chi_square, stiff)
        pose = [*range(6), *range(10 + shape.skew.size, len(inverse))]
        *pulls, residual = after(normal, rims, step, inverse[pose])
        raw = residual if normal.root is None else residual / normal.root
        sector = sectors_of(normal.side, rims)
        relative = raw / float(contrast.mean())
        if motion > _DOUBLED_FROM * max(sharp, 0.5) and _doubled(normal, relative, shape.blur):
            raise NoPoseError(Status.GHOST)
        model_error = _model_error(normal.z, relative, sector, rims, full_scale)
        if model_error > MOST_MISFIT + MISFIT_OF_BLUR * min(max(motion / sharp - 0.5, 0.0), 1.5):
            raise NoPoseError(Status.MISFIT)
        # What the model does not say: a level that is off by the misfit moves the rim by that over the steepest rise.
        # It may be one disc's alone, and moves a rim more easily than it bends one.
        wrong = 4.0 * model_error * ROOT_2PI * math.hypot(sharp, motion)
        bent = inverse @ _of_bent_rims(normal, rims) / (pixel_radius * chi_square)
        bent *= np.tile(np.repeat((math.hypot(CENTRE_FLOOR, wrong), 0.5 * wrong), (2, 3)), 3)
        # Pixels may be wrong together: along a rim, or along the rows or columns in which a camera is read.
        weighted = residual / np.float32(chi_square)
        line = rims.pixel // self._columns
        column = rims.pixel - self._columns * line
        squares = np.zeros(len(pose))
        # Pixels of one line follow each other.
        begin = np.concatenate([[0], 1 + np.flatnonzero(line[1:] != line[:-1])])
        lines = line[begin]
        for k, row in enumerate(pulls):
            row *= weighted
            totals = (
                np.bincount(sector, row),
                np.bincount(column, row),
                np.bincount(lines, np.add.reduceat(row, begin)),
            )
            squares[k] = max(float(total @ total) for total in totals)
        inverse = inverse[pose][:, pose]
        wider = np.sqrt(np.maximum(squares / inverse.diagonal(), 1.0))
        covariance = inverse * np.outer(wider, wider)
        covariance += bent[pose] @ bent[pose].T
        # What the first three moments of the motion do not say of its mean.
        covariance[:6, :6] += self.moved_centres(shape, MEAN_OF_BLUR * max(motion - 0.15, 0.0))
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
            model_error=model_error,
            keystone=shape.keystone,
        )

    def moved_centres(self, shape: Shape, pixels: float) -> FloatArray:
        """Covariance (6, 6) of an error of ``pixels`` that the discs share, or that turns them about the normal."""
        variance = (pixels * float(shape.place[2]) / self._lens.focal) ** 2
        out = np.zeros((6, 6))
        out[2, 2] = variance / float(np.sum(self._centres**2))
        out[3:, 3:] = shape.rotation @ np.diag([variance, variance, 0.0]) @ shape.rotation.T
        return out


def _model_error(z: Pixels, raw: Pixels, sector: IntArray, rims: Rims, full_scale: float) -> float:
    """How far the picture is from the model beyond noise, rms in units of the contrast, as ``raw`` is.

    Pixels are taken together by sector and by their distance from the rim. What all sectors have in common is the
    camera's own profile, which moves no centre. Raises RejectedError.
    """
    parts, worst = 3 * _SECTORS, 0.0
    if rims.level.max() >= full_scale - 1.0:
        worst = _unevenness(z, raw, rims, full_scale)
        if worst > UNEVEN:
            raise NoPoseError(Status.SATURATED)
    if math.sqrt(float(raw @ raw) / len(raw)) > MOST_NOISE:
        raise NoPoseError(Status.MISFIT)
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
        raise NoPoseError(Status.HIDDEN)
    return math.hypot(math.sqrt(max(float(excess.sum() / max(filled.sum(), 1)), 0.0)), worst)


def _doubled(normal: Normal, raw: Pixels, blur: FloatArray) -> bool:
    """Return whether the plate was seen in two places, not in motion: the places between were not exposed.

    The rims that lie across the blur show how long it was where, as the steepness of the grey level there.
    """
    along = np.linalg.eigh(blur)[1][:, 1]
    across = normal.side[0] * float(along[0]) + normal.side[1] * float(along[1])
    level = normal.rows[3] if normal.root is None else normal.rows[3] / normal.root
    observed = level + raw
    dwell = np.zeros(_DWELL)
    for end in (1.0, -1.0):
        of = across * end > 0.9
        place = np.clip((normal.z[of] * end + 3.0) * (_DWELL / 6.0), 0, _DWELL).astype(int)
        count = np.bincount(place, minlength=_DWELL + 1)
        if count[:-1].min() < 4:
            return False
        mean = np.bincount(place, observed[of], _DWELL + 1) / np.maximum(count, 1)
        dwell[1:] += end * np.diff(mean[:-1])
    # The two highest places with the lowest between them.
    remainder = np.maximum.accumulate(dwell)
    right = np.maximum.accumulate(dwell[::-1])[::-1]
    return bool(np.any(dwell[1:-1] < DIP * np.minimum(remainder[:-2], right[2:]) - 0.015))


def _unevenness(z: Pixels, raw: Pixels, rims: Rims, full_scale: float) -> float:
    """Of the rises of discs that reach full scale: blooming ends a rise before it has reached its level."""
    worst = 0.0
    for a, b in zip(rims.begin[:-1].tolist(), rims.begin[1:].tolist(), strict=True):
        here, off = z[a:b], raw[a:b]
        if float(np.mean(rims.level[a:b][here > 1.0] >= full_scale - 1.0)) > 0.1:
            high, low = off[(here > 0.3) & (here < 1.2)], off[(here < -0.3) & (here > -1.2)]
            if len(high) and len(low):
                worst = max(worst, abs(float(high.mean() + low.mean())) / 2)
    return worst


def _of_bent_rims(normal: Normal, rims: Rims) -> FloatArray:
    """What rims that are not where the model has them do to the gradient (p, 15), for a shift of the pixel radius.

    Of each disc five columns: the shifts by the cosine and sine of the angle around it, by those of twice the angle,
    which are a tilt, and all around.
    """
    # Some of the pixels are enough for what only widens the covariance.
    x, y = (side[::THINNED] for side in normal.side)
    rows = np.ascontiguousarray(normal.rows[:-1, ::THINNED])
    # The derivative by the radius is that by a shift of the whole rim.
    around = np.empty((5, len(x)), dtype=np.float32)
    np.multiply(rows[LIGHTS + 6], THINNED, out=around[4])
    np.multiply(x, around[4], out=around[0])
    np.multiply(y, around[4], out=around[1])
    np.multiply(x, around[0], out=around[2])
    around[2] -= y * around[1]
    np.multiply(y, around[0], out=around[3])
    around[3] *= 2.0
    begin = (-(-rims.begin // THINNED)).tolist()
    by_row = np.array([rows[:, a:b] @ around[:, a:b].T for a, b in itertools.pairwise(begin)])
    by_shape = by_row[:, LIGHTS:] - normal.back[:, :, :-1].transpose(0, 2, 1) @ by_row[:, :LIGHTS]
    return np.hstack([*by_shape])


def sectors_of(side: tuple[Pixels, Pixels], rims: Rims) -> IntArray:
    """Return the part of a rim to which each pixel belongs, counted through all discs: 16 parts of equal angle."""
    x, y = np.abs(side[0]), np.abs(side[1])
    part = (np.minimum(x, y) > _HALF_OCTANT * np.maximum(x, y)).astype(np.uint8)
    for bit in (y > x, side[1] > 0, side[0] > 0):
        part += part
        part += bit
    return np.asarray(np.repeat(_SECTORS * np.arange(len(rims.begin) - 1), np.diff(rims.begin)) + part)
