# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""From photocurrents to the place of the spot and back, with one class for each kind of sensor.

Numbers such as 2.3 are equations of the thesis. A lateral sensor is one resistive sheet that divides
the photocurrent between its electrodes. So difference over sum is linear in the place (2.3, 2.4 times
half the active length). A segmented sensor is four separate diodes. Its reading depends on the profile
of the spot and saturates when the spot no longer covers the cross in the middle. 2.1 and 2.2 give a
pure number. For a laser's Gaussian spot of radius w (to 1/e^2) that number is erf(sqrt(2) x/w), which
is inverted here.

These sensors are ideal. The errors of real sensors (``sensor_nonlinearity``, ``axis_crosstalk``,
``ambient_light`` ...) are effects of the simulation.
"""

import abc
from math import erf, pi, sqrt
from typing import ClassVar

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.records import FloatArray
from psd_deflection.rig.declarations import PsdConfig


class Sensor(abc.ABC):
    """One position sensing detector. ``electrodes`` names the four currents, in their order."""

    name: ClassVar[str]
    electrodes: ClassVar[tuple[str, str, str, str]]

    def __init__(self, active_area: tuple[float, float], spot_radius: float) -> None:
        """``active_area``: width and height, m. ``spot_radius``: to 1/e^2 of the peak, m."""
        self.half = np.array(active_area, dtype=np.float64) / 2.0
        self.spot_radius = spot_radius

    @abc.abstractmethod
    def ratios(self, currents: FloatArray) -> FloatArray:
        """Differences over sums (n, 2), -1 to 1, of currents (n, 4); NaN without light."""

    @abc.abstractmethod
    def currents(self, place: FloatArray, total: FloatArray | float) -> FloatArray:
        """Currents (n, 4) of a spot at ``place`` (n, 2) m whose photocurrent is ``total`` (n,) A."""

    def sum_signal(self, currents: FloatArray) -> FloatArray:
        """The photocurrent (n,), A, as the sum channel shows it."""
        total: FloatArray = np.asarray(currents, dtype=np.float64).sum(axis=1)
        return total

    def place(self, currents: FloatArray) -> FloatArray:
        """Where the spot is (n, 2), m from the centre; NaN without light."""
        return self.from_ratios(self.ratios(currents))

    def from_ratios(self, ratios: FloatArray) -> FloatArray:
        """Places (n, 2), m, of ratios (n, 2): half the active length times them (2.3, 2.4)."""
        return np.asarray(ratios * self.half)

    def to_ratios(self, place: FloatArray) -> FloatArray:
        """The inverse of :meth:`from_ratios`."""
        return np.asarray(place / self.half)

    def to_linear(self, ratios: FloatArray) -> FloatArray:
        """Ratios (n, 2) as an amplifier gives them, times its sensitivity at the centre, m."""
        return self.from_ratios(ratios)

    def from_linear(self, place: FloatArray) -> FloatArray:
        """Places (n, 2), m, of ``place``: volts times the sensitivity at the centre, m.

        Unchanged for a lateral sensor; for a segmented one it inverts the nonlinear curve.
        """
        return place

    def reach(self) -> FloatArray:
        """Largest distance from the centre at which a reading is valid, (2,), m."""
        return self.half


class _EdgeElectrodes(Sensor):
    """Two pairs of electrodes along the edges; ``share``: the part of the photocurrent through one half of a pair."""

    electrodes: ClassVar[tuple[str, str, str, str]] = ('x1', 'x2', 'y1', 'y2')
    share: ClassVar[float]

    def ratios(self, currents: FloatArray) -> FloatArray:
        """See :class:`Sensor`."""
        x1, x2, y1, y2 = np.asarray(currents, dtype=np.float64).T
        return _over(np.column_stack((x1 - x2, y1 - y2)), np.column_stack((x1 + x2, y1 + y2)))

    def currents(self, place: FloatArray, total: FloatArray | float) -> FloatArray:
        """See :class:`Sensor`."""
        x, y = self.to_ratios(place).T
        part = self.share * np.broadcast_to(total, x.shape)
        return np.column_stack((part * (1.0 + x), part * (1.0 - x), part * (1.0 + y), part * (1.0 - y)))


class Duolateral(_EdgeElectrodes):
    """Two resistive sheets: x between two electrodes in front, y between two behind.

    x = (Lx/2)(I_x1 - I_x2)/(I_x1 + I_x2), electrode 1 on the positive side (2.3, 2.4; Hamamatsu's and
    On-Trak's sheets number them the other way round). Each pair carries the whole photocurrent.
    """

    name: ClassVar[str] = 'duolateral'
    share: ClassVar[float] = 0.5

    def sum_signal(self, currents: FloatArray) -> FloatArray:
        """The photocurrent (n,), A: it passes both pairs but is counted once."""
        return super().sum_signal(currents) / 2.0


class Tetralateral(_EdgeElectrodes):
    """One sheet with an electrode along each edge: both axes share the photocurrent (2.3, 2.4)."""

    name: ClassVar[str] = 'tetralateral'
    share: ClassVar[float] = 0.25


class Pincushion(Sensor):
    """One sheet with an electrode in each corner and curved edges that make the ratios linear.

    x = (Lx/2)[(X2 + Y1) - (X1 + Y2)]/sum, y = (Ly/2)[(X2 + Y2) - (X1 + Y1)]/sum (Hamamatsu, improved
    tetralateral PSDs).
    """

    name: ClassVar[str] = 'pincushion'
    electrodes: ClassVar[tuple[str, str, str, str]] = ('X1', 'X2', 'Y1', 'Y2')

    def ratios(self, currents: FloatArray) -> FloatArray:
        """See :class:`Sensor`."""
        x1, x2, y1, y2 = np.asarray(currents, dtype=np.float64).T
        total = (x1 + x2 + y1 + y2)[:, None]
        return _over(np.column_stack((x2 + y1 - x1 - y2, x2 + y2 - x1 - y1)), total)

    def currents(self, place: FloatArray, total: FloatArray | float) -> FloatArray:
        """See :class:`Sensor`."""
        x, y = self.to_ratios(place).T
        part = np.broadcast_to(total, x.shape) / 4.0
        x_plus, x_minus, y_plus, y_minus = 1.0 + x, 1.0 - x, 1.0 + y, 1.0 - y
        return np.column_stack(
            (part * x_minus * y_minus, part * x_plus * y_plus, part * x_plus * y_minus, part * x_minus * y_plus)
        )


class Quadrant(Sensor):
    """Four diodes, I1 to I4 counter-clockwise from the upper right, without a gap (2.1, 2.2).

    A Gaussian spot of radius w at x gives X = erf(sqrt(2) x/w), whatever y. It is useful to 1.5 w: there
    99.7 % of the light is on one side, and the slope of the reading is a hundredth of the slope in the
    middle.
    """

    name: ClassVar[str] = 'quadrant'
    electrodes: ClassVar[tuple[str, str, str, str]] = ('I1', 'I2', 'I3', 'I4')

    _REACH = 1.5

    def __init__(self, active_area: tuple[float, float], spot_radius: float) -> None:
        """See :class:`Sensor`."""
        super().__init__(active_area, spot_radius)
        # Imported here: it takes a fifth of a second, and few rigs have this sensor.
        from scipy.special import erf as erf_many
        from scipy.special import erfinv

        self._erf, self._erfinv = erf_many, erfinv

    def ratios(self, currents: FloatArray) -> FloatArray:
        """See :class:`Sensor`."""
        i1, i2, i3, i4 = np.asarray(currents, dtype=np.float64).T
        total = (i1 + i2 + i3 + i4)[:, None]
        return _over(np.column_stack((i1 + i4 - i2 - i3, i1 + i2 - i3 - i4)), total)

    def currents(self, place: FloatArray, total: FloatArray | float) -> FloatArray:
        """See :class:`Sensor`."""
        x, y = self.to_ratios(place).T
        part = np.broadcast_to(total, x.shape) / 4.0
        x_plus, x_minus, y_plus, y_minus = 1.0 + x, 1.0 - x, 1.0 + y, 1.0 - y
        return np.column_stack(
            (part * x_plus * y_plus, part * x_minus * y_plus, part * x_minus * y_minus, part * x_plus * y_minus)
        )

    def from_ratios(self, ratios: FloatArray) -> FloatArray:
        """Places (n, 2), m, of ratios (n, 2): w/sqrt(2) erfinv, limited to 1.5 w."""
        limit = erf(sqrt(2.0) * self._REACH)
        return np.asarray(self.spot_radius / sqrt(2.0) * self._erfinv(np.clip(ratios, -limit, limit)))

    def to_ratios(self, place: FloatArray) -> FloatArray:
        """erf(sqrt(2) x/w), (n, 2)."""
        return np.asarray(self._erf(sqrt(2.0) / self.spot_radius * np.asarray(place)))

    def to_linear(self, ratios: FloatArray) -> FloatArray:
        """The inverse of the line at the centre in :meth:`from_linear`."""
        return np.asarray(ratios * (self.spot_radius / sqrt(8.0 / pi)))

    def from_linear(self, place: FloatArray) -> FloatArray:
        """At the centre dX/dx = sqrt(8/pi)/w: a ratio is ``place`` times that."""
        return self.from_ratios(np.asarray(place) * (sqrt(8.0 / pi) / self.spot_radius))

    def reach(self) -> FloatArray:
        """1.5 w, or the edge of the diodes if that is nearer."""
        return np.minimum(self.half, self._REACH * self.spot_radius)


SENSORS: dict[str, type[Sensor]] = {cls.name: cls for cls in (Duolateral, Tetralateral, Pincushion, Quadrant)}


def make_sensor(psd: PsdConfig) -> Sensor:
    """The sensor that ``psd_N.type`` names. Raises ConfigError for another name."""
    cls = SENSORS.get(psd.type)
    if cls is None:
        raise ConfigError(f'psd type = {psd.type!r}: must be one of {", ".join(SENSORS)}')
    return cls(psd.active_area, psd.spot_radius)


def _over(difference: FloatArray, total: FloatArray) -> FloatArray:
    """The ratio; NaN without light."""
    out = np.full(difference.shape, np.nan)
    np.divide(difference, total, out=out, where=np.broadcast_to(total > 0.0, difference.shape))
    return out
