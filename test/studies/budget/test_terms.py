# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every term: right where a closed form says it, as Monte Carlo has it, and the chain with everything wrong."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.studies.budget.chain import MeasuringChain, dots, estimator_of, measure
from psd_deflection.studies.budget.evaluate import CAUSES, COMPUTATION, evaluate, monte_carlo, stop_window
from psd_deflection.studies.budget.inputs import INPUTS, read_inputs
from psd_deflection.studies.budget.installation import PLANE_TILT
from psd_deflection.studies.budget.sensor import AMPLIFIER_NOISE
from psd_deflection.studies.budget.term import Cause, Kind, Situation

GOLDEN: dict[str, Any] = json.loads((Path(__file__).parents[2] / 'data' / 'golden.json').read_text(encoding='utf-8'))
CASES = {c['name']: c for c in GOLDEN['cases']}
RIG = load_rig()
SIDEBAR = (0.0, -50.0, -29.25)
MICRO_MILLIDEGREE = np.array([1e6, 1e6, math.degrees(1e3)])


def _at(
    load: tuple[float, float, float] = SIDEBAR, method: str = 'exact', rig: Rig = RIG, **settings: float
) -> Situation:
    return Situation.at_load(rig, read_inputs(None, settings), load, method)


def _at_pose(pose: FloatArray, method: str = 'exact', rig: Rig = RIG) -> Situation:
    return replace(_at((0.0, 0.0, 0.0), method, rig), pose=pose)


def test_every_row_of_table_3_1_is_there() -> None:
    table = {'E_LP', 'E_DC', 'E_R', 'E_TH', 'E_RF', 'E_EMF', 'E_Algn', 'E_Tilt', 'E_C'}
    assert table <= {c.row for c in CAUSES}
    names = [c.name for c in CAUSES]
    assert len(set(names)) == len(names)


def test_terms_name_known_inputs_and_inputs_are_used() -> None:
    declared = {i.parameter.name for i in INPUTS}
    used = {name for c in CAUSES for name in c.inputs}
    assert used | {'noise_freedom', 'assumption_doubt'} == declared
    assert all(c.formula for c in CAUSES)
    assert all(i.source for i in INPUTS)


@pytest.mark.parametrize('cause', [c for c in CAUSES if c.kind is not Kind.KNOWN], ids=lambda c: str(c.name))
def test_an_input_that_is_named_has_an_effect(cause: Cause) -> None:
    before = cause.contribution(_at()).rms
    for name in cause.inputs:
        default = next(i.parameter.default for i in INPUTS if i.parameter.name == name)
        after = cause.contribution(_at(**{name: 1.1 * default})).rms
        assert np.any(np.abs(after / before - 1.0) > 1e-6), name


DRAWS = 10_000
# Four standard errors of a deviation from that many normal draws, and 1 % for what is beyond second order.
TOLERANCE = 4.0 / math.sqrt(2.0 * DRAWS) + 0.01


# A femtometre is rounding: E_C of an exact method, and the tilt where it is in the model.
FLOOR = np.array([1e-15, 1e-15, 1e-14])


@pytest.mark.parametrize(
    ('method', 'load'), [('exact', SIDEBAR), ('exact', (40.0, 20.0, 15.0)), ('beam', SIDEBAR), ('wls', SIDEBAR)]
)
def test_first_order_agrees_with_monte_carlo_for_each_cause(load: tuple[float, float, float], method: str) -> None:
    at, wrong = _at(load, method), []
    for cause in CAUSES:
        first, sampled = cause.contribution(at), monte_carlo(at, DRAWS, 7, [cause])
        deviation, drawn = (np.sqrt(np.diag(each.covariance)) for each in (first, sampled))
        largest = np.abs(first.bias) * TOLERANCE + 4.0 * deviation / math.sqrt(DRAWS) + FLOOR
        if drawn != pytest.approx(deviation, rel=TOLERANCE, abs=1e-15) or np.any(
            np.abs(sampled.bias - first.bias) > largest
        ):
            wrong.append((cause.name, deviation, drawn, first.bias, sampled.bias))
    assert not wrong


@pytest.mark.parametrize('method', ['exact', 'beam', 'wls', 'thesis_iteration'])
def test_the_total_agrees_with_drawing_everything_at_once(method: str) -> None:
    at = _at(method=method)
    total, sampled = evaluate(at).total(), monte_carlo(at, DRAWS, 11)
    assert sampled.rms == pytest.approx(total.rms, rel=TOLERANCE)
    deviation = np.sqrt(np.diag(total.covariance))
    assert np.all(np.abs(sampled.bias - total.bias) <= 5.0 * deviation / math.sqrt(DRAWS))
    # Not the deviations only: how dX, dY and theta go together.
    correlation = total.covariance / np.outer(deviation, deviation)
    drawn = sampled.covariance / np.sqrt(np.outer(np.diag(sampled.covariance), np.diag(sampled.covariance)))
    assert drawn == pytest.approx(correlation, abs=4.0 / math.sqrt(DRAWS) + 0.01)


def test_noise_of_the_tied_method_is_the_golden_covariance() -> None:
    # Golden case G5 at 2 um a channel.
    rig = replace_values(RIG, {'amplifier.noise': 4e-3 * math.sqrt(20.0)})
    dx, dy, _, theta, _, _ = CASES['G5']['pose']
    got = AMPLIFIER_NOISE.contribution(_at_pose(np.array([dx, dy, theta]), 'beam', rig)).covariance
    assert got == pytest.approx(np.array(GOLDEN['constants']['cov_beam_G5_2um']), rel=1e-6)


def test_the_tilt_left_out_is_the_golden_difference() -> None:
    # G5: cantilever tilt at 50 N; the flat method's answer less the truth.
    dx, dy, _, theta, _, _ = CASES['G5']['pose']
    pose = np.array([dx, dy, theta])
    expected = np.array(CASES['G5']['procrustes']) - pose
    assert PLANE_TILT.contribution(_at_pose(pose)).bias == pytest.approx(expected, rel=2e-3)
    assert np.all(PLANE_TILT.contribution(_at_pose(pose, 'beam')).bias == 0.0)


@pytest.mark.parametrize('name', ['G3', 'G4', 'G6', 'G9', 'G10'])
def test_the_stop_rule_is_short_by_its_window(name: str) -> None:
    # The golden answers stop at the first trial within 0.1 mm of agreement, in steps of 0.01 degree.
    dx, dy, _, theta, _, _ = CASES[name]['pose']
    at = _at_pose(np.array([dx, dy, theta]), 'thesis_iteration')
    got = COMPUTATION.contribution(at)
    stopped = np.array(CASES[name]['iter_22_abs']) - at.pose
    window = stop_window(RIG.centers, 0.1e-3)
    assert window * MICRO_MILLIDEGREE[2] == pytest.approx(57.30, abs=5e-3)
    step = math.radians(0.01)
    assert window - step - 1e-6 <= abs(stopped[2]) <= window + 1e-6
    # Uniform within one step: within half of one of the mean, and sqrt 12 times the deviation wide.
    assert abs(stopped[2] - got.bias[2]) <= step / 2.0 + 1e-6
    assert math.sqrt(12.0 * got.covariance[2, 2]) == pytest.approx(step, rel=1e-6)
    # The thesis takes d from PSD 1: so wrong an angle swings it by the arm.
    assert stopped[:2] / stopped[2] == pytest.approx(got.bias[:2] / got.bias[2], rel=0.02, abs=1e-3)


@pytest.mark.parametrize(('share', 'short', 'sd'), [(-0.99, 0.99, 0.0), (1.01, 1.0, math.radians(0.01) / 12**0.5)])
def test_within_the_window_of_its_stop_the_twist_is_not_seen(share: float, short: float, sd: float) -> None:
    window = stop_window(RIG.centers, 0.1e-3)
    got = COMPUTATION.contribution(_at_pose(np.array([1e-3, 0.0, share * window]), 'thesis_iteration'))
    step = math.radians(0.01) if sd else 0.0
    assert got.bias[2] == pytest.approx(-math.copysign(short * window - step / 2.0, share), rel=1e-6)
    assert math.sqrt(got.covariance[2, 2]) == pytest.approx(sd, rel=1e-6, abs=1e-12)


def test_shares_add_to_one_where_one_bias_stands_alone() -> None:
    budget = evaluate(_at())
    assert np.sum([budget.shares(line) for _, line in budget.lines], axis=0) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'rotation': 0.1}, 'did you mean rotation_tolerance'),
        ({'laser_power': 0.0}, 'above 0'),
        ({'dark_current': 'much'}, 'must be a number'),
        ({'temperature': 20.0}, 'above 223.15'),
    ],
)
def test_a_bad_input_is_rejected_by_name(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        read_inputs(None, settings)
    assert message in str(error.value)
    assert next(iter(settings)) in str(error.value)


@pytest.mark.parametrize(
    ('text', 'message'), [('- 1', 'name: value'), ('{', 'malformed YAML'), ('x: 1', 'no such input')]
)
def test_a_bad_file_of_inputs_is_rejected_by_name(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / 'inputs.yaml'
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        read_inputs(path)
    assert message in str(error.value)
    assert 'inputs.yaml' in str(error.value)


def test_inputs_come_from_file_and_settings_in_this_order(tmp_path: Path) -> None:
    path = tmp_path / 'inputs.yaml'
    path.write_text('nonlinearity: 5e-4\nair_gradient: 3\n')
    got = read_inputs(path, {'air_gradient': '4.5'})
    assert (got['nonlinearity'], got['air_gradient'], got['gain_tolerance']) == (5e-4, 4.5, 2e-3)
    empty = tmp_path / 'empty.yaml'
    empty.write_text('')
    assert read_inputs(empty) == read_inputs()
    with pytest.raises(ConfigError, match='no such file'):
        read_inputs(tmp_path / 'absent.yaml')


def _pose(name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    dx, dy, _, theta, _, _ = CASES[name]['pose']
    return np.array([dx, dy, theta])


def _slope_ratio(name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    _, dy, _, _, phi, _ = CASES[name]['pose']
    return np.array([-phi * 0.585 / dy if dy else 0.0])


@pytest.mark.parametrize('name', ['G1', 'G2', 'G3', 'G4', 'G5', 'G6', 'G9', 'G10'])
def test_a_perfect_chain_gives_the_golden_readings(name: str) -> None:
    chain = replace(MeasuringChain.of(RIG), slope_ratio=_slope_ratio(name))
    readings, zeros = measure(chain, _pose(name))
    assert readings[0] == pytest.approx(np.array(CASES[name]['readings']), abs=1e-15)
    assert np.all(zeros == 0.0)


def test_everything_wrong_at_once() -> None:
    # Golden case G12: heights, inclined beams, turned sensors, gains, offsets before load, shortening.
    case = CASES['G12']
    gains = np.array([[1.01, 1.0], [1.0, 0.98]])
    slope = np.tan(np.radians([1.0, 0.5]))
    chain = replace(
        MeasuringChain.of(RIG),
        slope_ratio=_slope_ratio('G12'),
        zeros=np.array(case['m0']) / gains,
        heights=np.array([0.02, 0.02]),
        beam_slope=np.array([[[slope[0], 0.0], [0.0, -slope[1]]]]),
        rotation=np.radians([[1.0, -0.5]]),
        gain=gains[None] - 1.0,
    )
    got = dots(chain, _pose('G12'), dz=case['pose'][2])[0] * gains
    assert got == pytest.approx(np.array(case['readings']), abs=1e-12)
    # measure() reads the same without the shortening, which only inclined beams see.
    readings, zeros = measure(chain, _pose('G12'))
    assert zeros[0] == pytest.approx(np.array(case['m0']), rel=1e-12)
    assert np.max(np.abs(readings[0] - got)) == pytest.approx(slope[0] * case['pose'][2], rel=0.05)


@pytest.mark.parametrize(('method', 'key'), [('exact', 'procrustes'), ('beam', 'beam_gn_k1.5'), ('wls', 'ols')])
@pytest.mark.parametrize('name', [n for n in CASES if n != 'G12'])
def test_the_estimators_give_the_golden_answers(name: str, method: str, key: str) -> None:
    case = CASES[name]
    rig = replace_values(RIG, {'wls.weights': 'inverse_variance'})
    readings, zeros = np.array([case['readings']]), np.array([case['m0']])
    # The linear method's A is of the beams, so the rig must know its zeros.
    rig = replace_values(rig, {'psd_1.zero': case['m0'][0], 'psd_2.zero': case['m0'][1]})
    got = estimator_of(rig, method).estimate(readings, zeros)[0]
    assert got == pytest.approx(case[key], abs=1e-10)


def test_a_method_that_there_is_not_and_a_rig_that_sees_no_twist() -> None:
    with pytest.raises(ConfigError, match='must be one of exact, beam, wls'):
        estimator_of(RIG, 'magic')
    with pytest.raises(ConfigError, match='the twist cannot be seen'):
        estimator_of(replace_values(RIG, {'psd_2.center': [0.0, 0.070]}), 'exact')
