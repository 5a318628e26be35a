# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Equations 3.1 to 3.4, corrected, and the load that suits a rig, against reference values and formulas by hand."""

import math

import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.studies.budget import sensor
from psd_deflection.studies.budget.budget import BudgetProblem, budget, default_load
from psd_deflection.studies.budget.installation import averaging_gain


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
    got = sensor.air_index(101_325.0, temperature, humidity, co2, 633e-9)
    assert got == pytest.approx(expected, abs=1e-12)
    # The short form stays within 2e-7 of it.
    assert air_index_short(temperature, humidity, co2) == pytest.approx(got, abs=2e-7)


def test_standard_air_agrees_with_another_authors_formula() -> None:
    # Ciddor (Applied Optics 35, 1996) for dry air at 15 degrees, 450 ppm CO2: 1.00027653 at 633 nm.
    assert sensor.air_index(101_325.0, 288.15, 0.0) == pytest.approx(1.00027653, abs=5e-9)


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
    got = sensor.air_index(pascal, 273.15 + celsius, percent, co2, micrometres * 1e-6) - 1.0
    assert got == pytest.approx(wanted, abs=1e-15 + 1e-12 * wanted)
    assert sensor.saturation_pressure(273.15 + celsius) == pytest.approx(_magnus(celsius), rel=1e-12)


def test_what_is_not_reported_of_the_air() -> None:
    """Half saturated, with 450 ppm of carbon dioxide, for the light of a helium-neon laser."""
    got = sensor.air_index(95_000.0, 300.0) - 1.0
    assert got == pytest.approx(_birch_and_downs(95_000.0, 26.85, 50.0, 450.0, 0.633), abs=1e-15)


@pytest.mark.parametrize('micrometres', [0.45, 0.633, 0.9])
def test_the_index_by_temperature(micrometres: float) -> None:
    warm, cold = (_birch_and_downs(101_325.0, 26.85 + t, 0.0, 450.0, micrometres) for t in (0.01, -0.01))
    assert sensor.index_per_kelvin(300.0, micrometres * 1e-6) == pytest.approx((warm - cold) / 0.02, rel=1e-5)
    assert sensor.index_per_kelvin(300.0) == sensor.index_per_kelvin(300.0, 633e-9)
    assert sensor.index_per_kelvin(293.15) == pytest.approx(-9.3e-7, rel=2e-3)


def test_shifts_by_hand() -> None:
    assert sensor.gradient_shift(3e-4, 4.0) == pytest.approx(3e-4 * 16.0 / 2.0)
    inside = math.asin(1.5 * math.sin(0.4) / 1.2)
    assert sensor.boundary_shift(0.4, 1.5, 1.2, 3.0) == pytest.approx(3.0 * (math.tan(inside) - math.tan(0.4)))
    # Grazing: the sine of 1 is still an angle, both ways.
    assert sensor.refracted_angle(math.pi / 2.0, 1.5, 1.5) == pytest.approx(math.pi / 2.0)
    assert sensor.refracted_angle(-math.pi / 2.0, 1.5, 1.5) == pytest.approx(-math.pi / 2.0)
    for angle in (0.8, -0.8):
        with pytest.raises(ConfigError, match=rf'a beam at {angle:g} rad .* indices 1\.5 and 1$'):
            sensor.refracted_angle(angle, 1.5, 1.0)


@pytest.mark.parametrize(('samples', 'frequency', 'rate'), [(20, 57.0, 1000.0), (7, 130.0, 800.0), (3, 999.9, 1000.0)])
def test_what_a_mean_leaves_of_a_sinusoid_is_that_of_its_sum(samples: int, frequency: float, rate: float) -> None:
    phases = [2.0 * math.pi * frequency * i / rate for i in range(samples)]
    gain = math.hypot(math.fsum(map(math.cos, phases)), math.fsum(map(math.sin, phases))) / samples
    assert averaging_gain(samples, frequency, rate) == pytest.approx(gain, rel=1e-6)
    assert averaging_gain(samples, 2.0 * rate, rate) == 1.0


RIG = load_rig()


def _by_hand(rig: Rig) -> float:
    """N, before it is cut to two figures: half of the way of the first dot to its edge.

    A force of 1 N and a torque of 1 N x L, both negative, move the tip by dY and theta. A dot at l on a plate at height
    h then moves by x: theta ly, y: -theta lx - dY (1 + k h/L), to first order.
    """
    link = rig.link
    area = math.pi / 4.0 * (link.outer_radius**4 - link.inner_radius**4)
    dy = -(link.length**3) / (3.0 * link.youngs_modulus * area)
    theta = -link.length * link.length / (link.shear_modulus * 2.0 * area)
    ways = []
    for psd in rig.psds:
        lx, ly = psd.center[0] + psd.zero[0], psd.center[1] + psd.zero[1]
        moves = (theta * ly, -theta * lx - dy * (1.0 + link.slope_ratio * psd.height / link.length))
        for move, zero, size in zip(moves, psd.zero, psd.active_area, strict=True):
            room = size / 2.0 - zero if move > 0.0 else size / 2.0 + zero
            ways += [0.5 * room / abs(move)] if move else []
    return min(ways)


@pytest.mark.parametrize(
    'changes',
    [
        {'link.length': 0.8},
        {'link.length': 1.7, 'psd_1.height': 0.2, 'psd_2.height': -0.3},
        {'psd_1.center': [0.0, 0.065]},
        {'psd_2.center': [-0.3, 0.01]},
        {'psd_2.center': [0.3, 0.01]},
        {'psd_1.center': [0.02, 0.6], 'link.shear_modulus': 5e9},
        {'psd_1.center': [0.02, -0.6], 'link.shear_modulus': 5e9, 'psd_1.zero': [2e-3, 0.0]},
        {'psd_1.center': [0.02, -0.6], 'link.shear_modulus': 5e9, 'psd_1.zero': [-2e-3, 0.0]},
        {'psd_1.active_area': [0.02, 0.01]},
        {'psd_1.active_area': [0.01, 0.02], 'psd_2.active_area': [0.01, 0.02]},
        {'psd_1.height': 0.01},
        {'psd_2.height': 0.01},
        {'psd_2.active_area': [0.01, 0.004]},
        {'psd_2.active_area': [0.001, 0.01], 'psd_2.center': [-0.1, 0.09]},
        {'link.length': 0.9, 'psd_1.zero': [0.0, 4e-3]},
        {'link.length': 0.9, 'psd_1.zero': [0.0, -4e-3]},
        {'link.youngs_modulus': 2e11, 'link.shear_modulus': 8e10},
    ],
    ids=str,
)
def test_a_load_moves_the_first_dot_half_of_its_way(changes: dict[str, object]) -> None:
    rig = replace_values(RIG, changes)
    fx, fy, tz = default_load(rig)
    wanted = _by_hand(rig)
    # Two figures of it, cut off.
    figures = float(f'{wanted:.8e}'[:3] + 'e' + f'{wanted:.8e}'.partition('e')[2])
    assert fx == 0.0
    assert -fy == pytest.approx(figures, rel=1e-9)
    assert tz == fy * rig.link.length
    # No digits beyond these two.
    assert len(f'{-fy:.12g}'.replace('.', '').strip('0')) <= 2


@pytest.mark.parametrize('length', [30.0, 100.0, 1000.0])
def test_a_soft_link_is_loaded_with_two_figures_as_well(length: float) -> None:
    soft = {'link.length': length, 'link.outer_radius': 2e-3, 'link.inner_radius': 1e-3}
    rig = replace_values(RIG, soft)
    wanted = _by_hand(rig)
    assert 0.0 < wanted - -default_load(rig)[1] <= 0.1 * wanted


def test_the_links_of_the_thesis_have_its_50_newtons() -> None:
    assert list(default_load(RIG)) == pytest.approx([0.0, -50.0, -29.25], rel=1e-12)
    # What is no part of the layout does not count.
    assert default_load(replace_values(RIG, {'amplifier.noise': 1e-3, 'psd_1.zero': [1e-4, 0.0]}))[1] == -50.0
    # Without room there is none.
    rig = replace_values(RIG, {'psd_1.active_area': [0.004, 0.004], 'psd_1.zero': [0.0, 0.003]})
    assert [abs(v) for v in default_load(rig)] == [0.0, 0.0, 0.0]


def test_a_rig_of_three_detectors_is_rejected_in_words() -> None:
    three = replace_values(RIG, {'psd_3.center': [0.1, 0.0]})
    with pytest.raises(ConfigError, match='two PSDs'):
        budget(BudgetProblem(three))
