# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The inputs: defaults by the sources that they name, and bounds that hold on both sides."""

from __future__ import annotations

import math

import pytest

from psd_deflection.studies.budget.inputs import INPUTS, REFERENCE_INPUTS

EVERY = (*INPUTS, *REFERENCE_INPUTS)
NANO, MICRO, MILLI = 1e-9, 1e-6, 1e-3

# By what the sources say: data sheets, the thesis, a rule. Default, unit, least (more than it: True), greatest.
MESSAGE: dict[str, tuple[float, str, float, bool, float]] = {
    'laser_wavelength': (650 * NANO, 'm', 10 * NANO, True, 10 * MICRO),
    'laser_diameter': (1 * MILLI, 'm', 1 * MICRO, True, 50 * MILLI),
    'laser_power': (1 * MILLI / 2, 'W', 0.0, True, 1.0),
    'profile_change': (1 * MILLI, '', 0.0, False, 1.0),
    'pointing_drift': (10 * MICRO, 'rad', 0.0, False, 0.1),
    'responsivity': (0.4, 'A/W', 0.0, True, 2.0),
    'dark_current': (500 * NANO, 'A', 0.0, False, 1 * MILLI),
    'nonlinearity': (0.1 / 100, '', 0.0, False, 0.1),
    'drift_coefficient': (40 * MICRO, '1/K', 0.0, False, 0.01),
    'temperature': (273.15 + 20.0, 'K', 273.15 - 50.0, True, 273.15 + 80.0),
    'temperature_change': (5.0, 'K', 0.0, False, 100.0),
    'air_gradient': (10.0, 'K/m', 0.0, False, 1000.0),
    'air_step': (303.15 - 293.15, 'K', 0.0, False, 500.0),
    'air_step_angle': (math.radians(5.0), 'rad', 0.0, False, 1.4),
    'interference': (5 * MILLI, 'V', 0.0, False, 10.0),
    'interference_frequency': (60.0, 'Hz', 0.0, True, 1e6),
    'rotation_tolerance': (math.radians(0.5), 'rad', 0.0, False, 0.5),
    'tilt_tolerance': (math.radians(0.5), 'rad', 0.0, False, 0.5),
    'beam_tolerance': (2 * MILLI / 0.585, 'rad', 0.0, False, 0.5),
    'center_tolerance': (1 * MILLI / 2, 'm', 0.0, False, 0.1),
    'height_tolerance': (1 * MILLI, 'm', 0.0, False, 0.1),
    'gain_tolerance': (2 * MILLI, '', 0.0, False, 0.5),
    'expansion_coefficient': (23.6 * MICRO, '1/K', 0.0, False, 1 * MILLI),
    'bracket_temperature': (1.0, 'K', 0.0, False, 100.0),
    'slope_ratio_tolerance': ((2.0 - 1.0) / 2.0, '', 0.0, False, 5.0),
    'zero_blocks': (1.0, 'blocks', 0.0, True, 1e6),
    'noise_freedom': (1000.0 - 1.0, '', 0.0, True, 1e9),
    # 25 % are 8 degrees of freedom.
    'assumption_doubt': (math.sqrt(1.0 / (2.0 * 8.0)), '', 0.0, False, 10.0),
    'iteration_tolerance': (0.1 * MILLI, 'm', 0.0, False, 10 * MILLI),
    'iteration_step': (math.radians(0.01), 'rad', 0.0, False, 0.1),
    'reference_scale': (1e-4, '', 0.0, False, 0.1),
    'reference_angle_scale': (1e-4, '', 0.0, False, 0.1),
}
# A source that says degrees or millimetres is rounded to two or three digits.
ROUNDED = {'beam_tolerance': 0.03, 'rotation_tolerance': 0.01, 'tilt_tolerance': 0.01, 'air_step_angle': 1e-3}


def test_every_input_is_what_its_source_says() -> None:
    assert [i.parameter.name for i in EVERY] == list(MESSAGE)
    for i in EVERY:
        default, unit, *_ = MESSAGE[i.parameter.name]
        assert i.parameter.default == pytest.approx(default, rel=ROUNDED.get(i.parameter.name, 1e-6))
        assert i.parameter.unit == unit
