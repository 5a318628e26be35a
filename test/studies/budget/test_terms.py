# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every term and the chain: closed forms, Monte Carlo; what a budget says and writes, against tables and by hand."""

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
from psd_deflection.studies.budget import evaluate as evaluation
from psd_deflection.studies.budget.budget import BudgetProblem, budget
from psd_deflection.studies.budget.chain import MeasuringChain, dots, estimator_of, measure
from psd_deflection.studies.budget.inputs import INPUTS, read_inputs
from psd_deflection.studies.budget.installation import PLANE_TILT
from psd_deflection.studies.budget.result import Budgeted, in_words, type_of
from psd_deflection.studies.budget.sensor import AMPLIFIER_NOISE
from psd_deflection.studies.budget.term import Cause, Contribution, Distribution, Kind, Situation

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
    assert table <= {c.row for c in evaluation.CAUSES}
    names = [c.name for c in evaluation.CAUSES]
    assert len(set(names)) == len(names)


def test_terms_name_known_inputs_and_inputs_are_used() -> None:
    declared = {i.parameter.name for i in INPUTS}
    used = {name for c in evaluation.CAUSES for name in c.inputs}
    assert used | {'noise_freedom', 'assumption_doubt'} == declared
    assert all(c.formula for c in evaluation.CAUSES)
    assert all(i.source for i in INPUTS)


@pytest.mark.parametrize('cause', [c for c in evaluation.CAUSES if c.kind is not Kind.KNOWN], ids=lambda c: str(c.name))
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
    for cause in evaluation.CAUSES:
        first, sampled = cause.contribution(at), evaluation.monte_carlo(at, DRAWS, 7, [cause])
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
    total, sampled = evaluation.evaluate(at).total(), evaluation.monte_carlo(at, DRAWS, 11)
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
    got = evaluation.COMPUTATION.contribution(at)
    stopped = np.array(CASES[name]['iter_22_abs']) - at.pose
    window = evaluation.stop_window(RIG.centers, 0.1e-3)
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
    window = evaluation.stop_window(RIG.centers, 0.1e-3)
    got = evaluation.COMPUTATION.contribution(_at_pose(np.array([1e-3, 0.0, share * window]), 'thesis_iteration'))
    step = math.radians(0.01) if sd else 0.0
    assert got.bias[2] == pytest.approx(-math.copysign(short * window - step / 2.0, share), rel=1e-6)
    assert math.sqrt(got.covariance[2, 2]) == pytest.approx(sd, rel=1e-6, abs=1e-12)


def test_shares_add_to_one_where_one_bias_stands_alone() -> None:
    budget = evaluation.evaluate(_at())
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
    assert estimator_of(rig, method).estimate(readings, zeros)[0] == pytest.approx(case[key], abs=1e-10)


def test_a_method_that_there_is_not_and_a_rig_that_sees_no_twist() -> None:
    with pytest.raises(ConfigError, match='must be one of exact, beam, wls'):
        estimator_of(RIG, 'magic')
    with pytest.raises(ConfigError, match='the twist cannot be seen'):
        estimator_of(replace_values(RIG, {'psd_2.center': [0.0, 0.070]}), 'exact')


NOISY_RIG = replace_values(load_rig(), {'psd_2.noise': [4e-3, 2e-3]})
LOAD = (8.0, -30.0, -12.0)
AXES = ('dx', 'dy', 'theta')
SCALES = np.array([1e6, 1e6, 180.0 / math.pi * 1e3])


@pytest.fixture(scope='module')
def answer() -> Budgeted:
    return budget(BudgetProblem(NOISY_RIG, load=LOAD, draws=400, seed=3, rig_file='rig.yaml'))


@pytest.fixture(scope='module')
def plain() -> Budgeted:
    return budget(BudgetProblem(NOISY_RIG, load=LOAD))


def test_the_problem_says_what_is_computed(answer: Budgeted, plain: Budgeted) -> None:
    assert (answer.draws, answer.seed, answer.load, answer.sources) == (400, 3, LOAD, {'rig': 'rig.yaml'})
    assert answer.budget.at.method == 'exact'
    assert (plain.sampled, plain.interval, plain.draws, plain.seed, plain.sources) == (None, None, 0, 1, {})
    # Drawn once as normal, and once more as declared.
    assert answer.sampled is not None
    assert answer.sampled.covariance == pytest.approx(
        evaluation.monte_carlo(answer.budget.at, 400, 3).covariance, rel=1e-6
    )
    assert answer.interval is not None
    again = evaluation.interval_of(evaluation.draws(answer.budget.at, 400, 3, shaped=True))
    assert answer.interval.half == pytest.approx(again.half, rel=1e-6)
    assert budget(BudgetProblem(NOISY_RIG, load=LOAD, method='wls')).budget.at.method == 'wls'
    sizes: list[int] = []
    budget(BudgetProblem(NOISY_RIG, load=LOAD, draws=10_003), sizes.append)
    assert sizes == [10_000, 3, 10_000, 3]


def test_the_expanded_uncertainty_is_shown_in_its_parts(answer: Budgeted, plain: Budgeted) -> None:
    variances = np.array([np.diag(line.covariance) for _, line in plain.budget.lines])
    bias = np.sum([line.bias for _, line in plain.budget.lines], axis=0)
    message = evaluation.expanded(variances, [cause.freedom(plain.budget.at) for cause in evaluation.CAUSES], bias)
    dx, dy, theta = plain.budget.at.pose.tolist()
    pose = (
        f'ΔX {1e3 * dx:.4f} mm, ΔY {1e3 * dy:.4f} mm, θ {math.degrees(theta):.4f} deg; method exact; mean of 20 samples'
    )
    assert plain.lines()[0].endswith(pose)
    _, *rows = plain.expanded_rows()
    assert len(rows) == 5
    assert [float(v) for v in rows[0][1:]] == pytest.approx((message.standard * SCALES).tolist(), abs=6e-4)
    assert rows[1][1:] == [f'{v:.0f}' for v in message.freedom.tolist()]
    assert rows[2][1:] == [f'{v:.3f}' for v in message.factor.tolist()]
    assert [float(v) for v in rows[3][1:]] == pytest.approx((bias * SCALES).tolist(), abs=6e-4)
    by_hand = message.factor * message.standard + np.abs(bias)
    assert [float(v) for v in rows[4][1:]] == pytest.approx((by_hand * SCALES).tolist(), abs=6e-4)
    assert answer.interval is not None
    drawn = answer.expanded_rows()[6:]
    assert [float(v) for v in drawn[0][1:]] == pytest.approx((answer.interval.half * SCALES).tolist(), abs=6e-4)
    off = 100.0 * (message.factor * message.standard / answer.interval.half - 1.0)
    assert drawn[1][1:] == [f'{v:+.1f}' for v in off.tolist()]
    sentence = answer.sentences()[-1]
    assert f'ΔX {off[0]:+.1f} %, ΔY {off[1]:+.1f} %, θ {off[2]:+.1f} %.' in sentence
    assert f'within {in_words(answer.interval.half)};' in sentence
    assert sentence.startswith('400 draws of the declared distributions')


def test_without_a_spread_there_is_no_difference() -> None:
    message = evaluation.expanded(np.array([[4.0, 4.0, 0.0]]), [math.inf], np.zeros(3))
    got = evaluation.difference(message, evaluation.Interval(np.array([2.0 * 1.959964, 0.0, 0.0]), np.zeros(3)))
    assert got == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    assert evaluation.difference(message, evaluation.Interval(np.array([1.959964] * 3), np.zeros(3)))[
        :2
    ] == pytest.approx([1.0, 1.0], abs=1e-6)


def _same(tree: dict[str, Any], line: Contribution) -> None:
    assert (tree['bias'], tree['covariance']) == (line.bias.tolist(), line.covariance.tolist())
    assert tree['rms'] == pytest.approx(np.sqrt(line.bias**2 + np.diag(line.covariance)).tolist())


def test_the_tree_has_every_number(answer: Budgeted, plain: Budgeted) -> None:
    tree = json.loads(answer.json())
    at = answer.budget.at
    assert (tree['unit'], tree['load'], tree['pose']) == (['m', 'm', 'rad'], list(LOAD), at.pose.tolist())
    for term, (cause, line) in zip(tree['terms'], answer.budget.lines, strict=True):
        _same(term, line)
        assert term['kind'] == {'per estimate': 'per_estimate', 'known bias': 'known'}.get(
            cause.kind.value, 'systematic'
        )
        assert term['inputs'] == {name: read_inputs()[name] for name in cause.inputs}
        assert term['share'] == pytest.approx((line.rms**2 / answer.budget.total().rms ** 2).tolist())
        freedom = cause.freedom(at)
        assert term['freedom'] == (None if freedom == math.inf else pytest.approx(freedom))
        assert term['type'] == type_of(cause)
        for parameter, s in zip(term['parameters'], cause.sensitivities(at), strict=True):
            assert (parameter['name'], parameter['u'], parameter['unit']) == (s.name, s.deviation, cause.unit)
            assert parameter['sensitivity'] == pytest.approx(s.coefficient.tolist(), rel=1e-9, abs=1e-9)
    _same(tree['totals']['total'], answer.budget.total())
    for kind in Kind:
        _same(tree['totals'][kind.name.lower()], answer.budget.total(kind))
    assert answer.sampled is not None
    assert answer.interval is not None
    _same(tree['totals']['monte_carlo'], answer.sampled)
    stated = tree['expanded']
    assert stated['probability'] == 0.95
    assert stated['uncertainty'] == pytest.approx(answer.budget.expanded().uncertainty.tolist())
    assert stated['freedom'] == pytest.approx(answer.budget.expanded().freedom.tolist())
    assert stated['monte_carlo']['half'] == answer.interval.half.tolist()
    assert stated['monte_carlo']['middle'] == answer.interval.middle.tolist()
    assert 'monte_carlo' not in plain.tree()['expanded']
    assert 'monte_carlo' not in plain.tree()['totals']
    # Nothing is doubted: infinitely many degrees of freedom, which JSON does not have.
    inputs = read_inputs(None, {'assumption_doubt': 0.0, 'noise_freedom': 1e9})
    known = budget(BudgetProblem(NOISY_RIG, inputs, LOAD))
    quiet = replace(known, budget=replace(known.budget, lines=known.budget.lines[:1]))
    assert quiet.tree()['expanded']['freedom'] == [None] * 3


def test_the_table_has_a_row_for_every_cause(plain: Budgeted) -> None:
    table = plain.table()
    assert list(table.index.values) == [cause.name for cause in evaluation.CAUSES]
    columns = {column.name: column for column in table.columns}
    assert list(columns) == ['kind', 'freedom', *(f'rms_{a}' for a in AXES), *(f'share_{a}' for a in AXES)]
    assert [columns[f'rms_{a}'].unit for a in AXES] == ['m', 'm', 'rad']
    assert [columns[f'share_{a}'].unit for a in AXES] == ['', '', '']
    for i, (cause, line) in enumerate(plain.budget.lines):
        assert columns['kind'].values[i] == cause.kind.value
        assert columns['freedom'].values[i] == cause.freedom(plain.budget.at)
        assert [columns[f'rms_{a}'].values[i] for a in AXES] == line.rms.tolist()
        assert [columns[f'share_{a}'].values[i] for a in AXES] == plain.budget.shares(line).tolist()
    assert table.attributes == {'method': 'exact', 'load': LOAD}


def _at_sidebar(**settings: float) -> Situation:
    return Situation.at_load(RIG, read_inputs(None, settings), SIDEBAR, 'exact')


@pytest.mark.parametrize(
    ('freedom', 'factor'), [(1, 12.71), (2, 4.30), (5, 2.57), (8, 2.31), (16, 2.12), (50, 2.01), (math.inf, 1.960)]
)
def test_coverage_factors_are_those_of_the_gum(freedom: float, factor: float) -> None:
    """JCGM 100:2008, table G.2, column 95 %."""
    assert evaluation.coverage_factor(freedom) == pytest.approx(factor, abs=0.0051)


def test_effective_freedom_is_that_of_the_gum() -> None:
    """The example H.1.6: standard uncertainties in nm with their degrees of freedom give 16.7, so 16."""
    deviations, freedom = (25.0, 9.7, 2.9, 16.6), (18.0, 25.6, 50.0, 2.0)
    assert evaluation.effective_freedom([v * v for v in deviations], freedom) == 16.0
    # A known deviation adds to the numerator alone; all known: infinite; never below 1.
    assert evaluation.effective_freedom([1.0, 1.0], [3.0, math.inf]) == 12.0
    assert evaluation.effective_freedom([1.0, 2.0], [math.inf, math.inf]) == math.inf
    assert (evaluation.effective_freedom([0.0], [5.0]), evaluation.effective_freedom([1.0], [0.5])) == (math.inf, 1.0)


def test_a_bias_that_is_not_corrected_is_added_with_its_size() -> None:
    message = evaluation.expanded(
        np.array([[9.0, 4.0, 1.0], [16.0, 0.0, 0.0]]), [math.inf, 8.0], np.array([0.0, -2.0, 3.0])
    )
    assert message.standard.tolist() == [5.0, 2.0, 1.0]
    # 25^2/(16^2/8) = 19.5.
    assert message.freedom.tolist() == [19.0, math.inf, math.inf]
    assert message.uncertainty == pytest.approx([2.093 * 5.0, 2.0 + 1.96 * 2.0, 3.0 + 1.96], abs=2e-3)


def test_draws_have_the_declared_distributions() -> None:
    """One cause alone, along one axis: the fourth moment over the squared variance tells the shape."""
    at = _at_sidebar()
    kurtosis = {Distribution.UNIFORM: 1.8, Distribution.ARCSINE: 1.5, Distribution.NORMAL: 3.0}
    for name in ('sensor_rotation', 'interference', 'quantisation'):
        cause = next(c for c in evaluation.CAUSES if c.name == name)
        # Of the angle of one detector alone the pose is a straight line; of several a sum of as many.
        parts = [s for s in cause.sensitivities(at) if abs(s.coefficient[0]) > 0.0]
        g = np.array([s.deviation * s.coefficient[0] for s in parts])
        errors = evaluation.draws(at, 40_000, 5, [cause], shaped=True)[:, 0]
        expected = 3.0 + (kurtosis[cause.distribution] - 3.0) * float(np.sum(g**4) / np.sum(g**2) ** 2)
        centred = errors - errors.mean()
        assert np.mean(centred**4) / np.mean(centred**2) ** 2 == pytest.approx(expected, abs=0.12)
        assert errors.std() == pytest.approx(float(np.sqrt(np.sum(g**2))), rel=0.02)


def test_a_deviation_that_is_hardly_known_is_drawn_wider() -> None:
    at = _at_sidebar()
    cause = next(c for c in evaluation.CAUSES if c.name == 'pointing_drift')
    ratio = evaluation.draws(at, 40_000, 5, [cause], shaped=True).std(axis=0) / evaluation.draws(
        at, 40_000, 5, [cause]
    ).std(axis=0)
    # Student's t of 8 degrees of freedom has the variance 8/6.
    assert ratio == pytest.approx(math.sqrt(8.0 / 6.0), rel=0.03)


@pytest.mark.slow
def test_u_is_half_of_the_drawn_interval() -> None:
    answer = budget(BudgetProblem(RIG, draws=20_000))
    assert answer.interval is not None
    assert np.abs(evaluation.difference(answer.budget.expanded(), answer.interval)).max() < 0.06
    errors = evaluation.draws(answer.budget.at, 20_000, 1, shaped=True)
    inside = np.abs(errors - answer.interval.middle) <= answer.interval.half
    assert inside.mean(axis=0) == pytest.approx(0.95, abs=1e-4)
    assert any('Supplement 1' in line for line in answer.lines())


def test_an_interval_is_that_of_the_middle_95_percent() -> None:
    errors = np.stack([np.linspace(-1.0, 1.0, 100_001), np.linspace(0.0, 4.0, 100_001), np.zeros(100_001)], axis=1)
    interval = evaluation.interval_of(errors)
    assert interval.half == pytest.approx([0.95, 1.9, 0.0])
    assert interval.middle == pytest.approx([0.0, 2.0, 0.0], abs=1e-12)
