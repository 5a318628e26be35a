# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The estimators of the error budget, and their first-order response.

Each takes readings and stored zeros, (n, P, 2) m, and gives (n, 3): dX, dY, theta. Its ``response`` is
the Jacobian of that answer by readings and by zeros at a true pose, (3, 2P) each: for the exact
methods S = (J^T J)^-1 J^T with J the Jacobian of the exact model, and -S dq/dl for the zeros, because
each zero defines the place of a beam.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.plate.linear import design_matrix, gain_matrix
from psd_deflection.model.plate.plate import crossings, flat_poses, tie_matrix, tied_pose
from psd_deflection.model.solvers.registry import solver_class
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig


class Estimator(abc.ABC):
    """One way from readings to a pose. ``slope_ratio``: the k that it assumes; 0 for a flat plate."""

    slope_ratio: float

    @abc.abstractmethod
    def estimate(self, readings: FloatArray, zeros: FloatArray) -> FloatArray:
        """(n, 3): dX, dY m, theta rad."""

    @abc.abstractmethod
    def response(self, pose: FloatArray, zeros: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(3, 2P) by readings and (3, 2P) by zeros, at ``pose`` (3,) with ``zeros`` (P, 2)."""


@dataclass(frozen=True, slots=True, eq=False)
class ExactEstimator(Estimator):
    """Least squares on the exact model: the plate flat (``slope_ratio`` 0), or tilting as a cantilever.

    Flat, two or more sensors of equal weight have a closed form: theta from the base lines'
    cross and dot products, d from the centroids (orthogonal Procrustes). Tied, or with ``weights`` (2P,) of the
    readings, Gauss-Newton from there.
    """

    centers: FloatArray
    heights: FloatArray
    link_length: float
    slope_ratio: float
    weights: FloatArray | None = None

    def estimate(self, readings: FloatArray, zeros: FloatArray) -> FloatArray:
        """As declared."""
        points, beams = self.centers + readings, self.centers + zeros
        pose = flat_poses(points, beams)
        if self.slope_ratio == 0.0 and self.weights is None:
            return pose
        tie = tie_matrix(self.slope_ratio, self.link_length)
        # Six steps converge to rounding in the sensors' range: the start lacks only the tilt.
        for _ in range(6):
            full = tied_pose(pose, self.slope_ratio, self.link_length)
            model, slopes = crossings(full, beams, self.heights)
            jacobian = slopes.reshape(len(pose), -1, 5) @ tie
            residual = (points - model).reshape(len(pose), -1, 1)
            transposed = np.swapaxes(jacobian, -1, -2)
            if self.weights is not None:
                transposed = transposed * self.weights
            pose = pose + np.linalg.solve(transposed @ jacobian, transposed @ residual)[..., 0]
        return pose

    def response(self, pose: FloatArray, zeros: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As declared."""
        full = tied_pose(pose, self.slope_ratio, self.link_length)
        _, slopes = crossings(full, self.centers + zeros, self.heights)
        jacobian = slopes.reshape(-1, 5) @ tie_matrix(self.slope_ratio, self.link_length)
        root = np.ones(len(jacobian)) if self.weights is None else np.sqrt(self.weights)
        by_readings: FloatArray = np.asarray(np.linalg.pinv(jacobian * root[:, None]) * root, dtype=np.float64)
        # A zero moves its beam, and beam and translation enter as their difference.
        by_zeros = by_readings @ block_diag(*slopes[..., :2])
        return by_readings, np.asarray(by_zeros, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class LinearEstimator(Estimator):
    """The thesis's direct method (4.24, 4.27) with the corrected A: linear in the displacement of the dots.

    ``gain`` (3, 2P): what ``model.plate.linear.gain_matrix`` gives.
    """

    gain: FloatArray
    slope_ratio: float = 0.0

    def estimate(self, readings: FloatArray, zeros: FloatArray) -> FloatArray:
        """As declared."""
        return np.asarray((readings - zeros).reshape(len(readings), -1) @ self.gain.T)

    def response(self, pose: FloatArray, zeros: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As declared: the same at every pose."""
        return self.gain, -self.gain


METHODS = ('exact', 'beam', 'wls', 'thesis_iteration')
"""``exact``, ``beam``, ``wls``: the solvers of these names; ``thesis_iteration``: section 2.2 with its stop rule."""


def method_of(rig: Rig) -> str:
    """Return the method by which the rig's own solver is budgeted, as that solver's class declares it.

    Raises ConfigError for an unknown solver and for a solver without a budget method.
    """
    name = rig.estimator.solver
    method = solver_class(name).budgeted_as
    if method not in METHODS:
        raise ConfigError(
            f'solver = {name!r}: the budget has no model of its errors; name a method: {", ".join(METHODS)}'
        )
    return method


def estimator_of(rig: Rig, method: str) -> Estimator:
    """Return the estimator of one of ``METHODS``.

    ``thesis_iteration`` gives the exact angle minus the error of its stop rule (``studies.budget.computation``),
    so it responds to errors as ``exact`` does. Raises ConfigError for another name, or if the two centres
    coincide.
    """
    if method not in METHODS:
        raise ConfigError(f'method = {method!r}: must be one of {", ".join(METHODS)}')
    if not np.any(rig.centers[0] != rig.centers[1]):
        raise ConfigError('psd_1.center and psd_2.center coincide: the twist cannot be seen')
    if method == 'wls':
        scaling = np.array(rig.estimator.wls_row_scaling) if rig.estimator.wls_weights == 'thesis' else None
        return LinearEstimator(gain_matrix(design_matrix(rig.centers + rig.zeros), scaling))
    slope_ratio = rig.link.slope_ratio if method == 'beam' else 0.0
    return ExactEstimator(rig.centers, rig.heights, rig.link.length, slope_ratio)
