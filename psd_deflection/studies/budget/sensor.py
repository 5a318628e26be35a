# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Terms of the sensor, of the amplifier and converter behind it, and of the light before it (Table 3.1, group 1; 3.1 to
3.4, corrected)."""

import math
from dataclasses import replace

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.records import FloatArray
from psd_deflection.studies.budget.chain import MeasuringChain
from psd_deflection.studies.budget.term import ROOT_3, Distribution, Kind, Situation, Term, adds_to

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


def spot_diameter(at: Situation) -> float:
    """1/e^2 diameter on the sensor, m (3.1 corrected)."""
    return beam_diameter(at['laser_diameter'], at['laser_wavelength'], at.rig.link.length)


def averaged(deviation: float, at: Situation) -> float:
    """Deviation of a block's mean from that of one sample, for independent samples."""
    return deviation / math.sqrt(at.rig.estimator.block_size)


# ---- E_LP: size of the spot ----


def _light_profile(at: Situation) -> FloatArray:
    # A constant profile causes no error: the sensor reads the centroid in any case.
    return np.full(4, at['profile_change'] * spot_diameter(at))


LIGHT_PROFILE = Term(
    'light_profile',
    'E_LP',
    Kind.SYSTEMATIC,
    'profile_change x D(L), D by 3.1 corrected',
    ('profile_change', 'laser_diameter', 'laser_wavelength'),
    _light_profile,
    adds_to('reading_shift'),
)


def _clip(chain: MeasuringChain, values: FloatArray, at: Situation) -> MeasuringChain:
    return replace(chain, spot_diameter=values * spot_diameter(at))


SPOT_CLIPPING = Term(
    'spot_clipping',
    'E_LP',
    Kind.KNOWN,
    'centroid of the part of a Gaussian spot of diameter D(L) on the active area',
    ('laser_diameter', 'laser_wavelength'),
    lambda at: np.ones(1),
    _clip,
    calibrated=True,
)


# ---- E_DC: dark current ----


def _dark_current(at: Situation) -> FloatArray:
    return np.full(2, at['dark_current'] / ROOT_3 / (at['responsivity'] * at['laser_power']))


DARK_CURRENT = Term(
    'dark_current',
    'E_DC',
    Kind.SYSTEMATIC,
    'x -> x/(1 + I_d/I_s), I_s = responsivity x laser_power, I_d uniform up to dark_current',
    ('dark_current', 'responsivity', 'laser_power'),
    _dark_current,
    adds_to('background'),
    unit='',
    distribution=Distribution.UNIFORM,
    calibrated=True,
)


# ---- E_R: resistivity ----


def _resistivity(at: Situation) -> FloatArray:
    # r (1 + k r^2) is off by nonlinearity x length at 80 % of the half-length.
    length = at.area.mean(axis=1)
    return np.asarray(at['nonlinearity'] * length / (0.4 * length) ** 3 / ROOT_3)


RESISTIVITY = Term(
    'resistivity',
    'E_R',
    Kind.SYSTEMATIC,
    'x -> x (1 + k r^2), k r^3 = nonlinearity x length at r = 0.4 length; over sqrt 3',
    ('nonlinearity',),
    _resistivity,
    adds_to('nonlinearity'),
    unit='1/m^2',
    distribution=Distribution.UNIFORM,
    calibrated=True,
)


# ---- E_TH: thermal drift ----


def _thermal_drift(at: Situation) -> FloatArray:
    return np.asarray(at['drift_coefficient'] * at['temperature_change'] / ROOT_3 * at.area.ravel())


THERMAL_DRIFT = Term(
    'thermal_drift',
    'E_TH',
    Kind.SYSTEMATIC,
    'drift_coefficient x length x temperature_change / sqrt 3, each axis by itself',
    ('drift_coefficient', 'temperature_change'),
    _thermal_drift,
    adds_to('reading_shift'),
    distribution=Distribution.UNIFORM,
)


# ---- Amplifier and converter ----


def _amplifier_noise(at: Situation) -> FloatArray:
    each = at.rig.noises[:, :2] * at.rig.sensitivities
    return np.array([averaged(float(noise), at) for noise in each.ravel()])


AMPLIFIER_NOISE = Term(
    'amplifier_noise',
    '',
    Kind.PER_ESTIMATE,
    'noise x sensitivity of the channel / sqrt(block_size)',
    (),
    _amplifier_noise,
    adds_to('reading_shift'),
    observed=True,
)


def _quantisation(at: Situation) -> FloatArray:
    step = at.rig.converter.volts_per_count
    out = []
    channels = zip(at.rig.noises[:, :2].ravel().tolist(), at.rig.sensitivities.ravel().tolist(), strict=True)
    for noise, sensitivity in channels:
        deviation = step * sensitivity / math.sqrt(12.0)
        # Noise of half a step or more makes the rounding errors of successive samples independent.
        out.append(averaged(deviation, at) if noise >= step / 2.0 else deviation)
    return np.array(out)


QUANTISATION = Term(
    'quantisation',
    '',
    Kind.PER_ESTIMATE,
    'step x sensitivity / sqrt 12, over sqrt(block_size) where the noise is half a step or more',
    (),
    _quantisation,
    adds_to('reading_shift'),
)


def _zeroing(at: Situation) -> FloatArray:
    return np.hypot(_amplifier_noise(at), _quantisation(at)) / math.sqrt(at['zero_blocks'])


ZEROING = Term(
    'zeroing',
    '',
    Kind.SYSTEMATIC,
    'noise and quantisation of a block / sqrt(zero_blocks), in the stored zero',
    ('zero_blocks',),
    _zeroing,
    adds_to('zero_shift'),
    observed=True,
)


SENSOR_GAIN = Term(
    'sensor_gain',
    '',
    Kind.SYSTEMATIC,
    'x -> x (1 + g), g = gain_tolerance / sqrt 3, each channel by itself',
    ('gain_tolerance',),
    lambda at: np.full(4, at['gain_tolerance'] / ROOT_3),
    adds_to('gain'),
    unit='',
    distribution=Distribution.UNIFORM,
    calibrated=True,
)

OF_THE_SPOT = (LIGHT_PROFILE, SPOT_CLIPPING, DARK_CURRENT, RESISTIVITY, THERMAL_DRIFT)
TERMS = (*OF_THE_SPOT, SENSOR_GAIN, AMPLIFIER_NOISE, QUANTISATION, ZEROING)
