# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Terms of the environment (second group of Table 3.1) and of the beams."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.studies.budget.chain import MeasuringChain
from psd_deflection.studies.budget.optics import (
    STANDARD_PRESSURE,
    air_index,
    boundary_shift,
    gradient_shift,
    index_per_kelvin,
)
from psd_deflection.studies.budget.term import Distribution, Kind, Situation, Term, adds_to

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
    turn = math.pi * frequency / sample_rate_hz
    if abs(math.sin(turn)) < 1e-12:
        return 1.0
    return abs(math.sin(block_size * turn) / (block_size * math.sin(turn)))


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


def _pointing(at: Situation) -> FloatArray:
    return np.full(4, at['pointing_drift'] * at.rig.link.length)


POINTING = Term(
    'pointing_drift',
    '',
    Kind.SYSTEMATIC,
    'pointing_drift x L, each beam and axis by itself',
    ('pointing_drift',),
    _pointing,
    adds_to('beam_shift'),
)

TERMS = (REFRACTION, INTERFERENCE, POINTING)
