# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""From a true pose to readings (the measuring chain) and from readings to a pose (the estimators), to first order."""

from __future__ import annotations

import abc
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.detector.clipping import cut_by_edges
from psd_deflection.model.detector.response import grown, pulled, scaled
from psd_deflection.model.plate.linear import design_matrix, gain_matrix
from psd_deflection.model.plate.plate import crossings, flat_poses, tie_matrix, tied_pose
from psd_deflection.model.plate.rays import hit, lifted, rotation
from psd_deflection.model.solvers.registry import solver_class
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig


def _none(*shape: int) -> FloatArray:
    return np.zeros(shape)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuringChain:
    """A rig as its parameter file describes it (first group of fields), and its errors.

    ``centers`` (P, 2), ``heights`` (P,), ``zeros`` (P, 2), ``half_area`` (P, 2), ``link_length``: m.
    ``slope_ratio`` (n,): the true k of the link. The errors follow, all 0 for the nominal rig:
    """

    centers: FloatArray
    heights: FloatArray
    zeros: FloatArray
    half_area: FloatArray
    link_length: float
    slope_ratio: FloatArray

    center_error: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """m, true centre minus stated."""
    height_error: FloatArray = field(default_factory=lambda: _none(1, 1))
    """m."""
    rotation: FloatArray = field(default_factory=lambda: _none(1, 1))
    """rad, the sensor's axes about +Z of the plate."""
    tilt: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """rad, the sensor's surface about X and Y of the plate."""
    beam_slope: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """dx/dz, dy/dz of the beam."""
    center_shift: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """m, movement of the centre since the zero was stored."""
    beam_shift: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """m, movement of the dot with the beam since the zero was stored."""
    spot_diameter: FloatArray = field(default_factory=lambda: _none(1, 1))
    """m, 1/e^2 diameter; 0 is a point, which is never clipped."""
    nonlinearity: FloatArray = field(default_factory=lambda: _none(1, 1))
    """1/m^2: r becomes r (1 + k r^2)."""
    background: FloatArray = field(default_factory=lambda: _none(1, 1))
    """Background current, centred, divided by the spot's current."""
    gain: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """Scale error."""
    reading_shift: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """m, added to the loaded reading: drift and noise."""
    zero_shift: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """m, added to the stored zero."""

    @classmethod
    def of(cls, rig: Rig) -> MeasuringChain:
        """Return the nominal rig."""
        half_area = np.array([p.active_area for p in rig.psds]) / 2.0
        slope_ratio = np.array([rig.link.slope_ratio])
        return cls(rig.centers, rig.heights, rig.zeros, half_area, rig.link.length, slope_ratio)


def dots(chain: MeasuringChain, pose: FloatArray, dz: float = 0.0) -> FloatArray:
    """(n, P, 2), m: the dots in each sensor's own axes at ``pose`` (3,): dX, dY, theta.

    ``dz``: the tip's shortening, m; it affects inclined beams only.
    """
    tilted = tied_pose(pose, chain.slope_ratio, chain.link_length)
    plate = rotation(tilted[..., 2], tilted[..., 3], tilted[..., 4])[:, None]
    sensor_rotation = rotation(chain.rotation, chain.tilt[..., 0], chain.tilt[..., 1])
    centre = lifted(chain.centers + chain.center_error, chain.heights + chain.height_error)
    start = centre + np.einsum('...ij,...j->...i', sensor_rotation[..., :2], chain.zeros)
    start = start + lifted(chain.beam_shift, 0.0)
    moved = centre + lifted(chain.center_shift, 0.0)
    origin = np.einsum('...ij,...j->...i', plate, moved) + np.array([pose[0], pose[1], dz])
    return hit(start, lifted(chain.beam_slope, 1.0), origin, plate @ sensor_rotation)


def _read(chain: MeasuringChain, places: FloatArray) -> FloatArray:
    if np.any(chain.spot_diameter > 0.0):
        _, moved = cut_by_edges(places, chain.half_area, np.maximum(chain.spot_diameter[..., None] / 2.0, 1e-12))
        places = places + moved
    # Other light is centred.
    places = pulled(places, 1.0, chain.background[..., None], 0.0)
    x, y = grown(places[..., 0], places[..., 1], chain.nonlinearity)
    return np.stack(scaled(x, y, chain.gain[..., 0], chain.gain[..., 1]), axis=-1)


def measure(chain: MeasuringChain, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Readings and stored zeros, (n, P, 2) each, m, at ``pose`` (3,)."""
    readings = _read(chain, dots(chain, pose)) + chain.reading_shift
    zeros = _read(chain, chain.zeros[None]) + chain.zero_shift
    shape = np.broadcast_shapes(readings.shape, zeros.shape)
    return np.broadcast_to(readings, shape), np.broadcast_to(zeros, shape)


class Estimator(abc.ABC):
    """One way from readings to a pose. ``slope_ratio``: the k that it assumes; 0 for a flat plate.

    Each takes readings and stored zeros, (n, P, 2) m, and gives (n, 3): dX, dY, theta. Its ``response`` is
    the Jacobian of that answer by readings and by zeros at a true pose, (3, 2P) each: for the exact
    methods S = (J^T J)^-1 J^T with J the Jacobian of the exact model, and -S dq/dl for the zeros, because
    each zero defines the place of a beam.
    """

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

    ``thesis_iteration`` gives the exact angle minus the error of its stop rule (``studies.budget.evaluate``),
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
