"""What the uncertainty of a calibration adds to the covariance of an estimate.

The readings are r = f(pose; p). The pipeline takes the effects of p off the dots, so an error of p moves the corrected
dots by -S^-1 (df/dp) dp, S = d(reading)/d(place on the detector). With the covariance P of p and a solver's
gain K (:meth:`psd_deflection.solvers.interface.Solver.gain`) the estimate's covariance grows by

    K B B^T K^T,    B = S^-1 (df/dp) P^(1/2).

P holds the unloaded reading too. A zero that is taken by the running daemon replaces its part: its own noise,
independent of the rest.
"""

from __future__ import annotations

import numpy as np

from psd_deflection.config import Rig
from psd_deflection.misalignment.model import ZERO, by_parameters, by_place, place_of_reading, readings
from psd_deflection.misalignment.rig import is_calibrated, known_of_rig, vector_of_rig
from psd_deflection.records import FloatArray


class ParameterSpread:
    """The spread of the dots that the calibration of one rig file leaves. Make it with :meth:`from_rig`."""

    def __init__(self, values: FloatArray, covariance: FloatArray, length: float) -> None:
        """``values`` (COUNT,), ``covariance`` (COUNT, COUNT): as the readings' model has them; ``length``: L, m."""
        self._values, self._length = values, length
        size, vectors = np.linalg.eigh(covariance / np.outer(scale := _scale(covariance), scale))
        kept = size > 1e-14
        self._root = scale[:, None] * vectors[:, kept] * np.sqrt(size[kept])

    @classmethod
    def from_rig(cls, rig: Rig, zero_variances: tuple[float, ...] = ()) -> ParameterSpread | None:
        """None if the rig was not calibrated or its covariances are not to be total.

        ``zero_variances`` (4,) m^2: of a zero that was taken after the calibration. Raises ConfigError.
        """
        if rig.estimator.covariance != 'total' or not is_calibrated(rig):
            return None
        covariance = known_of_rig(rig).covariance
        if zero_variances:
            covariance[ZERO:] = covariance[:, ZERO:] = 0.0
            covariance[ZERO:, ZERO:] = np.diag(zero_variances)
        return cls(vector_of_rig(rig).as_used, covariance, rig.link.length)

    def factor(self, dx: float, dy: float, theta: float) -> FloatArray:
        """B (4, k), m, at a pose (m, m, rad): the corrected dots spread by B B^T."""
        pose = np.array([[dx], [dy], [theta]])
        slopes = by_parameters(self._values, pose, self._length)[:, :, 0]
        read = readings(self._values, pose, self._length)[:, 0]
        for psd in range(2):
            at = place_of_reading(self._values, psd, read[2 * psd], read[2 * psd + 1])
            slopes[2 * psd : 2 * psd + 2] = np.linalg.solve(by_place(self._values, psd, *at), slopes[2 * psd : 2 * psd + 2])
        return np.einsum('ij,jk->ik', slopes, self._root)


def _scale(covariance: FloatArray) -> FloatArray:
    """Standard deviations, 1 where there is none, so that units do not decide what counts as zero."""
    sd = np.sqrt(np.diag(covariance))
    sd[sd == 0.0] = 1.0
    return sd
