# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Equations 3.1 to 3.4, corrected: reference values, and that what is printed in the thesis is another thing."""

from __future__ import annotations

import math

import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.studies.budget.environment import averaging_gain
from psd_deflection.studies.budget.optics import (
    air_index,
    beam_diameter,
    boundary_shift,
    gradient_shift,
    index_per_kelvin,
    refracted_angle,
    saturation_pressure,
)


@pytest.mark.parametrize(
    ('diameter', 'distance', 'expected', 'printed'),
    [
        (1.0e-3, 0.585, 1.111035814e-3, 1.007298385e-3),
        (2.0e-3, 0.585, 2.014596770e-3, 2.000915418e-3),
        (0.5e-3, 0.585, 1.089771683e-3, 0.555517907e-3),
        (1.0e-3, 10.0, 8.3363e-3, 2.2980e-3),
    ],
)
def test_beam_diameter(diameter: float, distance: float, expected: float, printed: float) -> None:
    got = beam_diameter(diameter, 650e-9, distance)
    assert got == pytest.approx(expected, rel=1e-5 if distance > 1.0 else 1e-9)
    # 3.1 as printed puts diameters into the law of the radii.
    as_printed = diameter * math.sqrt(1.0 + (650e-9 * distance / (math.pi * diameter**2)) ** 2)
    assert as_printed == pytest.approx(printed, rel=1e-4 if distance > 1.0 else 1e-9)
    # Far from the waist the full divergence is 4 lambda/(pi D0).
    assert beam_diameter(diameter, 650e-9, 1e6) / 1e6 == pytest.approx(4.0 * 650e-9 / (math.pi * diameter), rel=1e-6)


def air_index_short(temperature: float, humidity: float, co2: float) -> float:
    """3.3 at standard pressure with its CO2 term put right: printed divided by 1e-6, n = 14678 at 400 ppm."""
    return 1.0 + 271.8e-6 * 293.15 / temperature * (1.0 + 0.54e-6 * (co2 - 300.0)) - 1e-8 * humidity


@pytest.mark.parametrize(
    ('temperature', 'co2', 'humidity', 'expected'),
    [
        (293.15, 400.0, 50.0, 1.000271368329),
        (288.15, 400.0, 50.0, 1.000276207236),
        (288.15, 450.0, 0.0, 1.000276528867),
    ],
)
def test_the_index_of_air(temperature: float, co2: float, humidity: float, expected: float) -> None:
    got = air_index(101_325.0, temperature, humidity, co2, 633e-9)
    assert got == pytest.approx(expected, abs=1e-12)
    # The short form stays within 2e-7 of it.
    assert air_index_short(temperature, humidity, co2) == pytest.approx(got, abs=2e-7)


def test_standard_air_agrees_with_another_authors_formula() -> None:
    # Ciddor (Applied Optics 35, 1996) for dry air at 15 degrees, 450 ppm CO2: 1.00027653 at 633 nm.
    assert air_index(101_325.0, 288.15, 0.0) == pytest.approx(1.00027653, abs=5e-9)


@pytest.mark.parametrize(('degrees', 'micrometres'), [(5.0, 0.46), (45.0, 10.488010), (80.0, 987.0)])
def test_shift_behind_a_boundary(degrees: float, micrometres: float) -> None:
    cold, warm = (air_index_short(t, 50.0, 400.0) for t in (293.15, 303.15))
    got = 1e6 * boundary_shift(math.radians(degrees), cold, warm, 0.585)
    assert got == pytest.approx(micrometres, abs={5.0: 5e-3, 45.0: 5e-7, 80.0: 0.5}[degrees])


def test_a_gradient_bends_the_beam() -> None:
    per_kelvin = index_per_kelvin(293.15)
    assert 1e6 * gradient_shift(abs(per_kelvin), 0.585) == pytest.approx(0.159, abs=5e-4)
    # Slices of a layered medium, refracted one after the other, give the same.
    gradient, length, slices = 1e-4, 0.585, 2000
    slope, place, step = 0.0, 0.0, 0.585 / 2000
    for _ in range(slices):
        slope += gradient * step / 2.0
        place += slope * step
        slope += gradient * step / 2.0
    assert place == pytest.approx(gradient_shift(gradient, length), rel=1e-9)


def test_what_averaging_leaves_of_hum() -> None:
    assert averaging_gain(20, 50.0, 1000.0) == pytest.approx(0.0, abs=1e-12)
    assert averaging_gain(20, 60.0, 1000.0) == pytest.approx(0.157, abs=1e-3)
    # An alias of a constant is not averaged at all.
    assert averaging_gain(20, 1000.0, 1000.0) == 1.0


def _magnus(celsius: float) -> float:
    """WMO-No. 8, annex 4.B: ln e = ln 6.112 + 17.62 t / (243.12 + t), hPa."""
    return 100.0 * math.exp(math.log(6.112) + 17.62 * celsius / (243.12 + celsius))


def _birch_and_downs(pascal: float, celsius: float, percent: float, co2: float, micrometres: float) -> float:
    """Refractivity: Metrologia 30 (1993), equations 1 to 3; carbon dioxide by Edlen's factor."""
    s2 = micrometres**-2
    standard = 1e-8 * (8342.54 + 2406147.0 / (130.0 - s2) + 15998.0 / (38.9 - s2))
    standard *= (1.0 + 0.540e-6 * (co2 - 300.0)) / (1.0 + 0.540e-6 * (450.0 - 300.0))
    dry = (
        pascal * standard / 96095.43 * (1.0 + 1e-8 * (0.601 - 0.00972 * celsius) * pascal) / (1.0 + 0.003661 * celsius)
    )
    vapour = _magnus(celsius) * percent / 100.0
    return dry - vapour * (3.7345 - 0.0401 * s2) * 1e-10 * 292.75 / (celsius + 273.15)


@pytest.mark.parametrize(
    ('pascal', 'celsius', 'percent', 'co2', 'micrometres'),
    [
        (101_325.0, 20.0, 50.0, 450.0, 0.633),
        (90_000.0, 35.0, 90.0, 900.0, 0.45),
        (105_000.0, -10.0, 0.0, 300.0, 0.8),
        (1_000_000.0, 45.0, 100.0, 0.0, 0.4),
    ],
)
def test_the_index_of_any_air(pascal: float, celsius: float, percent: float, co2: float, micrometres: float) -> None:
    wanted = _birch_and_downs(pascal, celsius, percent, co2, micrometres)
    got = air_index(pascal, 273.15 + celsius, percent, co2, micrometres * 1e-6) - 1.0
    assert got == pytest.approx(wanted, abs=1e-15 + 1e-12 * wanted)
    assert saturation_pressure(273.15 + celsius) == pytest.approx(_magnus(celsius), rel=1e-12)


def test_what_is_not_said_of_the_air() -> None:
    """Half saturated, with 450 ppm of carbon dioxide, for the light of a helium-neon laser."""
    got = air_index(95_000.0, 300.0) - 1.0
    assert got == pytest.approx(_birch_and_downs(95_000.0, 26.85, 50.0, 450.0, 0.633), abs=1e-15)


@pytest.mark.parametrize('micrometres', [0.45, 0.633, 0.9])
def test_the_index_by_temperature(micrometres: float) -> None:
    warm, cold = (_birch_and_downs(101_325.0, 26.85 + t, 0.0, 450.0, micrometres) for t in (0.01, -0.01))
    assert index_per_kelvin(300.0, micrometres * 1e-6) == pytest.approx((warm - cold) / 0.02, rel=1e-5)
    assert index_per_kelvin(300.0) == index_per_kelvin(300.0, 633e-9)
    assert index_per_kelvin(293.15) == pytest.approx(-9.3e-7, rel=2e-3)


def test_shifts_by_hand() -> None:
    assert gradient_shift(3e-4, 4.0) == pytest.approx(3e-4 * 16.0 / 2.0)
    inside = math.asin(1.5 * math.sin(0.4) / 1.2)
    assert boundary_shift(0.4, 1.5, 1.2, 3.0) == pytest.approx(3.0 * (math.tan(inside) - math.tan(0.4)))
    # Grazing: the sine of 1 is still an angle, both ways.
    assert refracted_angle(math.pi / 2.0, 1.5, 1.5) == pytest.approx(math.pi / 2.0)
    assert refracted_angle(-math.pi / 2.0, 1.5, 1.5) == pytest.approx(-math.pi / 2.0)
    for angle in (0.8, -0.8):
        with pytest.raises(ConfigError, match=rf'a beam at {angle:g} rad .* indices 1\.5 and 1$'):
            refracted_angle(angle, 1.5, 1.0)


@pytest.mark.parametrize(('samples', 'frequency', 'rate'), [(20, 57.0, 1000.0), (7, 130.0, 800.0), (3, 999.9, 1000.0)])
def test_what_a_mean_leaves_of_a_sinusoid_is_that_of_its_sum(samples: int, frequency: float, rate: float) -> None:
    turns = [2.0 * math.pi * frequency * i / rate for i in range(samples)]
    left = math.hypot(math.fsum(map(math.cos, turns)), math.fsum(map(math.sin, turns))) / samples
    assert averaging_gain(samples, frequency, rate) == pytest.approx(left, rel=1e-6)
    assert averaging_gain(samples, 2.0 * rate, rate) == 1.0
