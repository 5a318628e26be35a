# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The thesis's target: three white discs in a line on black (section 5.2). Image -> pose of the target."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.camera.answer import NoPoseError, Status, TargetPose
from psd_deflection.camera.discs.find_discs import MIN_RADIUS, Region, find_discs
from psd_deflection.camera.discs.rim_fit import Fitter
from psd_deflection.camera.discs.rim_model import PosePrior, rotation_matrix
from psd_deflection.camera.lens import Lens
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.camera.target import Drawing, Target
from psd_deflection.records import FloatArray

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
    own = ('spacing', 'radius')

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
        self._up = np.array([math.sin(settings.turn), -math.cos(settings.turn)])
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
            size=(2 * around, 2 * (self._spacing + around)),
            discs=tuple((0.0, y, self._radius) for y in places),
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
                turn = best.rotation.T @ other.rotation
                off = np.concatenate([(turn - turn.T)[(2, 0, 1), (1, 2, 0)] / 2, other.place - best.place])
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
        far = -float((off * (right - at)).sum() / (off * off).sum())
        place = np.array([*(at + ray * far).tolist(), far])
        if place[2] <= 0.0:
            raise NoPoseError(Status.MISFIT)
        return np.asarray(place)
