"""Counts to volts to metres; the sensor types."""

from psd_deflection.calibration.sensors import (
    Duolateral,
    Pincushion,
    Quadrant,
    Sensor,
    Tetralateral,
    make_sensor,
)
from psd_deflection.calibration.volts import Calibration, counts_to_volts, dot_noise_variances
from psd_deflection.calibration.wiring import Wiring

__all__ = [
    'Calibration',
    'Duolateral',
    'Pincushion',
    'Quadrant',
    'Sensor',
    'Tetralateral',
    'Wiring',
    'counts_to_volts',
    'dot_noise_variances',
    'make_sensor',
]
