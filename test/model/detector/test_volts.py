# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Counts to volts to metres, photocurrents to places and back, one model for all of them; what not to believe."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from psd_deflection.model.detector import Quadrant, VoltsToDots, counts_to_volts, dot_noise_variances, make_sensor
from psd_deflection.model.detector.response import DetectorResponse, compensated, pulled
from psd_deflection.model.simulation.catalogue import make_active
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig, replace_values, rig_from_values
from psd_deflection.rig.declarations import SENSOR_TYPES, PsdConfig
from psd_deflection.studies.budget.chain import MeasuringChain, measure


def psd(kind: str, spot_radius: float = 0.5e-3) -> PsdConfig:
    return PsdConfig(kind, (0.0, 0.0), 0.0, (0.010, 0.008), spot_radius, (0.0, 0.0))


def volts(*channels: float) -> Any:
    return np.array([channels], dtype=np.float32)


def test_counts_become_volts_rounded_once() -> None:
    counts = np.array([[-32768, -1, 0, 1, 16384, 32767]], dtype=np.int16)
    got = counts_to_volts(counts, 10.0 / 32768.0)
    assert got.dtype == np.float32
    assert got[0].tolist() == [np.float32(c * (10.0 / 32768.0)) for c in counts[0].tolist()]


def test_channels_have_own_noise_and_sensitivity() -> None:
    rig = rig_from_values({'psd_1.noise': [1e-3, 0.0], 'psd_2.noise': [4e-3, 3e-3], 'psd_2.sensitivity': [0.0, 1e-3]})
    step = 20.0 / 65536.0
    expected = [s**2 * (n**2 + step**2 / 12.0) for s, n in ((5e-4, 1e-3), (5e-4, 2e-3), (5e-4, 4e-3), (1e-3, 3e-3))]
    np.testing.assert_allclose(dot_noise_variances(rig), expected, rtol=1e-12)
    dots = VoltsToDots.from_rig(rig).dots(volts(2.0, 2.0, 5.0, 2.0, 2.0, 5.0))
    np.testing.assert_allclose(dots, [[1e-3, 1e-3, 1e-3, 2e-3]], rtol=1e-15)


@pytest.mark.parametrize('kind', SENSOR_TYPES)
@settings(deadline=None)
@given(x=st.floats(-0.7e-3, 0.7e-3), y=st.floats(-0.7e-3, 0.7e-3), total=st.floats(1e-9, 1e-3))
def test_currents_and_back(kind: str, x: float, y: float, total: float) -> None:
    sensor = make_sensor(psd(kind))
    currents = sensor.currents(np.array([[x, y]]), total)
    assert currents.shape == (1, len(sensor.electrodes))
    assert (currents > 0.0).all()
    np.testing.assert_allclose(sensor.place(currents), [[x, y]], rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(sensor.sum_signal(currents), [total], rtol=1e-12)


@pytest.mark.parametrize(
    ('kind', 'currents', 'place'),
    [
        # 2.3, 2.4 times half the length: (3 - 1)/4 of 5 mm; (1 - 3)/4 of 4 mm.
        ('duolateral', (3.0, 1.0, 1.0, 3.0), (2.5e-3, -2e-3)),
        ('tetralateral', (3.0, 1.0, 1.0, 3.0), (2.5e-3, -2e-3)),
        # Only X2, the upper right corner; then X2 and Y1, the right edge.
        ('pincushion', (0.0, 1.0, 0.0, 0.0), (5e-3, 4e-3)),
        ('pincushion', (0.0, 1.0, 1.0, 0.0), (5e-3, 0.0)),
        # 2.1, 2.2: I1 and I4 are on the right, I1 and I2 above.
        ('quadrant', (1.0, 1.0, 1.0, 1.0), (0.0, 0.0)),
    ],
)
def test_the_formulas(kind: str, currents: tuple[float, ...], place: tuple[float, float]) -> None:
    np.testing.assert_allclose(make_sensor(psd(kind)).place(np.array([currents])), [place], atol=1e-15)


@pytest.mark.parametrize('kind', SENSOR_TYPES)
def test_no_light_is_no_place(kind: str) -> None:
    assert np.isnan(make_sensor(psd(kind)).place(np.zeros((1, 4)))).all()


def test_a_quadrant_sees_the_light_of_a_gaussian_spot() -> None:
    """The four currents, against the spot's intensity integrated over each half."""
    w, x, y = 0.5e-3, 0.2e-3, -0.1e-3

    def share(center: float) -> float:
        density = lambda u: np.sqrt(2.0 / np.pi) / w * np.exp(-2.0 * (u - center) ** 2 / w**2)  # noqa: E731
        return float(quad(density, 0.0, center + 6.0 * w)[0])

    right, up = share(x), share(y)
    want = [right * up, (1 - right) * up, (1 - right) * (1 - up), right * (1 - up)]
    np.testing.assert_allclose(make_sensor(psd('quadrant', w)).currents(np.array([[x, y]]), 1.0)[0], want, rtol=1e-9)


def test_quadrant_volts_are_linear_like_lateral_ones() -> None:
    w = 0.5e-3
    rig = rig_from_values({'psd_1.type': 'quadrant', 'psd_1.spot_radius': w, 'amplifier.sensitivity': 0.1e-3})
    calibration = VoltsToDots.from_rig(rig)
    sensor = calibration.sensors[0]
    assert isinstance(sensor, Quadrant)
    place = 0.3e-3
    ratio = float(sensor.to_ratios(np.array([[place, 0.0]]))[0, 0])
    reading = ratio * w * np.sqrt(np.pi / 8.0) / 0.1e-3
    dots = calibration.dots(volts(reading, 1e-3, 5.0, reading, 1e-3, 5.0))
    np.testing.assert_allclose(dots[0, 0], place, rtol=1e-6)
    np.testing.assert_allclose(dots[0, 1], 1e-3 * 0.1e-3, rtol=1e-6)
    np.testing.assert_allclose(dots[0, 2:], [reading * 0.1e-3, 1e-3 * 0.1e-3], rtol=1e-6)
    outside = calibration.dots(volts(9.0, 0.0, 5.0, 0.0, 0.0, 5.0))
    np.testing.assert_allclose(outside[0, 0], 1.5 * w, rtol=1e-9)


def test_electrodes_go_through_the_wiring_once() -> None:
    wired = {'psds_exchanged': True, 'psd_1.axes': ['-y', 'x'], 'psd_1.sensitivity': [1e-3, 2e-3]}
    calibration = VoltsToDots.from_rig(rig_from_values(wired))
    # The second input is that of PSD 1: its own x is 1/2 of the way and its own y 1/4 back.
    electrodes = np.array([[1.0, 1.0, 1.0, 1.0, 3.0, 1.0, 3.0, 5.0]])
    dots = calibration.dots(calibration.observed(calibration.volts_of_electrodes(electrodes).astype(np.float32)))
    np.testing.assert_allclose(dots, [[1.25e-3, 2.5e-3, 0.0, 0.0]], atol=1e-9)


def test_other_light_is_taken_off_as_photocurrents_add() -> None:
    """Currents of the laser at a place and of the light elsewhere, added electrode by electrode."""
    rig = rig_from_values({'psd_1.sensitivity': [1e-3, 2e-3], 'psd_2.type': 'quadrant', 'psd_2.spot_radius': 1e-3})
    plain = VoltsToDots.from_rig(rig)
    places = np.array([[1e-3, -2e-3], [-3e-3, 0.5e-3]]), np.array([[0.3e-3, -0.1e-3], [0.0, 0.4e-3]])
    laser = [s.currents(place, 5.0) for s, place in zip(plain.sensors, places, strict=True)]
    light = [
        s.currents(np.array([[0.4e-3, 0.7e-3]]), level) for s, level in zip(plain.sensors, (0.2, 0.1), strict=True)
    ]
    dark = plain.volts_of_electrodes(np.hstack(light))[0]
    levels = {f'psd_{n}.dark': dark[3 * n - 3 : 3 * n].tolist() for n in (1, 2)}
    both = plain.volts_of_electrodes(np.hstack([a + b for a, b in zip(laser, light, strict=True)])).astype(np.float32)
    assert abs(plain.dots(both) - np.hstack(places)).max() > 20e-6
    compensated = VoltsToDots.from_rig(replace_values(rig, levels)).dots(both)
    np.testing.assert_allclose(compensated, np.hstack(places), atol=2e-9)


def test_dots_without_dark_levels_or_laser_are_finite() -> None:
    nominal = rig_from_values({})
    drawn = np.random.default_rng(1).uniform(-9.0, 9.0, (50, 6)).astype(np.float32)
    no_light = VoltsToDots.from_rig(
        replace_values(nominal, {'psd_1.dark': [5.0, 5.0, 0.0], 'psd_2.dark': [1.0, 1.0, -0.1]})
    )
    np.testing.assert_array_equal(no_light.dots(drawn), VoltsToDots.from_rig(nominal).dots(drawn))
    psd_2_dark = VoltsToDots.from_rig(replace_values(nominal, {'psd_2.dark': [1.0, -1.0, 0.1]}))
    np.testing.assert_array_equal(psd_2_dark.dots(drawn)[:, :2], VoltsToDots.from_rig(nominal).dots(drawn)[:, :2])
    # With the laser off what is left is noise, 2 mV of the sum and of x: no dot outside the active area.
    for noise in (-2e-3, 0.0, 2e-3):
        assert np.abs(psd_2_dark.dots(volts(0.0, 0.0, 0.0, 1.0 - noise, -1.0, 0.1 + noise))).max() < 1e-3
    # The least light that is believed: a tenth of the other light.
    np.testing.assert_allclose(psd_2_dark.dots(volts(0.0, 0.0, 0.0, 1.0, 0.0, 0.11))[0, 2:], [0.5e-3, 5e-3], rtol=1e-5)
    assert np.isfinite(psd_2_dark.dots(np.zeros((1, 6), dtype=np.float32))).all()


def test_a_place_is_valid_as_far_as_its_sensor_reaches() -> None:
    np.testing.assert_array_equal(make_sensor(psd('duolateral')).reach(), [5e-3, 4e-3])
    # A quadrant: 1.5 w, or the edge if that is nearer.
    np.testing.assert_allclose(make_sensor(psd('quadrant', 2e-3)).reach(), [3e-3, 3e-3], rtol=1e-12)
    np.testing.assert_allclose(make_sensor(psd('quadrant', 3e-3)).reach(), [4.5e-3, 4e-3], rtol=1e-12)


def test_a_ratio_is_a_place_and_back_for_each_sensor() -> None:
    for kind in SENSOR_TYPES:
        sensor = make_sensor(psd(kind, 2e-3))
        places = np.array([[1e-3, -2e-3], [-0.5e-3, 1.5e-3]])
        np.testing.assert_allclose(sensor.from_ratios(sensor.to_ratios(places)), places, rtol=1e-9)
        linear = sensor.to_linear(sensor.to_ratios(places))
        np.testing.assert_allclose(sensor.from_linear(linear), places, rtol=1e-9)
        # Near the centre a place and its linear reading are the same.
        np.testing.assert_allclose(sensor.to_linear(sensor.to_ratios(1e-3 * places)), 1e-3 * places, rtol=1e-5)


def test_each_of_three_psds_has_its_own_curve_and_sensitivity() -> None:
    """A quadrant between two lateral sensors: places through electrodes and volts, and back."""
    values: dict[str, Any] = {'psd_3.center': [0.08, -0.06], 'psd_2.type': 'quadrant', 'psd_2.spot_radius': 1e-3}
    sizes = {f'psd_{n}.sensitivity': [n * 1e-4, n * 1e-4 + 5e-5] for n in (1, 2, 3)}
    calibration = VoltsToDots.from_rig(rig_from_values({**values, **sizes}))
    places = np.array([[1e-3, -2e-3, 0.3e-3, -0.1e-3, -3e-3, 0.5e-3], [-1e-3, 2e-3, -0.4e-3, 0.2e-3, 2e-3, 1e-3]])
    parts = [s.currents(places[:, 2 * i : 2 * i + 2], 5.0) for i, s in enumerate(calibration.sensors)]
    read = calibration.volts_of_electrodes(np.hstack(parts))
    np.testing.assert_allclose(calibration.dots(read.astype(np.float32)), places, rtol=1e-5)
    # A lateral sensor's volts are the places over the sensitivities.
    np.testing.assert_allclose(read[:, [0, 1, 6, 7]], places[:, [0, 1, 4, 5]] / [1e-4, 1.5e-4, 3e-4, 3.5e-4], rtol=1e-9)
    np.testing.assert_allclose(read[:, 2::3], 5.0)
    # Without light on one axis of one of them that one says nothing.
    for psd in range(3):
        lost = np.hstack(parts)
        lost[0, 4 * psd : 4 * psd + 4] = 0.0
        want = read.copy()
        want[0, 3 * psd : 3 * psd + 3] = 0.0
        np.testing.assert_array_equal(calibration.volts_of_electrodes(lost), want)


RIG = load_rig()
SUM = RIG.amplifier.sum_nominal
share = st.floats(-0.05, 0.05)
place = st.floats(-4e-3, 4e-3)


def simulated(x: float, y: float, *effects: ActiveEffect) -> FloatArray:
    """What PSD 1 reads of a dot at (x, y), m, with ``effects``, in the order in which the simulation applies them."""
    samples = SimulatedSamples(np.zeros(1), np.zeros(1), np.zeros((3, 1)), Physics.of(RIG))
    samples.dots = np.array([[x], [y], [0.0], [0.0]])
    samples.sums = np.full((2, 1), SUM)
    for active in sorted(effects, key=lambda a: a.effect.rank):
        assert active.effect.apply is not None
        active.effect.apply(samples, active.values, {})
    return samples.dots[:2, 0]


def budgeted(x: float, y: float, **errors: Any) -> FloatArray:
    """The same by the chain of the error budget: at rest the dot lies at the zero."""
    chain = replace(MeasuringChain.of(RIG), zeros=np.array([[x, y], [0.0, 0.0]]), **errors)
    readings, _ = measure(chain, np.zeros(3))
    return np.asarray(readings[0, 0])


def effect(name: str, **values: float) -> ActiveEffect:
    return make_active(name, {'psd': 1, **values}, 'test')


def test_light_pulls_the_reading_before_it_grows() -> None:
    # By hand: 4 mm / 1.05 = 3.80952 mm, and that times 1 + 500 /m^2 (3.80952 mm)^2 = 1.0072562.
    light = effect('ambient_light', level=0.05 * SUM)
    by_simulation = simulated(4e-3, 0.0, light, effect('sensor_nonlinearity', k=500.0))
    by_budget = budgeted(4e-3, 0.0, background=np.array([[0.05]]), nonlinearity=np.array([[500.0]]))
    assert by_simulation[0] == pytest.approx(3.8371666e-3, abs=1e-10)
    assert by_budget == pytest.approx(by_simulation, rel=1e-14)


@pytest.mark.slow
@given(place, place, st.floats(0.0, 0.2), st.floats(-3000.0, 3000.0), share, share)
def test_the_budget_reads_what_the_simulation_does(
    x: float, y: float, light: float, k: float, gain_x: float, gain_y: float
) -> None:
    radius = 1.5e-3
    effects = [
        effect('spot_clipping', radius=radius, profile=2),
        effect('ambient_light', level=light * SUM),
        effect('sensor_nonlinearity', k=k),
        effect('sensor_gain', x=gain_x, y=gain_y),
    ]
    want = simulated(x, y, *effects)
    # The sum falls with a cut spot, so that the light weighs more; the budget states the light's share itself.
    cut = SimulatedSamples(np.zeros(1), np.zeros(1), np.zeros((3, 1)), Physics.of(RIG))
    cut.dots, cut.sums = np.array([[x], [y], [0.0], [0.0]]), np.full((2, 1), SUM)
    assert effects[0].effect.apply is not None
    effects[0].effect.apply(cut, effects[0].values, {})
    got = budgeted(
        x, y,
        spot_diameter=np.array([[2.0 * radius]]),
        background=np.array([[light * SUM / cut.sums[0, 0]]]),
        nonlinearity=np.array([[k]]),
        gain=np.array([[[gain_x, gain_y]]]),
    )  # fmt: skip
    assert got == pytest.approx(want, abs=1e-16)


@pytest.mark.slow
@given(place, place, st.floats(-0.1, 0.1), share, share, share, share, st.floats(-3000.0, 3000.0))
def test_calibration_response_inverts_simulation(
    x: float, y: float, angle: float, gain_x: float, gain_y: float, xy: float, yx: float, k: float
) -> None:
    response = DetectorResponse(angle, gain_x, gain_y, xy, yx, k)
    got = np.array(response.reading(np.array(x), np.array(y)))
    want = simulated(
        x, y,
        effect('sensor_rotation', angle=angle),
        effect('sensor_nonlinearity', k=k),
        effect('axis_crosstalk', xy=xy, yx=yx),
        effect('sensor_gain', x=gain_x, y=gain_y),
    )  # fmt: skip
    assert got == pytest.approx(want, abs=1e-17)
    assert np.array(response.place(got[0], got[1])) == pytest.approx(np.array([x, y]), abs=1e-15)
    step = 1e-5
    slope = (np.array(response.reading(np.array(x + step), np.array(y))) - got) / step
    assert response.slopes(np.array(x), np.array(y))[:, 0] == pytest.approx(slope, abs=1e-3)


@pytest.mark.parametrize('k', [-0.5, -3000.0, -9000.0])
def test_beyond_the_fold_the_inverse_is_a_straight_line(k: float) -> None:
    """r (1 + k r^2) has a slope of a tenth at sqrt(0.3/-k), where it reads 0.7 r; farther out it would fold back."""
    farthest = (0.3 / -k) ** 0.5
    response = DetectorResponse(0.0, 0.0, 0.0, 0.0, 0.0, k)
    there = response.reading(np.array(0.6 * farthest), np.array(-0.8 * farthest))
    assert np.hypot(*there) == pytest.approx(0.7 * farthest)
    for times in (1.0, 1.01, 2.0, 100.0):
        place = response.place(times * there[0], times * there[1])
        assert place == pytest.approx((0.6 * times * farthest, -0.8 * times * farthest))


@given(place, st.floats(0.0, 5.0), place)
def test_light_is_taken_off_again(x: float, level: float, center: float) -> None:
    read = pulled(np.array(x), SUM, level, center)
    assert compensated(read, SUM, level, center) == pytest.approx(x, abs=1e-17)
