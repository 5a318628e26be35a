# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The thesis's target: three white discs in a line on black (section 5.2). Image -> pose of the target."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.camera.answer import NoPoseError, Status, TargetPose
from psd_deflection.camera.lens import Lens
from psd_deflection.camera.opencv import opencv
from psd_deflection.camera.rim_fit import Fitter
from psd_deflection.camera.rim_model import PosePrior, rotation_matrix
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.camera.target import Drawing, Target
from psd_deflection.records import FloatArray

CLEAR = 8.0
"""Least distance of another bright thing from the rim of a disc, px."""

MIN_RADIUS = 6.0
"""Smallest half-width of a disc, px."""

_MIN_AXIS_RATIO = 0.42
_ELLIPSE_MISFIT = 0.06
"""Largest difference between the area of a region and that of the ellipse with its second moments, relative."""

_MIDDLE_TOLERANCE = 0.25
_RATIO_TOLERANCE = 0.12
_SIZE_TOLERANCE = 0.25
_MAX_REGIONS = 400
_MOST_EDGES = 1_000_000
"""Changes between bright and dark along the rows: what costs time is the number of outlines, not of pixels."""
_MIN_CONTRAST = 8.0


_COARSE_HEIGHT, _COARSE_RADIUS = 200, 15.0
"""Rows of an image made small for the first look, at least; half-width of a disc in it, px, with which it counts."""


class Region(NamedTuple):
    """An outline: centre (x, y) px, half-axes ``axes`` px, the shorter first.

    ``shape`` (xx, xy, yy), px^2: (u - centre)^T shape^-1 (u - centre) = 1 on the ellipse.
    """

    centre: tuple[float, float]
    shape: tuple[float, float, float]
    axes: tuple[float, float]
    round: bool
    at_border: bool

    def half_width(self, x: float, y: float) -> float:
        """Half-width through the centre along a unit vector, px."""
        xx, xy, yy = self.shape
        return math.sqrt((xx * yy - xy * xy) / (yy * x * x - 2.0 * xy * x * y + xx * y * y))

    def away(self, other: Region) -> float:
        """Distance of the centres, px."""
        return math.dist(self.centre, other.centre)

    def enlarged(self, factor: int) -> Region:
        """Return the same in an image whose pixels were taken together ``factor`` x ``factor``."""
        x, y = (factor * c + (factor - 1) / 2 for c in self.centre)
        xx, xy, yy = (factor * factor * s for s in self.shape)
        return self._replace(centre=(x, y), shape=(xx, xy, yy), axes=(factor * self.axes[0], factor * self.axes[1]))


def find_discs(grey: Any, ratio: float) -> list[Region]:
    """Return the three discs in an 8-bit image, from one end of the line to the other; ``ratio``: spacing / radius.

    Large discs show in an image made small, which takes less time; what is not found there is sought in all pixels.
    Raises RejectedError with the reason if there is no target, or more than one.

    Candidates are the bright regions whose outline is an ellipse. Three of them are the target if the middle one halves
    the distance of the others and if the distance, in units of the ellipse's half-width along the line, is the target's
    spacing / radius: a ratio that no view of a plane changes as long as perspective is weak.
    """
    factor = min(grey.shape) // _COARSE_HEIGHT
    if factor > 1:
        rows, columns = (n // factor for n in grey.shape)
        small = opencv().resize(
            grey[: rows * factor, : columns * factor], (columns, rows), interpolation=opencv().INTER_AREA
        )
        try:
            regions = _best_regions([next(_binaries(small, smooth=False))], ratio, CLEAR / factor)
        except NoPoseError as error:
            if error.status is Status.DOUBLED:
                raise
        else:
            if min(r.axes[0] for r in regions) > _COARSE_RADIUS:
                return [r.enlarged(factor) for r in regions]
    return _best_regions(_binaries(grey), ratio, CLEAR)


def _best_regions(binaries: Iterable[Any], ratio: float, clear: float) -> list[Region]:
    best: tuple[int, Status] = (0, Status.MISSING)
    for binary in binaries:
        if np.count_nonzero(binary[:, 1:] != binary[:, :-1]) > _MOST_EDGES:
            best = (5, Status.CLUTTERED)
            continue
        regions = _regions(binary)
        lines = _lines([r for r in regions if r.round and not r.at_border], ratio)
        if len(lines) > 1:
            raise NoPoseError(Status.DOUBLED)
        if lines:
            if _crowded(lines[0], regions, clear):
                raise NoPoseError(Status.DOUBLED)
            return lines[0]
        best = max(best, _why(regions, ratio), key=lambda b: b[0])
    raise NoPoseError(best[1])


def _binaries(grey: Any, *, smooth: bool = True) -> Iterator[Any]:
    """The image cut at several levels: the one between the two commonest first."""
    cv2 = opencv()
    # The first look decides nothing but where to look closer.
    thin = max(min(grey.shape) // (120 if smooth else 60), 1)
    share = np.cumsum(np.bincount(grey[::thin, ::thin].ravel(), minlength=256))
    low, high = np.searchsorted(share, (0.02 * share[-1], 0.998 * share[-1])).tolist()
    if high - low < _MIN_CONTRAST:
        raise NoPoseError(Status.MISSING)
    # Noise of a pixel must not fray the outline; the sub-pixel fit sees the image as it is.
    if smooth:
        grey = cv2.blur(grey, (3, 3))
    level, binary = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    yield binary
    for part in (0.5, 0.25, 0.75):
        other = low + part * (high - low)
        if abs(other - level) > 0.05 * (high - low):
            yield cv2.threshold(grey, other, 255, cv2.THRESH_BINARY)[1]
    block = 2 * (min(grey.shape) // 6) + 1
    yield cv2.adaptiveThreshold(grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, block, -0.1 * (high - low))


def _regions(binary: Any) -> list[Region]:
    cv2 = opencv()
    # As a list: to find out which hole is in which outline takes the square of their number.
    outlines, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    rows, columns = binary.shape
    regions = []
    for outline in outlines:
        # A hole goes around the other way.
        if len(outline) < 12 or cv2.contourArea(outline, True) > 0.0:
            continue
        m = cv2.moments(outline)
        area = m['m00']
        if area < 20.0:
            continue
        scale = 4.0 / area
        xx, xy, yy = scale * m['mu20'], scale * m['mu11'], scale * m['mu02']
        half, apart = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
        least, most = math.sqrt(max(half - apart, 1e-9)), math.sqrt(max(half + apart, 1e-9))
        is_round = (
            abs(math.pi * least * most / area - 1.0) < _ELLIPSE_MISFIT + 0.3 / least and least > _MIN_AXIS_RATIO * most
        )
        x, y, w, h = cv2.boundingRect(outline)
        at_border = x <= 1 or y <= 1 or x + w >= columns - 1 or y + h >= rows - 1
        # The outline joins the centres of the outer pixels: half a pixel is missing all around.
        wider = (least + 0.5) / least
        xx, xy, yy = (s * wider * wider for s in (xx, xy, yy))
        centre = (m['m10'] / area, m['m01'] / area)
        regions.append(Region(centre, (xx, xy, yy), (least * wider, most * wider), is_round, at_border))
    regions.sort(key=lambda r: -r.axes[0] * r.axes[1])
    return regions[:_MAX_REGIONS]


def _lines(regions: list[Region], ratio: float) -> list[list[Region]]:
    """Return every three of ``regions`` that may be the target."""
    lines = []
    large = [r for r in regions if r.axes[0] >= 2.0][:60]
    for i, first in enumerate(large):
        for last in large[i + 1 :]:
            distance = first.away(last) / 2
            if distance < 1.0:
                continue
            along = [(b - a) / (2 * distance) for a, b in zip(first.centre, last.centre, strict=True)]
            widths = [first.half_width(*along), last.half_width(*along)]
            mean = sum(widths) / 2
            if abs(widths[0] - widths[1]) > _SIZE_TOLERANCE * mean:
                continue
            # Where an outline was cut is known to a pixel or so.
            if abs(distance / mean / ratio - 1.0) > _RATIO_TOLERANCE + 1.0 / mean:
                continue
            between = [(a + b) / 2 for a, b in zip(first.centre, last.centre, strict=True)]
            for middle in large:
                off = math.dist(middle.centre, between)
                if off > _MIDDLE_TOLERANCE * mean or middle is first or middle is last:
                    continue
                if abs(middle.half_width(*along) - mean) <= _SIZE_TOLERANCE * mean:
                    lines.append([first, middle, last])
    return lines


def _crowded(line: list[Region], regions: list[Region], clear: float) -> bool:
    """Return whether something as bright and not much smaller is so near to a disc that it lights its rim."""
    for disc in line:
        size = disc.axes[1]
        for other in regions:
            if any(other is d for d in line) or not 0.2 * size < other.axes[1] < 1.5 * size:
                continue
            if disc.away(other) < size + other.axes[1] + clear:
                return True
    return False


def _why(regions: list[Region], ratio: float) -> tuple[int, Status]:
    """Why ``regions`` hold no target, the more telling reason with the higher number."""
    fair = [r for r in regions if r.axes[0] >= MIN_RADIUS]
    complete = [r for r in fair if r.round and not r.at_border]
    if len(complete) in (1, 2):
        reach = 2.4 * ratio * max(r.axes[1] for r in complete)
        if any(r.at_border and r.away(w) < reach and r.axes[1] < 1.5 * w.axes[1] for r in fair for w in complete):
            return 4, Status.OUTSIDE
        return 3, Status.HIDDEN
    if len(complete) >= 3:
        return 2, Status.HIDDEN
    if len(_lines([r for r in regions if not r.at_border], ratio)) == 1:
        return 1, Status.OBLIQUE
    return 0, Status.MISSING


FIRST_TILT_SD = 0.3
"""Tilt of the camera against the target's normal before anything is known of it, one sd, rad."""

AFFINE_TILT_SD = 0.05
"""The same for a camera of unknown focal length, in whose images the sign of a tilt does not show."""

MOTION_TILT_SD = 0.05
"""Tilt of the plate against its rest, one sd, rad: a link of this kind tilts by some hundredths."""

ALIKE = 30.0
"""Twice the log of how much more likely one of two tilts must be: else the covariance has both."""

_OBLIQUE = math.radians(60.0)
_UNSURE = math.cos(math.radians(75.0))


class Discs(Target):
    """Finds and fits the three discs, frame by frame. What it remembers: which end of the line was up, and the rest."""

    kind = 'circles'
    fields = ('spacing', 'radius')

    @classmethod
    def check(cls, settings: CameraSettings) -> None:
        """See :class:`Target`."""
        spacing, radius = settings.spacing, settings.radius
        if not 2.05 * radius < spacing:
            raise ConfigError(f'target.spacing = {spacing:g} m: must be more than twice target.radius ({radius:g} m)')

    def __init__(self, settings: CameraSettings) -> None:
        super().__init__(settings)
        self._spacing, self._radius = settings.spacing, settings.radius
        self._towards = -1.0 if settings.view == 'outside' else 1.0
        self._centres = np.array([[0.0, settings.spacing], [0.0, 0.0], [0.0, -settings.spacing]])
        self._up = np.array([math.sin(settings.rotation), -math.cos(settings.rotation)])
        self._answered = False
        self._plate: FloatArray | None = None
        self._fitter: Fitter | None = None

    def set_rest(self, rest: TargetPose) -> None:
        """From now on the plate's tilt is expected near that of its rest."""
        super().set_rest(rest)
        self._plate = rest.rotation

    def locate(self, image: Any, grey: Any, lens: Lens, full_scale: float) -> TargetPose:
        """See :class:`Target`."""
        regions = find_discs(grey, self._spacing / self._radius)
        if min(r.axes[0] for r in regions) < MIN_RADIUS:
            raise NoPoseError(Status.SMALL)
        if regions[1].axes[0] < math.cos(_OBLIQUE) * regions[1].axes[1]:
            raise NoPoseError(Status.OBLIQUE)
        apart = np.subtract(regions[0].centre, regions[2].centre)
        upright = float(apart @ self._up) / math.hypot(*apart.tolist())
        if self._answered and abs(upright) < _UNSURE:
            # The target looks the same after half a turn.
            raise NoPoseError(Status.HALF_TURN)
        if upright < 0.0:
            regions = regions[::-1]
        pose = self._fit(image, regions, lens, full_scale)
        axis = pose.points[0] - pose.points[2]
        self._up, self._answered = axis / math.hypot(*axis.tolist()), True
        return pose

    def drawing(self) -> Drawing:
        """Three discs in a line along Y, with as much black around them as the finder needs."""
        around = 2.2 * self._radius
        places = (-self._spacing, 0.0, self._spacing)
        return Drawing(
            size=(2 * around, 2 * (self._spacing + around)), discs=tuple((0.0, y, self._radius) for y in places)
        )

    def rest_words(self, rest: TargetPose) -> list[str]:
        """How large the discs look."""
        larger = 100 * (rest.scale - 1)
        return [f'the discs look {larger:+.2f} % larger than target.spacing and target.radius say']

    def _fit(self, image: Any, regions: list[Region], lens: Lens, full_scale: float) -> TargetPose:
        rays = lens.rays(np.array([r.centre for r in regions]))
        frontal = self._frontal(rays)
        if self._rest is None:
            prior = PosePrior(frontal, FIRST_TILT_SD if lens.known else AFFINE_TILT_SD, np.zeros(2))
        else:
            prior = PosePrior(self._rest.rotation, MOTION_TILT_SD, self._rest.keystone)
        if self._plate is None:
            guesses = [frontal @ rotation_matrix(sign * self._tilt(regions[1], frontal)) for sign in (1.0, -1.0)]
        else:
            # The plate as it was, turned in its own plane to where the line of discs is now.
            line = self._plate.T @ frontal[:, 1]
            angle = math.atan2(-line[0], line[1])
            guesses = [self._plate @ rotation_matrix(np.array([0.0, 0.0, angle]))]
        if self._fitter is None:
            self._fitter = Fitter(lens, image.shape, self._centres, self._radius)
        fits, reason = [], NoPoseError(Status.MISFIT)
        for guess in guesses:
            try:
                place = self._place(rays, guess)
                fits.append(self._fitter.fit(image, guess, place, prior, full_scale))
            except NoPoseError as error:
                reason = error
        if not fits:
            raise reason
        best, *alternatives = sorted(fits, key=lambda f: f.cost)
        if not lens.known:
            # Mirrored tilts have the same dX, dY and theta. Of two of them the mean has not: stay with the one.
            self._plate, alternatives = best.rotation if self._plate is None else self._plate, []
        for other in alternatives:
            if (other.cost - best.cost) * best.residuals < ALIKE:
                relative = best.rotation.T @ other.rotation
                off = np.concatenate([(relative - relative.T)[(2, 0, 1), (1, 2, 0)] / 2, other.place - best.place])
                best = best._replace(covariance=best.covariance + np.outer(off, off))
        return best

    def _frontal(self, rays: FloatArray) -> FloatArray:
        """Return the rotation of a plate that faces the camera, by the line of discs."""
        x, y = (rays[0] - rays[2]).tolist()
        long, to = math.hypot(x, y), self._towards
        return np.array([[to * y / long, x / long, 0.0], [-to * x / long, y / long, 0.0], [0.0, 0.0, to]])

    def _tilt(self, region: Region, frontal: FloatArray) -> FloatArray:
        """A turn about the long axis of the ellipse that makes it as narrow as it is, in the target's axes, rad."""
        xx, xy, yy = region.shape
        angle = math.atan2(2.0 * xy, xx - yy) / 2
        ratio = min(region.axes[0] / region.axes[1], 1.0)
        return np.asarray(frontal.T @ [math.cos(angle), math.sin(angle), 0.0] * max(math.acos(ratio), 0.03))

    def _place(self, rays: FloatArray, rotation: FloatArray) -> FloatArray:
        """Where a target of this rotation has its centres on ``rays`` (3, 2): linear least squares."""
        rotated_points = self._centres @ rotation[:, :2].T
        # x - u z = u pz - px for each ray (u, v) and point p, and so in y: x and y are eliminated first.
        right = rays * rotated_points[:, 2:] - rotated_points[:, :2]
        ray, at = rays.sum(axis=0) / len(rays), right.sum(axis=0) / len(rays)
        off = rays - ray
        depth = -float((off * (right - at)).sum() / (off * off).sum())
        place = np.array([*(at + ray * depth).tolist(), depth])
        if place[2] <= 0.0:
            raise NoPoseError(Status.MISFIT)
        return np.asarray(place)
