# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What one frame gives: a pose with its covariance, or the reason why there is none."""

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from psd_deflection.records import FloatArray, ReferenceWithCovariance


class Status(StrEnum):
    """Why a frame has no answer; the value is what the CSV and ``/diagnostics`` say."""

    OK = 'ok'
    UNREADABLE = 'unreadable image'
    TOO_LARGE = 'image too large'
    OTHER_SIZE = 'not of the size of the first image'
    CLUTTERED = 'too many outlines'
    MISSING = 'no target'
    HIDDEN = 'partly hidden'
    OUTSIDE = 'outside the image'
    DOUBLED = 'more than one target'
    SATURATED = 'saturated'
    GHOST = 'doubled'
    BLURRED = 'motion blur too long'
    DEFOCUSED = 'out of focus'
    SMALL = 'target too small'
    OBLIQUE = 'too oblique'
    MISFIT = 'image does not fit the target'
    HALF_TURN = 'turned too far since the last answer'


class NoPoseError(Exception):
    """This frame has no answer, for the reason ``status``; ``note``: a number or a size that belongs to it, or ''."""

    def __init__(self, status: Status, note: str = '') -> None:
        super().__init__(f'{status} ({note})' if note else str(status))
        self.status = status


class TargetPose(NamedTuple):
    """Where the target is in the camera's axes: a point P of the target lies at ``rotation @ P + place``, m.

    ``covariance`` (6, 6) of a small turn about the target's own axes (rad) and of ``place`` (m), (8, 8) with
    ``keystone``.
    ``cost``: minus twice the log likelihood for each of the ``residuals``, to compare two poses of one image.
    ``points`` (n, 2): pixels of what was found (centres of discs, corners). ``blur``: length of the motion blur, px.
    ``scale``: apparent radius of the discs, in units of what the spacing makes it (1.0 for other targets).
    ``noise``: rms of the residuals, grey levels or px. ``planar``: the distance is not known (no camera matrix).
    ``model_error``: difference between picture and model beyond noise, rms in units of the contrast.
    ``keystone`` (0 or 2): perspective of a lens that is not known, 1/m: a point (x, y) of the target is 1 + keystone
    (x, y) times as far as the rotation says.
    """

    rotation: FloatArray
    place: FloatArray
    covariance: FloatArray
    cost: float
    residuals: int
    points: FloatArray
    blur: float = 0.0
    scale: float = 1.0
    noise: float = 0.0
    planar: bool = False
    model_error: float = 0.0
    keystone: FloatArray = np.zeros(0)

    @property
    def plane(self) -> FloatArray:
        """(3, 3): (x, y, 1) on the target to its ray."""
        return plane_of(self.rotation, self.place, self.keystone)


def plane_of(rotation: FloatArray, place: FloatArray, keystone: FloatArray) -> FloatArray:
    """(3, 3): (x, y, 1) on a target to its ray, in the camera's axes."""
    plane = np.array(rotation)
    plane[:, 2] = place
    if keystone.size:
        plane[2, :2] += place[2] * keystone
    return plane


class FrameAnswer(NamedTuple):
    """The tip in ``link_tip_rest`` at the middle of the exposure.

    ``dx``, ``dy`` m, ``theta``, ``phi``, ``omega`` rad (NaN without an answer);
    ``covariance`` (3, 3) of (dx, dy, theta). ``words``: the status, with the number or size that belongs to it.
    """

    t_ns: int
    status: Status
    dx: float = float('nan')
    dy: float = float('nan')
    theta: float = float('nan')
    phi: float = float('nan')
    omega: float = float('nan')
    covariance: FloatArray | None = None
    target: TargetPose | None = None
    words: str = str(Status.OK)

    def as_record(self) -> ReferenceWithCovariance | None:
        """Return the record that is published and recorded; None without a pose."""
        if self.covariance is None:
            return None
        covariance = tuple(map(float, self.covariance.ravel()))
        angles = (float(self.theta), float(self.phi), float(self.omega))
        return ReferenceWithCovariance(self.t_ns, float(self.dx), float(self.dy), *angles, covariance)
