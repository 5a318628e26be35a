# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Residuals of readings against the pose of the plate that fits them best."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.model.plate.plate import Tilts, flat_points, flat_poses, plate_points, reading_slopes, tied_pose
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig

_STEPS = 7
"""Steps from rest that leave less than the last digit of a nanometre, at the largest poses."""


class PlateModel:
    """Where the beams of a set of PSDs meet the plate, as far as a method knows. ``beams`` (P, 2), m."""

    def __init__(self, rig: Rig, psds: Sequence[int], tilts: Tilts) -> None:
        """``psds``: from 0. ``tilts``: what the method says of the plate's tilts."""
        at = list(psds)
        self._xp = FIXED
        self._centers, self._heights = rig.centers[at], rig.heights[at]
        self.beams = self._centers + rig.zeros[at]
        self._tilts: Tilts = tilts
        self._link = rig.link.slope_ratio, rig.link.length
        self._tie = 0.0 if tilts == 'none' else rig.link.slope_ratio
        self.rest_slopes = self.slopes_at((0.0,) * 5)
        self._gain = self._xp.pseudo_inverse(self.rest_slopes)

    def slopes_at(self, pose: Sequence[float]) -> FloatArray:
        """Return J (C, unknowns), the slopes of the readings at ``pose``: dX, dY m, theta, phi, omega rad."""
        return reading_slopes(self.beams, self._heights, np.array(pose), self._tilts, *self._link, self._xp)

    def residuals(self, dots: FloatArray) -> FloatArray:
        """Return ``dots`` (n, C) minus those of the best pose, m, all readings of one weight."""
        points = self._centers + dots.reshape(len(dots), -1, 2)
        heights = self._heights if self._tilts != 'none' else np.zeros(len(self._heights))
        unknowns = np.zeros((len(dots), self._gain.shape[0]))
        # The slopes at rest are right to some per cent, so each step leaves some per cent of the error before it.
        for _ in range(_STEPS):
            pose = unknowns if self._tilts == 'free' else tied_pose(unknowns, self._tie, self._link[1])
            there = plate_points(pose, self.beams, heights, self._xp)
            residuals: FloatArray = (points - there).reshape(len(dots), -1)
            unknowns = unknowns + self._xp.einsum('us,ns->nu', self._gain, residuals)
        return residuals

    def residual(self, dots: tuple[float, ...], residual: tuple[float, ...]) -> tuple[float, ...]:
        """Return the residual (C,), m, of ``dots`` at a pose near the best; ``residual``: that of the method.

        A method for small angles leaves its own error besides: for a flat plate it is computed anew.
        """
        if self._tilts != 'none':
            return residual
        points = self._centers + np.reshape(dots, (-1, 2))
        anew = points - flat_points(flat_poses(points, self.beams, self._xp), self.beams, self._xp)
        return tuple(anew.ravel().tolist())
