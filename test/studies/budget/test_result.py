# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a budget says, shows and writes, against the numbers of its causes and sums by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.budget.budget import BudgetProblem, budget
from psd_deflection.studies.budget.evaluate import CAUSES, draws, monte_carlo
from psd_deflection.studies.budget.expanded import Interval, difference, expanded, interval_of
from psd_deflection.studies.budget.inputs import read_inputs
from psd_deflection.studies.budget.result import (
    Budgeted,
    in_words,
    type_of,
)
from psd_deflection.studies.budget.term import Contribution, Kind

RIG = replace_values(load_rig(), {'psd_2.noise': [4e-3, 2e-3]})
LOAD = (8.0, -30.0, -12.0)
AXES = ('dx', 'dy', 'theta')
SCALES = np.array([1e6, 1e6, 180.0 / math.pi * 1e3])


@pytest.fixture(scope='module')
def answer() -> Budgeted:
    return budget(BudgetProblem(RIG, load=LOAD, draws=400, seed=3, rig_file='rig.yaml'))


@pytest.fixture(scope='module')
def plain() -> Budgeted:
    return budget(BudgetProblem(RIG, load=LOAD))


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
    assert budget(BudgetProblem(RIG, load=LOAD, method='wls')).budget.at.method == 'wls'
    sizes: list[int] = []
    budget(BudgetProblem(RIG, load=LOAD, draws=10_003), sizes.append)
    assert sizes == [10_000, 3, 10_000, 3]


def test_the_expanded_uncertainty_is_shown_in_its_parts(answer: Budgeted, plain: Budgeted) -> None:
    variances = np.array([np.diag(line.covariance) for _, line in plain.budget.lines])
    bias = np.sum([line.bias for _, line in plain.budget.lines], axis=0)
    message = expanded(variances, [cause.freedom(plain.budget.at) for cause in CAUSES], bias)
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
    # The first is what was drawn; of the others nothing was drawn.
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
    known = budget(BudgetProblem(RIG, inputs, LOAD))
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
