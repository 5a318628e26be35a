# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Terms of the environment and the beams, and of the installation: where the sensors sit, how they are turned, and how
the tip tilts (Table 3.1, 3.2)."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.studies.budget.chain import MeasuringChain
from psd_deflection.studies.budget.sensor import (
    STANDARD_PRESSURE,
    air_index,
    boundary_shift,
    gradient_shift,
    index_per_kelvin,
)
from psd_deflection.studies.budget.term import ROOT_3, Distribution, Kind, Situation, Term, adds_to


def _tolerance(name: str, count: int) -> Callable[[Situation], FloatArray]:
    """``count`` error parameters, uniform within the input ``name`` to either side."""
    return lambda at: np.full(count, at[name] / ROOT_3)


def _tolerated(name: str, row: str, tolerance: str, count: int, field: str, words: str, unit: str = 'm') -> Term:
    """A cause that a calibration takes away: ``count`` error parameters within the input ``tolerance``, which add to
    the ``field`` of the chain."""
    formula, sizes = f'{tolerance} / sqrt 3{words}', _tolerance(tolerance, count)
    term = Term(name, row, Kind.SYSTEMATIC, formula, (tolerance,), sizes, adds_to(field), unit, Distribution.UNIFORM)
    return replace(term, calibrated=True)


_PARALLEL = 'the beam out of parallel, times the way of the plate along it'
_BOTH = 'the same error in l and in q (3.19 corrected)'

# ---- E_Algn: alignment ----

SENSOR_ROTATION = _tolerated(
    'sensor_rotation', 'E_Algn', 'rotation_tolerance', 2, 'rotation', ": the sensor's axes turned in the plate", 'rad'
)

BEAM_MISALIGNMENT = _tolerated(
    'beam_misalignment', 'E_Algn', 'beam_tolerance', 4, 'beam_slope', f': {_PARALLEL}', 'rad'
)


# ---- E_Tilt: tilt of the plane of the sensors ----


def _tilt(chain: MeasuringChain, values: FloatArray, at: Situation) -> MeasuringChain:
    modelled = at.estimator.slope_ratio
    return replace(chain, slope_ratio=modelled + values[:, 0] * (at.rig.link.slope_ratio - modelled))


PLANE_TILT = Term(
    'plane_tilt',
    'E_Tilt',
    Kind.KNOWN,
    'the tip tilts by φ = -k ΔY/L, ω = +k ΔX/L, the method takes k as 0 (beam: as it is)',
    (),
    lambda at: np.ones(1),
    _tilt,
    unit='',
    calibrated=True,
)


def _vary_slope_ratio(chain: MeasuringChain, values: FloatArray, at: Situation) -> MeasuringChain:
    return replace(chain, slope_ratio=chain.slope_ratio + values[:, 0])


SLOPE_RATIO = Term(
    'slope_ratio',
    'E_Tilt',
    Kind.SYSTEMATIC,
    'slope_ratio_tolerance / sqrt 3: k is not what the rig file says',
    ('slope_ratio_tolerance',),
    _tolerance('slope_ratio_tolerance', 1),
    _vary_slope_ratio,
    unit='',
    distribution=Distribution.UNIFORM,
    calibrated=True,
)

SENSOR_TILT = _tolerated(
    'sensor_tilt', 'E_Tilt', 'tilt_tolerance', 4, 'tilt', ": the sensor's surface tilted on the plate", 'rad'
)


# ---- PageSection 3.2: where the centres are ----

CENTER_POSITION = _tolerated(
    'center_position', 'e_Xo, e_Yo', 'center_tolerance', 4, 'center_error', f' in x and y; {_BOTH}'
)

SENSOR_HEIGHT = _tolerated('sensor_height', '', 'height_tolerance', 2, 'height_error', ', times the tilt of the plate')


def _expand(chain: MeasuringChain, values: FloatArray, at: Situation) -> MeasuringChain:
    return replace(chain, center_shift=chain.center_shift + values[:, :, None] * at.chain.centers)


BRACKET_EXPANSION = Term(
    'bracket_expansion',
    '',
    Kind.SYSTEMATIC,
    'expansion_coefficient x bracket_temperature x c_i since zeroing',
    ('expansion_coefficient', 'bracket_temperature'),
    lambda at: np.array([at['expansion_coefficient'] * at['bracket_temperature']]),
    _expand,
    unit='',
)

OF_ANGLES = (SENSOR_ROTATION, BEAM_MISALIGNMENT, PLANE_TILT, SLOPE_RATIO, SENSOR_TILT)
INSTALLATION = (*OF_ANGLES, CENTER_POSITION, SENSOR_HEIGHT, BRACKET_EXPANSION)


# ---- E_RF: refraction ----


def _refraction(at: Situation) -> FloatArray:
    length, wavelength, temperature = at.rig.link.length, at['laser_wavelength'], at['temperature']
    gradient = gradient_shift(index_per_kelvin(temperature, wavelength) * at['air_gradient'], length)
    cold = air_index(STANDARD_PRESSURE, temperature, 0.0, wavelength=wavelength)
    warm = air_index(STANDARD_PRESSURE, temperature + at['air_step'], 0.0, wavelength=wavelength)
    boundary = boundary_shift(at['air_step_angle'], cold, warm, length)
    return np.array([abs(gradient)] * 2 + [abs(boundary)] * 4)


def _refract(chain: MeasuringChain, values: FloatArray, at: Situation) -> MeasuringChain:
    # A gradient bends both beams equally; a boundary (a plume) meets each beam separately.
    both, each = values[:, None, :2], values[:, 2:].reshape(-1, 2, 2)
    return replace(chain, beam_shift=chain.beam_shift + both + each)


REFRACTION = Term(
    'refraction',
    'E_RF',
    Kind.SYSTEMATIC,
    '(dn/dT air_gradient) L^2/2 on both dots, and 3.4 at a step of air_step under air_step_angle on each',
    ('air_gradient', 'air_step', 'air_step_angle', 'temperature', 'laser_wavelength'),
    _refraction,
    _refract,
)


# ---- E_EMF: interference ----


def averaging_gain(block_size: int, frequency: float, sample_rate_hz: float) -> float:
    """Return the fraction of a sinusoid that remains in the mean of a block: |sin(pi N f/fs) / (N sin(pi f/fs))|.

    20 samples at 1 kHz null 50 Hz and leave 0.16 of 60 Hz.
    """
    half_phase = math.pi * frequency / sample_rate_hz
    if abs(math.sin(half_phase)) < 1e-12:
        return 1.0
    return abs(math.sin(block_size * half_phase) / (block_size * math.sin(half_phase)))


def _interference(at: Situation) -> FloatArray:
    rig = at.rig
    gain = averaging_gain(rig.estimator.block_size, at['interference_frequency'], rig.converter.sample_rate_hz)
    return np.asarray(at['interference'] * rig.sensitivities.ravel() / math.sqrt(2.0) * gain)


INTERFERENCE = Term(
    'interference',
    'E_EMF',
    Kind.PER_ESTIMATE,
    'interference x sensitivity / sqrt 2 x what a block mean leaves of interference_frequency',
    ('interference', 'interference_frequency'),
    _interference,
    adds_to('reading_shift'),
    distribution=Distribution.ARCSINE,
)


# ---- The beams ----


POINTING = Term(
    'pointing_drift',
    '',
    Kind.SYSTEMATIC,
    'pointing_drift x L, each beam and axis by itself',
    ('pointing_drift',),
    lambda at: np.full(4, at['pointing_drift'] * at.rig.link.length),
    adds_to('beam_shift'),
)

ENVIRONMENT = (REFRACTION, INTERFERENCE, POINTING)
