"""Counts to volts to metres; the sensor types."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psd_deflection.config import Rig
from psd_deflection.records import FloatArray

_DOT_CHANNELS = (0, 1, 3, 4)
"""Where x1, y1, x2, y2 are in ``records.CHANNELS``."""


def counts_to_volts(counts: npt.NDArray[np.int16], volts_per_count: float) -> npt.NDArray[np.float32]:
    """Volts (n, 6) of converter counts (n, 6); ``volts_per_count`` V.

    The product is formed in double precision and rounded once to float32, which is what a
    recording holds: a replay from volts then starts from the very same numbers.
    """
    return np.multiply(counts, volts_per_count, dtype=np.float64).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Volts to the places of the dots. ``sensitivity``: m/V on x and y."""

    sensitivity: float

    @classmethod
    def from_rig(cls, rig: Rig) -> Calibration:
        """What the rig's parameters say."""
        return cls(sensitivity=rig.amplifier.sensitivity)

    def dots(self, volts: npt.NDArray[np.float32]) -> FloatArray:
        """Places (n, 4), m: x1, y1, x2, y2, each from its PSD's centre; ``volts`` (n, 6) float32."""
        return np.multiply(volts[:, _DOT_CHANNELS], self.sensitivity, dtype=np.float64)


def dot_noise_variances(rig: Rig) -> FloatArray:
    """Variance (4,), m^2, of one sample of x1, y1, x2, y2.

    Amplifier noise, and the converter's rounding to steps: step^2/12 (Widrow & Kollar, Quantization
    Noise, 2008; good while the noise spans a step or more, as here).
    """
    step = rig.converter.volts_per_count
    variance = rig.amplifier.sensitivity**2 * (rig.amplifier.noise**2 + step**2 / 12.0)
    return np.full(4, variance)
