# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The motion that the detectors saw, at any instant, from the samples around it.

The dots of each channel are fitted with a polynomial over the samples near the instant (local least
squares; Savitzky and Golay, Anal. Chem. 36, 1627, 1964), and the pose is solved from the fitted dots.
So the pose is that of the instant, also while the link rings, and any solver can be asked for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from psd_deflection.records import FloatArray

Solve = Callable[[FloatArray], FloatArray]
"""Dots (n, 4), m, to poses (n, 3): dX m, dY m, theta rad; NaN if there is no answer."""

HALF = 8
"""Samples on either side of the instant."""
ORDER = 4
"""Of the polynomial: with 17 samples at 1 kHz it follows 21 Hz to 1e-4."""
LEAST = 12
"""Samples that the fit needs, at least three of them on either side of the instant."""

ROWS = 20_000
"""Instants that are fitted at once."""


@dataclass
class Motion:
    """The samples of a run.

    ``t`` (n,), s, increasing. ``dots`` (n, 4), m, calibrated and corrected. ``period`` of the samples, s. ``solve``:
    the solver.
    """

    t: FloatArray
    dots: FloatArray
    period: float
    solve: Solve
    _grid: tuple[FloatArray, npt.NDArray[np.bool_]] | None = field(default=None, repr=False)

    def dots_at(self, t: FloatArray, exposure: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Dots (k, 4), m, their rates (k, 4), m/s, and variances of the dots (k, 4), m^2, at ``t`` (k,).

        ``exposure``: s; the values are means over this time about ``t``. NaN if too few samples are near.
        """
        parts = [self._fitted(t[i : i + ROWS], exposure) for i in range(0, max(len(t), 1), ROWS)]
        values, rates, variances = (np.concatenate(p) for p in zip(*parts, strict=True))
        return values, rates, variances

    def _fitted(self, t: FloatArray, exposure: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        half = HALF + int(np.ceil(0.5 * exposure / self.period))
        reach = (half + 0.5) * self.period
        middle = np.searchsorted(self.t, t)
        index = middle[:, None] + np.arange(-half - 1, half + 1)
        there = (index >= 0) & (index < len(self.t))
        index = np.clip(index, 0, len(self.t) - 1)
        u = (self.t[index] - t[:, None]) / reach
        there &= np.abs(u) <= 1.0
        used = there.sum(axis=1)
        enough = (used >= LEAST) & ((there & (u < 0)).sum(axis=1) >= 3) & ((there & (u >= 0)).sum(axis=1) >= 3)
        powers = np.arange(ORDER + 1)
        design = np.where(there[:, :, None], u[:, :, None] ** powers, 0.0)
        readings = np.where(there[:, :, None], self.dots[index], 0.0)
        # An instant without samples has no answer; its normal matrix would be singular.
        normal = np.where(enough[:, None, None], design.transpose(0, 2, 1) @ design, np.eye(ORDER + 1))
        inverse = np.linalg.inv(normal)
        terms = inverse @ (design.transpose(0, 2, 1) @ readings)
        span = 0.5 * exposure / reach
        # The mean of u^k over the exposure; of odd powers it is 0.
        mean = np.where(powers % 2 == 0, span**powers / (powers + 1.0), 0.0)
        # The difference of the ends over the exposure; without one, the derivative.
        rate = np.where(powers % 2 == 1, span ** np.maximum(powers - 1.0, 0.0), 0.0) / reach
        values = np.einsum('p,kpc->kc', mean, terms)
        rates = np.einsum('p,kpc->kc', rate, terms)
        residual = np.where(there[:, :, None], self.dots[index] - design @ terms, 0.0)
        scatter = (residual * residual).sum(axis=1) / np.maximum(used - ORDER - 1, 1)[:, None]
        shrink = np.einsum('p,kpq,q->k', mean, inverse, mean)
        out = (values, rates, scatter * shrink[:, None])
        for array in out:
            array[~enough] = np.nan
        return out

    def poses_at(self, t: FloatArray, exposure: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Poses (k, 3) at ``t``, m, m, rad, and their rates, per second."""
        values, rates, _ = self.dots_at(t, exposure)
        poses = np.full((len(t), 3), np.nan)
        speeds = np.full((len(t), 3), np.nan)
        good = np.isfinite(values).all(axis=1)
        if good.any():
            poses[good] = self.solve(values[good])
            # The pose over a tenth of a sample, by the fitted rates of the dots.
            step = 0.1 * self.period
            ahead, behind = (self.solve(values[good] + sign * step * rates[good]) for sign in (1.0, -1.0))
            speeds[good] = (ahead - behind) / (2.0 * step)
        return poses, speeds

    def grid(self) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Poses (m, 3) of single samples on an even grid from the first sample, and which of them were measured (m,).

        Poses that are missing lie on straight lines between their neighbours.
        """
        if self._grid is None:
            place = np.rint((self.t - self.t[0]) / self.period).astype(np.int64)
            poses = self.solve(self.dots)
            good = np.isfinite(poses).all(axis=1)
            n = int(place[-1]) + 1
            there = np.zeros(n, dtype=bool)
            there[place[good]] = True
            at = np.flatnonzero(there)
            single = np.zeros((n, 3))
            single[place[good]] = poses[good]
            filled = np.stack([np.interp(np.arange(n), at, single[at, i]) for i in range(3)], axis=1)
            self._grid = (filled, there)
        return self._grid
