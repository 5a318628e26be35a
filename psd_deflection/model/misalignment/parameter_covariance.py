# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the uncertainty of a calibration adds to the covariance of an estimate.

The readings are r = f(pose; p). The pipeline takes the effects of p off the dots, so an error of p moves the corrected
dots by -S^-1 (df/dp) dp, S = d(reading)/d(place on the detector). With the covariance P of p and a solver's
gain K (:meth:`psd_deflection.model.solvers.interface.Solver.gain`) the estimate's covariance grows by

    K B B^T K^T,    B = S^-1 (df/dp) P^(1/2).

P holds the unloaded reading too. A zero that is taken by the running daemon replaces its part: its own noise,
independent of the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.model.misalignment.model import ZERO, by_parameters, readings, response_of
from psd_deflection.model.misalignment.rig import is_calibrated, known_of_rig, vector_of_rig
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, check_two_psds

RANGE: FloatArray = np.array([0.006, 0.006, 0.06])
"""Poses (m, m, rad) within which the quartic is fitted: about what detectors of 10 mm see."""
LEVELS = 5


class ParameterCovariance:
    """The spread of the dots that the calibration of one rig file leaves. Make it with :meth:`from_rig`."""

    def __init__(self, values: FloatArray, covariance: FloatArray, length: float, xp: Arithmetic = FIXED) -> None:
        """``values`` (COUNT,), ``covariance`` (COUNT, COUNT): as the readings' model has them; ``length``: L, m."""
        self._xp = xp
        scale = _scale(covariance)
        size, vectors = xp.eigen(covariance / np.outer(scale, scale))
        kept = size > 1e-14
        root = scale[:, None] * vectors[:, kept] * np.sqrt(size[kept])
        levels = np.linspace(-1.0, 1.0, LEVELS)
        points = np.stack(np.meshgrid(levels, levels, levels), axis=0).reshape(3, -1)
        slopes = xp.product(dots_by_parameters(values, points * RANGE[:, None], length, xp), root)
        basis = np.stack([_terms(*point) for point in points.T.tolist()])
        self._shape = (4, root.shape[1])
        # Smooth as they are, a quartic gives them to 1e-4; a block has no time for differences.
        self._quartic = xp.least_squares(basis, slopes.reshape(len(basis), -1))

    @classmethod
    def from_rig(
        cls, rig: Rig, zero_variances: tuple[float, ...] = (), effects: Sequence[ActiveEffect] | None = None
    ) -> ParameterCovariance | None:
        """None if the rig was not calibrated or its covariances are not to be total.

        ``zero_variances`` (4,) m^2: of a zero that was taken after the calibration. ``effects``: those of the rig, if
        they are known. Raises ConfigError.
        """
        if rig.estimator.covariance != 'total' or not is_calibrated(rig):
            return None
        check_two_psds(rig, 'a calibration (calibration.names)')
        covariance = known_of_rig(rig).covariance
        if zero_variances:
            covariance[ZERO:] = covariance[:, ZERO:] = 0.0
            covariance[ZERO:, ZERO:] = np.diag(zero_variances)
        xp = FIXED
        return cls(vector_of_rig(rig, effects).as_used, covariance, rig.link.length, xp)

    def factor(self, dx: float, dy: float, theta: float) -> FloatArray:
        """B (4, k), m, at a pose (m, m, rad): the corrected dots spread by B B^T."""
        across, twist = float(RANGE[0]), float(RANGE[2])
        terms = np.array(_terms(dx / across, dy / across, theta / twist))
        return self._xp.einsum('t,ti->i', terms, self._quartic).reshape(self._shape)


def _pairs() -> list[tuple[int, int]]:
    """Which products of two make the products of four, each once."""
    second = [(i, j) for i in range(4) for j in range(i, 4)]
    found: dict[tuple[int, ...], tuple[int, int]] = {}
    for a, row in enumerate(second):
        for b, right in enumerate(second):
            found.setdefault(tuple(sorted(row + right)), (a, b))
    return list(found.values())


_PAIRS = _pairs()


def _terms(x: float, y: float, t: float) -> list[float]:
    """The 35 products of up to four factors."""
    first = (1.0, x, y, t)
    second = [a * b for i, a in enumerate(first) for b in first[i:]]
    return [second[a] * second[b] for a, b in _PAIRS]


def dots_by_parameters(p: FloatArray, pose: FloatArray, length: float, xp: Arithmetic = FIXED) -> FloatArray:
    """S^-1 (df/dp), (n, 4, COUNT), at poses (3, n)."""
    slopes = by_parameters(p, pose, length, xp).transpose(2, 0, 1).copy()
    read = readings(p, pose, length, xp)
    for psd in range(2):
        own = slice(2 * psd, 2 * psd + 2)
        response = response_of(p, psd)
        x, y = response.place(read[2 * psd], read[2 * psd + 1], xp)
        rotated = response.slopes(x, y, xp).transpose(2, 0, 1)
        slopes[:, own] = xp.solve(rotated, slopes[:, own])
    return slopes


def _scale(covariance: FloatArray) -> FloatArray:
    """Standard deviations, 1 where there is none, so that units do not decide what counts as zero."""
    sd = np.sqrt(np.diag(covariance))
    sd[sd == 0.0] = 1.0
    return sd
