"""Converter counts to volts, volts to the places of the dots, and which of them not to believe."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
import numpy.typing as npt

from psd_deflection.calibration.sensors import Quadrant, Sensor, make_sensor
from psd_deflection.config import Rig
from psd_deflection.records import DOT_CHANNELS, FloatArray


class SensorFlag(IntFlag):
    """Why a reading of one PSD is not to be believed."""

    LASER_LOST = 1
    """The sum signal is below ``sum_min``."""
    SATURATED = 2
    """A channel stands at an end of the converter's range."""
    OUTSIDE = 4
    """The spot's centre is off the active area, or past where a segmented sensor still tells places."""
    CLIPPED = 8
    """Part of the spot is off the active area: the reading is pulled inward."""


def counts_to_volts(counts: npt.NDArray[np.int16], volts_per_count: float) -> npt.NDArray[np.float32]:
    """Volts (n, 6) of converter counts (n, 6); ``volts_per_count`` V.

    The product is formed in double precision and rounded once to float32, which is what a
    recording holds: a replay from volts then starts from the very same numbers.
    """
    return np.multiply(counts, volts_per_count, dtype=np.float64).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Readings to the places of the dots.

    ``sensitivity``: m/V on x and y, at the centre. ``sensors``: both. ``sum_min`` V: less means that
    the laser is lost. ``full_scale``, ``step``: the converter's, V.
    """

    sensitivity: float
    sensors: tuple[Sensor, Sensor]
    sum_min: float
    full_scale: float
    step: float

    @classmethod
    def from_rig(cls, rig: Rig) -> Calibration:
        """What the rig's parameters say."""
        return cls(
            sensitivity=rig.amplifier.sensitivity,
            sensors=(make_sensor(rig.psds[0]), make_sensor(rig.psds[1])),
            sum_min=rig.estimator.sum_min,
            full_scale=rig.converter.full_scale,
            step=rig.converter.volts_per_count,
        )

    def dots(self, volts: npt.NDArray[np.float32]) -> FloatArray:
        """Places (n, 4), m: x1, y1, x2, y2, each from its PSD's centre; ``volts`` (n, 6) float32.

        Volts are those of an amplifier that divides by the sum: place over ``sensitivity``. A
        segmented sensor's bend is undone.
        """
        dots = np.multiply(volts[:, DOT_CHANNELS], self.sensitivity, dtype=np.float64)
        for i, sensor in enumerate(self.sensors):
            if isinstance(sensor, Quadrant):
                dots[:, 2 * i : 2 * i + 2] = sensor.from_linear(dots[:, 2 * i : 2 * i + 2])
        return dots

    def dots_of_currents(self, currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (n, 4) m and photocurrents (n, 2) A of electrode currents (n, 8) A.

        For converters behind transimpedance amplifiers without a divider: four currents of PSD 1 in
        the order of its ``electrodes``, then those of PSD 2. NaN without light.
        """
        halves = (currents[:, :4], currents[:, 4:])
        places = [sensor.place(half) for sensor, half in zip(self.sensors, halves, strict=True)]
        sums = [sensor.sum_signal(half) for sensor, half in zip(self.sensors, halves, strict=True)]
        return np.hstack(places), np.column_stack(sums)

    def flags(self, volts: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
        """:class:`SensorFlag` of each sample and PSD, (n, 2); ``volts`` (n, 6) float32."""
        dots = np.abs(np.multiply(volts[:, DOT_CHANNELS], self.sensitivity, dtype=np.float64))
        # A converter at its end gives its last step, a little less than the full scale on one side.
        at_end = np.abs(volts) >= self.full_scale - 1.5 * self.step
        out = np.zeros((len(volts), 2), dtype=np.uint8)
        for i, sensor in enumerate(self.sensors):
            place = sensor.from_linear(dots[:, 2 * i : 2 * i + 2])
            for flag, hit in (
                (SensorFlag.LASER_LOST, ~(volts[:, 3 * i + 2] >= self.sum_min)),
                (SensorFlag.SATURATED, at_end[:, 3 * i : 3 * i + 3].any(axis=1)),
                (SensorFlag.OUTSIDE, ~(place <= sensor.reach() * (1.0 - 1e-12)).all(axis=1)),
                (SensorFlag.CLIPPED, ~(place + sensor.spot_radius <= sensor.half).all(axis=1)),
            ):
                out[hit, i] |= np.uint8(flag)
        return out


def dot_noise_variances(rig: Rig) -> FloatArray:
    """Variance (4,), m^2, of one sample of x1, y1, x2, y2.

    Amplifier noise, and the converter's rounding to steps: step^2/12 (Widrow & Kollar, Quantization
    Noise, 2008; good while the noise spans a step or more, as here). For a segmented sensor it holds
    at the centre.
    """
    step = rig.converter.volts_per_count
    variance = rig.amplifier.sensitivity**2 * (rig.amplifier.noise**2 + step**2 / 12.0)
    return np.full(4, variance)
