# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One model of the detector: simulation, correction, calibration and budget give the same reading."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.model.detector.response import DetectorResponse, compensated, pulled
from psd_deflection.model.simulation.catalogue import make_active
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.budget.chain import MeasuringChain, measure

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
        found = response.place(times * there[0], times * there[1])
        assert found == pytest.approx((0.6 * times * farthest, -0.8 * times * farthest))


@given(place, st.floats(0.0, 5.0), place)
def test_light_is_taken_off_again(x: float, level: float, center: float) -> None:
    read = pulled(np.array(x), SUM, level, center)
    assert compensated(read, SUM, level, center) == pytest.approx(x, abs=1e-17)
