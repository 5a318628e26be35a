# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converter counts to volts, volts to the places of the dots."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.model.detector.sensors import Quadrant, Sensor, make_sensor
from psd_deflection.records import Counts, FloatArray, IntArray, dot_channels
from psd_deflection.rig.config import Rig
from psd_deflection.rig.wiring import Wiring

LEAST_LASER = 0.1
"""Least light of a laser, as a share of the other light: with the laser off noise must not be divided by noise."""


def counts_to_volts(counts: Counts, volts_per_count: float) -> npt.NDArray[np.float32]:
    """Volts (n, 3P) of converter counts (n, 3P) of P PSDs; ``volts_per_count`` V.

    The product is computed in double precision and rounded once to float32, as in a recording. So a
    replay from volts starts from exactly the same numbers.
    """
    return np.multiply(counts, volts_per_count, dtype=np.float64).astype(np.float32)


@dataclass(frozen=True, slots=True)
class VoltsToDots:
    """Readings to the places of the dots.

    ``sensitivities``: m/V on x1, y1, x2, y2 ..., at the centre. ``sensors``: one for each PSD. ``wiring``: which
    channel of the device is which axis of which PSD. ``dark``: of each PSD that sees other light its number (from 0)
    and x, y, sum with its laser off, V.
    """

    sensitivities: tuple[float, ...]
    sensors: tuple[Sensor, ...]
    wiring: Wiring = field(default_factory=Wiring)
    dark: tuple[tuple[int, tuple[float, float, float]], ...] = ()
    _columns: IntArray = field(init=False, repr=False, compare=False)
    _per_volt: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Make the arrays of every block once."""
        object.__setattr__(self, '_columns', np.array(dot_channels(len(self.sensors)), dtype=np.intp))
        object.__setattr__(self, '_per_volt', np.array(self.sensitivities, dtype=np.float64))

    @classmethod
    def from_rig(cls, rig: Rig) -> VoltsToDots:
        """The calibration of the rig's parameters."""
        return cls(
            sensitivities=tuple(rig.sensitivities.ravel().tolist()),
            sensors=tuple(make_sensor(psd) for psd in rig.psds),
            wiring=Wiring.from_rig(rig),
            dark=tuple((i, psd.dark) for i, psd in enumerate(rig.psds) if psd.dark[2] > 0.0),
        )

    def observed(self, volts: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Volts (n, 3P) of the PSDs, x y sum of each, from those of the device's channels."""
        return self.wiring.to_psds(volts)

    def dots(self, volts: npt.NDArray[np.float32]) -> FloatArray:
        """Places (n, 2P), m: x1, y1, x2, y2 ..., each from its PSD's centre; ``volts`` (n, 3P) float32 as
        :meth:`observed`.

        The amplifier divides by the sum, so a voltage is the place over the sensitivity. Photocurrents add: with other
        light of sum b a reading is v = ((W - b) v_laser + b v_dark)/W, W the sum, and v_laser is what counts. The
        nonlinear curve of a segmented sensor is inverted.
        """
        # Reading by reading in memory: an order in which sums by the library are not other than they were.
        dots = np.multiply(volts.T.take(self._columns, axis=0).T, self._per_volt, dtype=np.float64)
        for i, (x, y, level) in self.dark:
            full = volts[:, 3 * i + 2].astype(np.float64)
            laser = np.maximum(full - level, LEAST_LASER * level)
            for column, dark in ((2 * i, x), (2 * i + 1, y)):
                pull = level * dark * self.sensitivities[column]
                dots[:, column] = (full * dots[:, column] - pull) / laser
        for i, sensor in enumerate(self.sensors):
            if isinstance(sensor, Quadrant):
                dots[:, 2 * i : 2 * i + 2] = sensor.from_linear(dots[:, 2 * i : 2 * i + 2])
        return dots

    def volts_of_electrodes(self, electrodes: FloatArray) -> FloatArray:
        """Volts (n, 3P) on the device's channels, as an amplifier that divides would give them.

        ``electrodes`` (n, 4P): of PSD 1 in the order of its ``electrodes``, then of PSD 2 ..., each a current or what a
        transimpedance amplifier makes of it, V. The sums are in their unit. A PSD without light reads 0, its sum too.
        """
        channels = np.empty((len(electrodes), 3 * len(self.sensors)))
        for psd, sensor in enumerate(self.sensors, start=1):
            first = self.wiring.input_of(psd) - 1
            four = electrodes[:, 4 * first : 4 * first + 4]
            channels[:, 3 * first : 3 * first + 2] = sensor.ratios(four)
            channels[:, 3 * first + 2] = sensor.sum_signal(four)
        volts = self.wiring.to_psds(channels)
        for psd, sensor in enumerate(self.sensors):
            both = volts[:, 3 * psd : 3 * psd + 2]
            both[:] = sensor.to_linear(both) / self.sensitivities[2 * psd : 2 * psd + 2]
            # No place may be made up where the currents of one axis are missing.
            volts[~np.isfinite(both).all(axis=1), 3 * psd : 3 * psd + 3] = 0.0
        return self.wiring.to_device(volts)


def dot_noise_variances(rig: Rig) -> FloatArray:
    """Variance (2P,), m^2, of one sample of x1, y1, x2, y2 ...

    Amplifier noise, and the converter's rounding to steps: step^2/12 (Widrow & Kollar, Quantization
    Noise, 2008; good while the noise spans a step or more, as here). For a segmented sensor it holds
    at the centre.
    """
    step = rig.converter.volts_per_count
    channels = zip(rig.sensitivities.ravel().tolist(), rig.noises[:, :2].ravel().tolist(), strict=True)
    xp = FIXED
    rounding = xp.square(step) / 12.0
    return np.array([xp.square(sensitivity) * (xp.square(noise) + rounding) for sensitivity, noise in channels])
