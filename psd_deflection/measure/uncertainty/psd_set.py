# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit and check of a set of PSDs: all of a rig, or a subset while the others cannot be trusted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from psd_deflection.measure.uncertainty.block_fit import BlockFit, Fitted
from psd_deflection.measure.uncertainty.consistency import (
    BaseLineExcess,
    ConsistencyCheck,
    Unexplained,
    UnexplainedResidual,
)
from psd_deflection.measure.uncertainty.noise import StreamNoise
from psd_deflection.measure.uncertainty.plate_model import PlateModel
from psd_deflection.measure.uncertainty.vibration import Tone
from psd_deflection.model.plate.plate import Tilts
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.rig.config import Rig


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
        own = np.ix_(self.columns, self.columns)
        self.fit.set_noise(noise.gamma[own], [Tone(t.frequency, t.covariance[own]) for t in noise.tones])

    def fits(self, slots: IntArray, samples: FloatArray) -> Iterator[Fitted]:
        """Fit blocks in turn: their places ``slots`` (n,) and the ``samples`` (B, n, 2P) m of all PSDs."""
        return self.fit.fits(slots, samples if self.is_full else samples[:, :, self.columns])

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
