# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Counts to volts to metres; the sensor types."""

from psd_deflection.model.detector.sensors import Duolateral, Pincushion, Quadrant, Sensor, Tetralateral, make_sensor
from psd_deflection.model.detector.volts import VoltsToDots, counts_to_volts, dot_noise_variances

__all__ = [
    'Duolateral',
    'Pincushion',
    'Quadrant',
    'Sensor',
    'Tetralateral',
    'VoltsToDots',
    'counts_to_volts',
    'dot_noise_variances',
    'make_sensor',
]
