# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Each error parameter: its deviation by a formula written again, and the field of the chain that it moves."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.misalignment.model import readings
from psd_deflection.model.misalignment.rig import vector_of_rig
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.studies.budget.chain import ExactEstimator, MeasuringChain, dots, estimator_of, measure
from psd_deflection.studies.budget.evaluate import CAUSES, COMPUTATION, draws, monte_carlo, perfect_answer
from psd_deflection.studies.budget.inputs import read_inputs
from psd_deflection.studies.budget.installation import BRACKET_EXPANSION, PLANE_TILT, SLOPE_RATIO
from psd_deflection.studies.budget.term import Situation, Term

# Every number of it differs from its neighbours.
RIG = replace_values(
    load_rig(),
    {'link.length': 0.7, 'psd_1.center': [0.01, 0.080], 'psd_2.center': [-0.11, 0.02]}
    | {'psd_1.height': 0.03, 'psd_2.height': -0.02, 'psd_1.zero': [1e-4, -2e-4], 'psd_2.zero': [3e-4, 5e-4]}
    | {'psd_1.active_area': [0.010, 0.012], 'psd_2.active_area': [0.008, 0.014]}
    | {'psd_1.sensitivity': [4e-4, 5e-4], 'psd_2.sensitivity': [6e-4, 7e-4]},
)
LOAD = (6.0, -20.0, -10.0)
INPUTS = (
    {'laser_wavelength': 700e-9, 'laser_diameter': 0.8e-3, 'laser_power': 0.7e-3, 'responsivity': 0.3}
    | {'temperature': 301.0, 'temperature_change': 3.0, 'bracket_temperature': 2.0, 'slope_ratio_tolerance': 0.3}
    | {'air_gradient': 7.0, 'air_step': 13.0, 'air_step_angle': 0.3, 'zero_blocks': 9.0}
    | {'interference': 3e-3, 'interference_frequency': 57.0}
)


def _at(method: str = 'exact', rig: Rig = RIG, load: tuple[float, float, float] = LOAD, **more: float) -> Situation:
    return Situation.at_load(rig, read_inputs(None, {**INPUTS, **more}), load, method)


def _term(name: str) -> Term:
    cause = next(c for c in CAUSES if c.name == name)
    assert isinstance(cause, Term)
    return cause


def _index(kelvin: float, metres: float) -> float:
    """Refractivity of dry air at 1013.25 hPa with 450 ppm of CO2, Birch and Downs 1993 (equations 1 to 3), plus 1."""
    s2 = (1.0 / (metres * 1e6)) ** 2
    standard = 8342.54 + 2406147.0 / (130.0 - s2) + 15998.0 / (38.9 - s2)
    t = kelvin - 273.15
    p = 101325.0
    return 1.0 + 1e-8 * p * standard / 96095.43 * (1.0 + 1e-8 * (0.601 - 0.00972 * t) * p) / (1.0 + 0.0036610 * t)


def _diameter(x: float) -> float:
    """By the radius: w = w0 sqrt(1 + (x/z_R)^2), z_R = pi w0^2 / lambda."""
    w0 = 0.4e-3
    rayleigh = math.pi * w0**2 / 700e-9
    return 2.0 * w0 * math.sqrt(1.0 + (x / rayleigh) ** 2)


def _deviations() -> dict[str, list[float]]:
    """Of every term of the rig and the inputs above, by hand."""
    step, samples = 20.0 / 2**16, 20
    sensitivities = np.array([4e-4, 5e-4, 6e-4, 7e-4])
    noise = 2e-3 * sensitivities / math.sqrt(samples)
    rounding = step * sensitivities / math.sqrt(12.0 * samples)
    means = np.array([11e-3, 11e-3])
    per_kelvin = (_index(301.5, 700e-9) - _index(300.5, 700e-9)) / 1.0
    gradient = abs(per_kelvin) * 7.0 * 0.7**2 / 2.0
    inside = math.asin(_index(301.0, 700e-9) * math.sin(0.3) / _index(314.0, 700e-9))
    boundary = abs(math.tan(inside) - math.tan(0.3)) * 0.7
    # A mean over 20 samples of exp(i w t), as a sum.
    phasors = np.exp(2j * math.pi * 57.0 * np.arange(samples) / 1000.0)
    gain = abs(phasors.mean())
    return {
        'light_profile': [1e-3 * _diameter(0.7)] * 4,
        'spot_clipping': [1.0],
        'dark_current': [500e-9 / (0.3 * 0.7e-3) / math.sqrt(3.0)] * 2,
        # Off by 1e-3 of the length at 80 % of half of it: k (0.4 length)^3 = 1e-3 length.
        'resistivity': (1e-3 * means / (0.4 * means) ** 3 / math.sqrt(3.0)).tolist(),
        'thermal_drift': [40e-6 * 3.0 * size / math.sqrt(3.0) for size in (10e-3, 12e-3, 8e-3, 14e-3)],
        'sensor_gain': [2e-3 / math.sqrt(3.0)] * 4,
        'amplifier_noise': noise.tolist(),
        'quantisation': rounding.tolist(),
        'zeroing': (np.sqrt(noise**2 + rounding**2) / 3.0).tolist(),
        'refraction': [gradient] * 2 + [boundary] * 4,
        'interference': (3e-3 * sensitivities / math.sqrt(2.0) * gain).tolist(),
        'pointing_drift': [10e-6 * 0.7] * 4,
        'sensor_rotation': [8.7e-3 / math.sqrt(3.0)] * 2,
        'beam_misalignment': [3.5e-3 / math.sqrt(3.0)] * 4,
        'plane_tilt': [1.0],
        'slope_ratio': [0.3 / math.sqrt(3.0)],
        'sensor_tilt': [8.7e-3 / math.sqrt(3.0)] * 4,
        'center_position': [0.5e-3 / math.sqrt(3.0)] * 4,
        'sensor_height': [1e-3 / math.sqrt(3.0)] * 2,
        'bracket_expansion': [23.6e-6 * 2.0],
    }


@pytest.mark.parametrize('name', list(_deviations()))
def test_a_deviation_is_that_of_its_formula(name: str) -> None:
    assert _term(name).deviations(_at()) == pytest.approx(_deviations()[name], rel=1e-7)


def test_noise_of_half_a_step_averages_the_rounding() -> None:
    half = 20.0 / 2**16 / 2.0
    for noise, samples in ((half, 20.0), (half * (1.0 - 1e-9), 1.0)):
        at = _at(rig=replace_values(RIG, {'amplifier.noise': noise}))
        expected = 20.0 / 2**16 * 4e-4 / math.sqrt(12.0 * samples)
        assert _term('quantisation').deviations(at)[0] == pytest.approx(expected, rel=1e-9)


def test_air_bends_both_beams_alike_or_each() -> None:
    at = _at()
    values = np.array([[1.0, 2.0, 10.0, 20.0, 30.0, 40.0], [0.0] * 6])
    once = _term('refraction').apply(at.chain, values, at)
    assert once.beam_shift.tolist() == [[[11.0, 22.0], [31.0, 42.0]], [[0.0, 0.0], [0.0, 0.0]]]
    assert np.array_equal(_term('refraction').apply(once, values, at).beam_shift, 2.0 * once.beam_shift)


def test_what_the_other_terms_change() -> None:
    at = _at()
    grown = BRACKET_EXPANSION.apply(at.chain, np.array([[1e-3], [-2e-3]]), at)
    # A bracket that grows takes each centre outwards, by its distance.
    assert grown.center_shift == pytest.approx(
        np.array([[[1e-5, 8e-5], [-1.1e-4, 2e-5]], [[-2e-5, -1.6e-4], [2.2e-4, -4e-5]]])
    )
    assert BRACKET_EXPANSION.apply(grown, np.array([[1e-3]]), at).center_shift[0, 1, 0] == pytest.approx(-2.2e-4)
    assert SLOPE_RATIO.apply(at.chain, np.array([[0.2], [-0.3]]), at).slope_ratio == pytest.approx([1.7, 1.2])
    # The flat method takes k as 0; the tilt is there or not.
    assert PLANE_TILT.apply(at.chain, np.array([[0.0], [1.0]]), at).slope_ratio == pytest.approx([0.0, 1.5])
    beam = _at('beam')
    assert PLANE_TILT.apply(beam.chain, np.array([[0.0], [1.0]]), beam).slope_ratio == pytest.approx([1.5, 1.5])
    spot = _term('spot_clipping').apply(at.chain, np.array([[0.0], [1.0]]), at).spot_diameter
    assert spot.ravel() == pytest.approx([0.0, _diameter(0.7)])


def _traced(chain: MeasuringChain, pose: FloatArray, dz: float, psd: int) -> FloatArray:
    """The dot (2,) of one sensor: a ray and a plane in space, with the rotations of scipy."""
    k = chain.slope_ratio[0] / chain.link_length
    plate = Rotation.from_euler('zxy', [pose[2], -k * pose[1], k * pose[0]]).as_matrix()
    angles = [chain.rotation[0, psd], *chain.tilt[0, psd]]
    sensor = Rotation.from_euler('zxy', angles).as_matrix()
    centre = np.append(chain.centers[psd] + chain.center_error[0, psd], chain.heights[psd] + chain.height_error[0, psd])
    through = centre + sensor @ np.append(chain.zeros[psd], 0.0) + np.append(chain.beam_shift[0, psd], 0.0)
    along = np.append(chain.beam_slope[0, psd], 1.0)
    origin = np.append(pose[:2], dz) + plate @ (centre + np.append(chain.center_shift[0, psd], 0.0))
    axes = plate @ sensor
    # through + t along = origin + axes (x, y, 0).
    _, x, y = np.linalg.solve(np.column_stack([along, -axes[:, 0], -axes[:, 1]]), origin - through)
    return np.array([x, y])


def _wrong_chain() -> MeasuringChain:
    rng = np.random.default_rng(4)

    def errors(size: float, *shape: int) -> FloatArray:
        return rng.normal(0.0, size, (1, 2, *shape))

    return replace(
        MeasuringChain.of(RIG),
        center_error=errors(1e-3, 2),
        height_error=errors(5e-3),
        rotation=errors(0.05),
        tilt=errors(0.05, 2),
        beam_slope=errors(0.05, 2),
        center_shift=errors(1e-4, 2),
        beam_shift=errors(1e-4, 2),
        nonlinearity=errors(200.0),
        background=np.abs(errors(0.05)),
        gain=errors(0.02, 2),
        reading_shift=errors(1e-4, 2),
        zero_shift=errors(1e-4, 2),
    )


def test_everything_wrong_is_a_ray_and_a_plane() -> None:
    chain, pose = _wrong_chain(), np.array([1.5e-3, -2e-3, 0.02])
    for dz in (0.0, -1e-3):
        got = dots(chain, pose, dz)[0]
        for psd in (0, 1):
            assert got[psd] == pytest.approx(_traced(chain, pose, dz, psd), abs=1e-14)
    read, zeros = measure(chain, pose)

    def reading(place: FloatArray, psd: int) -> FloatArray:
        # Light from elsewhere draws to the middle; then the cubic; then the scale of each channel.
        x = place / (1.0 + chain.background[0, psd])
        return np.asarray(x * (1.0 + chain.nonlinearity[0, psd] * (x @ x)) * (1.0 + chain.gain[0, psd]))

    for psd in (0, 1):
        loaded = reading(_traced(chain, pose, 0.0, psd), psd) + chain.reading_shift[0, psd]
        assert read[0, psd] == pytest.approx(loaded, abs=1e-14)
        assert zeros[0, psd] == pytest.approx(reading(RIG.zeros[psd], psd) + chain.zero_shift[0, psd], abs=1e-14)


def test_only_a_spot_that_has_a_size_is_clipped() -> None:
    # A gaussian at the edge: half of it is caught, and its centroid is sqrt(2/pi) deviations inside.
    rig = replace_values(RIG, {'psd_1.zero': [5e-3, 0.0]})
    at_edge = replace(MeasuringChain.of(rig), spot_diameter=np.array([[4e-4, 0.0]]))
    read, _ = measure(at_edge, np.zeros(3))
    assert read[0, 0, 0] == pytest.approx(5e-3 - 1e-4 * math.sqrt(2.0 / math.pi), abs=1e-10)
    assert read[0, 1] == pytest.approx(rig.zeros[1], abs=1e-9)


@pytest.mark.parametrize('method', ['exact', 'beam'])
def test_weighted_least_squares_is_that_of_scipy(method: str) -> None:
    estimator = estimator_of(RIG, method)
    assert isinstance(estimator, ExactEstimator)
    weights = np.array([1.0, 4.0, 0.25, 9.0])
    p = vector_of_rig(RIG).values.copy()
    if method == 'exact':
        p[[i for i, v in enumerate(p) if v == 1.5]] = 0.0
    # Readings of no pose, so that the weights matter.
    read = np.array([[[1e-3, -2e-3], [0.5e-3, 1.5e-3]], [[-1e-3, -1e-3], [2e-3, 1e-3]]])
    for given in (None, weights):
        root = np.sqrt(weights) if given is not None else np.ones(4)
        got = replace(estimator, weights=given).estimate(read, np.broadcast_to(RIG.zeros, (2, 2, 2)))
        for row, pose in zip(read.reshape(2, 4), got, strict=True):

            def away(x: FloatArray, row: FloatArray = row, root: FloatArray = root) -> Any:
                return 1e3 * root * (readings(p, x[:, None], 0.7)[:, 0] - row)

            best = least_squares(away, np.zeros(3), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=[1e-3, 1e-3, 1e-2])
            assert pose == pytest.approx(best.x, abs=1e-8)


@pytest.mark.parametrize(
    ('pose', 'words'),
    [
        # The dot of psd_1 goes to its zero less the pose: 0.1 + 6 and -0.2 + 7 mm; of psd_2 0.3 + 5, 0.5 + 8.
        ((-6e-3, 0.0, 0.0), 'the dot of psd_2 would lie at x = 6.30 mm, outside its ±4 mm: less'),
        ((0.0, -8e-3, 0.0), 'the dot of psd_1 would lie at y = 7.80 mm, outside its ±6 mm: less'),
        ((0.0, 8e-3, 0.0), 'the dot of psd_1 would lie at y = -8.20 mm, outside its ±6 mm: less'),
        ((5.5e-3, 0.0, 0.0), 'the dot of psd_2 would lie at x = -5.20 mm, outside its ±4 mm: less'),
    ],
)
def test_a_dot_outside_is_named(pose: tuple[float, float, float], words: str) -> None:
    flat = replace_values(RIG, {'psd_1.height': 0.0, 'psd_2.height': 0.0, 'link.slope_ratio': 0.0})
    with pytest.raises(ConfigError) as error:
        Situation.at_pose(flat, read_inputs(), np.array(pose), 'exact', ('here', 'less'))
    assert str(error.value) == f'here: {words}'


def test_any_guess_makes_a_deviation_a_guess() -> None:
    # Of the refraction one input of three that are guesses is left; then none is.
    assert _term('refraction').freedom(_at()) == math.inf
    for name, default in (('laser_wavelength', 650e-9), ('air_gradient', 10.0), ('air_step', 10.0)):
        inputs = read_inputs(None, {**INPUTS, name: default})
        assert _term('refraction').freedom(Situation.at_load(RIG, inputs, LOAD, 'exact')) == 8.0


def test_draws_are_of_all_causes_together() -> None:
    at = _at()
    both = [_term('amplifier_noise'), _term('pointing_drift')]
    observed: list[int] = []
    errors = draws(at, 25_000, 5, both, observed.append)
    assert (observed, errors.shape) == ([10_000, 10_000, 5_000], (25_000, 3))
    total = np.sqrt(sum(np.diag(c.contribution(at).covariance) for c in both))
    assert errors.std(axis=0) == pytest.approx(total, rel=0.02)
    assert np.abs(errors.mean(axis=0) / total).max() < 5.0 / math.sqrt(25_000)
    assert not np.array_equal(errors[:5_000], errors[10_000:15_000])
    got = monte_carlo(at, 25_000, 5, both)
    assert got.bias == pytest.approx(errors.mean(axis=0), rel=1e-9)
    assert got.covariance == pytest.approx((errors - got.bias).T @ (errors - got.bias) / 24_999, rel=1e-9)


def test_a_window_must_hold_half_a_step() -> None:
    tolerance = 0.1198 * 1e-3
    for step, fits in ((2e-3 * (1.0 - 1e-9), True), (2e-3 * (1.0 + 1e-9), False)):
        at = _at('thesis_iteration', iteration_tolerance=tolerance, iteration_step=step)
        if fits:
            # The first trial inside the window is anywhere in it.
            assert COMPUTATION.contribution(at).bias[2] == pytest.approx(0.0, abs=1e-9)
            continue
        words = r'tolerance = 0\.0001198 m: its window of ±0\.001 rad is narrower than iteration_step = 0\.002 rad'
        with pytest.raises(ConfigError, match=words):
            COMPUTATION.contribution(at)


def test_a_twist_at_the_edge_of_the_window_is_missed_whole() -> None:
    at = _at('thesis_iteration', iteration_tolerance=2e-4, iteration_step=1e-4)
    window = 2e-4 / 0.1198
    for twist in (0.999 * window, -0.999 * window):
        line = COMPUTATION.contribution(replace(at, pose=np.array([0.0, 0.0, twist])))
        assert line.bias[2] == pytest.approx(-twist, rel=1e-9)
        assert not line.covariance.any()
    outside = COMPUTATION.contribution(replace(at, pose=np.array([0.0, 0.0, 1.001 * window])))
    assert outside.bias[2] == pytest.approx(-(window - 0.5e-4), rel=1e-9)


def test_a_method_answers_the_chain_that_it_models() -> None:
    at = _at('beam')
    assert perfect_answer(at) == pytest.approx(at.pose, abs=1e-14)
    # The tilt is not in the flat method's model, so it is not in its own error either.
    assert perfect_answer(_at()) == pytest.approx(_at().pose, abs=1e-14)
    drawn = draws(_at('wls'), 5, 1, [COMPUTATION])
    assert drawn == pytest.approx(np.tile(COMPUTATION.contribution(_at('wls')).bias, (5, 1)), abs=1e-15)
