# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The light between laser and detector: thesis equations 3.1 to 3.4, corrected.

Each function states the error of the printed equation and its consequence. All values are plain floats, SI.
"""

from __future__ import annotations

import math

from psd_deflection.base.errors import ConfigError

STANDARD_PRESSURE = 101_325.0
"""Pa."""


def beam_diameter(initial_diameter: float, wavelength: float, distance: float) -> float:
    """1/e^2 diameter of a Gaussian beam, m, ``distance`` (m) from its waist of ``initial_diameter`` (m).

    D(l) = D0 sqrt(1 + (4 lambda l/(pi D0^2))^2). The thesis's 3.1 uses diameters in the formula for
    radii: 1 mm at 650 nm grows to 1.111 mm in 0.585 m, not to 1.007 mm.
    """
    return initial_diameter * math.hypot(1.0, 4.0 * wavelength * distance / (math.pi * initial_diameter**2))


def refracted_angle(angle: float, index_1: float, index_2: float) -> float:
    """Snell's law (3.2): the angle to the normal in medium 2, rad, of a beam at ``angle`` in medium 1.

    Raises ConfigError if the beam is reflected totally.
    """
    sine = math.sin(angle) * index_1 / index_2
    if abs(sine) > 1.0:
        raise ConfigError(
            f'refraction: a beam at {angle:g} rad is reflected totally between the indices {index_1:g} and {index_2:g}'
        )
    return math.asin(sine)


def boundary_shift(angle: float, index_1: float, index_2: float, distance: float) -> float:
    """Shift of the dot, m, ``distance`` (m) behind a boundary met at ``angle`` (rad to its normal) (3.4)."""
    return (math.tan(refracted_angle(angle, index_1, index_2)) - math.tan(angle)) * distance


def gradient_shift(index_gradient: float, distance: float) -> float:
    """Shift of the dot, m, after ``distance`` (m) across a transverse gradient dn/dy (1/m): (dn/dy) l^2/2.

    Beams along the link meet a gradient; 3.4 gives zero at normal incidence.
    """
    return index_gradient * distance**2 / 2.0


def saturation_pressure(temperature: float) -> float:
    """Saturation vapour pressure of water, Pa, at ``temperature`` K (Magnus formula with the WMO's constants)."""
    celsius = temperature - 273.15
    return 611.2 * math.exp(17.62 * celsius / (243.12 + celsius))


def air_index(
    pressure: float, temperature: float, humidity: float = 50.0, co2: float = 450.0, wavelength: float = 633e-9
) -> float:
    """Refractive index of air: Edlen's equation as updated by Birch and Downs (Metrologia 30, 1993, and 31, 1994).

    ``pressure`` Pa, ``temperature`` K, ``humidity`` %, ``co2`` ppm, ``wavelength`` (vacuum) m. The
    dispersion is that of air with 450 ppm CO2; other contents scale it by Edlen's 0.54e-6 a ppm.
    """
    celsius = temperature - 273.15
    wavenumber_square = (1e-6 / wavelength) ** 2
    dispersion = 8342.54 + 2_406_147.0 / (130.0 - wavenumber_square) + 15_998.0 / (38.9 - wavenumber_square)
    compressibility = 1.0 + 1e-8 * (0.601 - 0.00972 * celsius) * pressure
    density = pressure * compressibility / (96_095.43 * (1.0 + 0.003661 * celsius))
    carbon = (1.0 + 0.54e-6 * (co2 - 300.0)) / (1.0 + 0.54e-6 * 150.0)
    vapour = humidity / 100.0 * saturation_pressure(temperature)
    water = 1e-10 * 292.75 / temperature * (3.7345 - 0.0401 * wavenumber_square) * vapour
    return 1.0 + 1e-8 * dispersion * density * carbon - water


def index_per_kelvin(temperature: float, wavelength: float = 633e-9) -> float:
    """dn/dT, 1/K, at standard pressure: -9.3e-7 at 293.15 K.

    For dry air: warming does not change the vapour content, and its effect is negligible.
    """
    step = 0.5
    warmer = air_index(STANDARD_PRESSURE, temperature + step, 0.0, wavelength=wavelength)
    colder = air_index(STANDARD_PRESSURE, temperature - step, 0.0, wavelength=wavelength)
    return (warmer - colder) / (2.0 * step)
