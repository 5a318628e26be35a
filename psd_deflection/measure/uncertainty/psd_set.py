# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit and check of a set of PSDs: all of a rig, or a subset while the others cannot be trusted."""

from collections.abc import Sequence

import numpy as np

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.measure.uncertainty.block_fit import BlockFit
from psd_deflection.measure.uncertainty.consistency import (
    BaseLineExcess,
    ConsistencyCheck,
    Unexplained,
    UnexplainedResidual,
)
from psd_deflection.measure.uncertainty.noise import StreamNoise
from psd_deflection.measure.uncertainty.vibration import Tone
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


class PsdSet:
    """``psds``: from 0; ``is_full``: all of the rig. ``columns``: of their readings. ``check``: of these readings."""

    def __init__(self, rig: Rig, psds: Sequence[int], tilts: Tilts) -> None:
        """``psds``: two or more. ``tilts``: what the method that solves them says of the plate's tilts."""
        self.psds = tuple(psds)
        self.is_full = len(self.psds) == len(rig.psds)
        self.columns = [2 * psd + axis for psd in self.psds for axis in (0, 1)]
        self._tilts: Tilts = tilts
        at = list(self.psds)
        self.fit = BlockFit(rig.estimator.block_size, rig.centers[at], rig.centers[at] + rig.zeros[at])
        self.set_geometry(rig)

    def set_geometry(self, rig: Rig) -> None:
        """Use the places of ``rig`` from now on; :meth:`set_noise` must follow."""
        at, count = list(self.psds), len(self.psds)
        (x1, y1), (x2, y2) = rig.centers[at][:2].tolist()
        self._apart = (x1 - x2, y1 - y2)
        # Of two PSDs that are all of a rig the base line is known without a model of the plate.
        self.model = None if self.is_full and count == 2 else PlateModel(rig, at, self._tilts)
        slopes = None if self.model is None else self.model.rest_slopes
        unknowns = 3 if slopes is None else slopes.shape[1]
        # If the plate's tilt is only bounded, dots may contradict each other.
        unknowns = 2 * count if self._tilts == 'bounded' else unknowns
        self.check = ConsistencyCheck(count, unknowns, 1 if self.model is None else 2 * count)
        self.fit.set_geometry(rig.centers[at], rig.centers[at] + rig.zeros[at], slopes)

    def set_noise(self, noise: StreamNoise) -> None:
        """Use their part of the noise of all readings."""
        indices = np.ix_(self.columns, self.columns)
        self.fit.set_noise(noise.gamma[indices], [Tone(t.frequency, t.covariance[indices]) for t in noise.tones])

    def unexplained(
        self, dots: tuple[float, ...], residual: tuple[float, ...], covariance: FloatArray, pose: Sequence[float]
    ) -> Unexplained | None:
        """Return what no pose explains, None if nothing is redundant.

        ``dots``, ``residual`` (C,) m, ``covariance`` (C, C) m^2, ``pose``: dX, dY m, theta, phi, omega rad.
        """
        if self.model is not None:
            if not self.check.freedom:
                return None
            return UnexplainedResidual(self.model.residual(dots, residual), self.model.slopes_at(pose), covariance)
        x1, y1, x2, y2 = dots
        ax, ay = self._apart
        apart = ax + x1 - x2, ay + y1 - y2
        return BaseLineExcess(apart, residual, covariance) if apart != (0.0, 0.0) else None

    def state(self) -> tuple[float, ...]:
        """Return the state as numbers."""
        check = self.check.state()
        return (float(len(check)), *check, *self.fit.state())

    def load_state(self, values: tuple[float, ...]) -> None:
        """Go on from :meth:`state`. Raises ValueError if it is that of other PSDs or another block size."""
        head = 1 + int(values[0])
        self.check.load_state(values[1:head])
        self.fit.set_state(values[head:])
