# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a budget says, shows and writes, and its expanded uncertainty, against tables and sums by hand."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.budget.budget import BudgetProblem, budget
from psd_deflection.studies.budget.evaluate import (
    CAUSES,
    Interval,
    coverage_factor,
    difference,
    draws,
    effective_freedom,
    expanded,
    interval_of,
    monte_carlo,
)
from psd_deflection.studies.budget.inputs import read_inputs
from psd_deflection.studies.budget.result import Budgeted, in_words, type_of
from psd_deflection.studies.budget.term import Contribution, Distribution, Kind, Situation

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
    assert answer.sampled.covariance == pytest.approx(monte_carlo(answer.budget.at, 400, 3).covariance, rel=1e-6)
    assert answer.interval is not None
    again = interval_of(draws(answer.budget.at, 400, 3, shaped=True))
    assert answer.interval.half == pytest.approx(again.half, rel=1e-6)
    assert budget(BudgetProblem(NOISY_RIG, load=LOAD, method='wls')).budget.at.method == 'wls'
    sizes: list[int] = []
    budget(BudgetProblem(NOISY_RIG, load=LOAD, draws=10_003), sizes.append)
    assert sizes == [10_000, 3, 10_000, 3]


def test_the_expanded_uncertainty_is_shown_in_its_parts(answer: Budgeted, plain: Budgeted) -> None:
    variances = np.array([np.diag(line.covariance) for _, line in plain.budget.lines])
    bias = np.sum([line.bias for _, line in plain.budget.lines], axis=0)
    message = expanded(variances, [cause.freedom(plain.budget.at) for cause in CAUSES], bias)
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
    message = expanded(np.array([[4.0, 4.0, 0.0]]), [math.inf], np.zeros(3))
    got = difference(message, Interval(np.array([2.0 * 1.959964, 0.0, 0.0]), np.zeros(3)))
    assert got == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    assert difference(message, Interval(np.array([1.959964] * 3), np.zeros(3)))[:2] == pytest.approx(
        [1.0, 1.0], abs=1e-6
    )


def _same(tree: dict[str, Any], line: Contribution) -> None:
    assert tree['bias'] == line.bias.tolist()
    assert tree['covariance'] == line.covariance.tolist()
    assert tree['rms'] == pytest.approx(np.sqrt(line.bias**2 + np.diag(line.covariance)).tolist())


def test_the_tree_has_every_number(answer: Budgeted, plain: Budgeted) -> None:
    tree = json.loads(answer.json())
    at = answer.budget.at
    assert (tree['unit'], tree['load'], tree['pose']) == (['m', 'm', 'rad'], list(LOAD), at.pose.tolist())
    for one, (cause, line) in zip(tree['terms'], answer.budget.lines, strict=True):
        _same(one, line)
        assert one['kind'] == {'per estimate': 'per_estimate', 'known bias': 'known'}.get(
            cause.kind.value, 'systematic'
        )
        assert one['inputs'] == {name: read_inputs()[name] for name in cause.inputs}
        assert one['share'] == pytest.approx((line.rms**2 / answer.budget.total().rms ** 2).tolist())
        freedom = cause.freedom(at)
        assert one['freedom'] == (None if freedom == math.inf else pytest.approx(freedom))
        assert one['type'] == type_of(cause)
        for parameter, s in zip(one['parameters'], cause.sensitivities(at), strict=True):
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
    assert list(table.index.values) == [cause.name for cause in CAUSES]
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


RIG = load_rig()
SIDEBAR = (0.0, -50.0, -29.25)


def _at(**settings: float) -> Situation:
    return Situation.at_load(RIG, read_inputs(None, settings), SIDEBAR, 'exact')


@pytest.mark.parametrize(
    ('freedom', 'factor'), [(1, 12.71), (2, 4.30), (5, 2.57), (8, 2.31), (16, 2.12), (50, 2.01), (math.inf, 1.960)]
)
def test_coverage_factors_are_those_of_the_gum(freedom: float, factor: float) -> None:
    """JCGM 100:2008, table G.2, column 95 %."""
    assert coverage_factor(freedom) == pytest.approx(factor, abs=0.0051)


def test_effective_freedom_is_that_of_the_gum() -> None:
    """The example H.1.6: standard uncertainties in nm with their degrees of freedom give 16.7, so 16."""
    deviations, freedom = (25.0, 9.7, 2.9, 16.6), (18.0, 25.6, 50.0, 2.0)
    assert effective_freedom([v * v for v in deviations], freedom) == 16.0
    # A known deviation adds to the numerator alone; all known: infinite; never below 1.
    assert effective_freedom([1.0, 1.0], [3.0, math.inf]) == 12.0
    assert effective_freedom([1.0, 2.0], [math.inf, math.inf]) == math.inf
    assert effective_freedom([0.0], [5.0]) == math.inf
    assert effective_freedom([1.0], [0.5]) == 1.0


def test_a_bias_that_is_not_corrected_is_added_with_its_size() -> None:
    message = expanded(np.array([[9.0, 4.0, 1.0], [16.0, 0.0, 0.0]]), [math.inf, 8.0], np.array([0.0, -2.0, 3.0]))
    assert message.standard.tolist() == [5.0, 2.0, 1.0]
    # 25^2/(16^2/8) = 19.5.
    assert message.freedom.tolist() == [19.0, math.inf, math.inf]
    assert message.uncertainty == pytest.approx([2.093 * 5.0, 2.0 + 1.96 * 2.0, 3.0 + 1.96], abs=2e-3)


def test_draws_have_the_declared_distributions() -> None:
    """One cause alone, along one axis: the fourth moment over the squared variance tells the shape."""
    at = _at()
    kurtosis = {Distribution.UNIFORM: 1.8, Distribution.ARCSINE: 1.5, Distribution.NORMAL: 3.0}
    for name in ('sensor_rotation', 'interference', 'quantisation'):
        cause = next(c for c in CAUSES if c.name == name)
        # Of the angle of one detector alone the pose is a straight line; of several a sum of as many.
        parts = [s for s in cause.sensitivities(at) if abs(s.coefficient[0]) > 0.0]
        g = np.array([s.deviation * s.coefficient[0] for s in parts])
        errors = draws(at, 40_000, 5, [cause], shaped=True)[:, 0]
        expected = 3.0 + (kurtosis[cause.distribution] - 3.0) * float(np.sum(g**4) / np.sum(g**2) ** 2)
        centred = errors - errors.mean()
        assert np.mean(centred**4) / np.mean(centred**2) ** 2 == pytest.approx(expected, abs=0.12)
        assert errors.std() == pytest.approx(float(np.sqrt(np.sum(g**2))), rel=0.02)


def test_a_deviation_that_is_hardly_known_is_drawn_wider() -> None:
    at = _at()
    cause = next(c for c in CAUSES if c.name == 'pointing_drift')
    ratio = draws(at, 40_000, 5, [cause], shaped=True).std(axis=0) / draws(at, 40_000, 5, [cause]).std(axis=0)
    # Student's t of 8 degrees of freedom has the variance 8/6.
    assert ratio == pytest.approx(math.sqrt(8.0 / 6.0), rel=0.03)


@pytest.mark.slow
def test_u_is_half_of_the_drawn_interval() -> None:
    answer = budget(BudgetProblem(RIG, draws=20_000))
    assert answer.interval is not None
    message = answer.budget.expanded()
    assert np.abs(difference(message, answer.interval)).max() < 0.06
    errors = draws(answer.budget.at, 20_000, 1, shaped=True)
    inside = np.abs(errors - answer.interval.middle) <= answer.interval.half
    assert inside.mean(axis=0) == pytest.approx(0.95, abs=1e-4)
    assert any('Supplement 1' in line for line in answer.lines())


def test_an_interval_is_that_of_the_middle_95_percent() -> None:
    errors = np.stack([np.linspace(-1.0, 1.0, 100_001), np.linspace(0.0, 4.0, 100_001), np.zeros(100_001)], axis=1)
    found = interval_of(errors)
    assert found.half == pytest.approx([0.95, 1.9, 0.0])
    assert found.middle == pytest.approx([0.0, 2.0, 0.0], abs=1e-12)
