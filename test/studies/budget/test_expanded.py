# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The expanded uncertainty: quantiles and degrees of freedom against tables and formulas written again."""

from __future__ import annotations

import math

import numpy as np
import pytest

from psd_deflection.rig.config import load_rig
from psd_deflection.studies.budget.budget import BudgetProblem, budget
from psd_deflection.studies.budget.evaluate import CAUSES, draws
from psd_deflection.studies.budget.expanded import coverage_factor, difference, effective_freedom, expanded, interval_of
from psd_deflection.studies.budget.inputs import read_inputs
from psd_deflection.studies.budget.term import Distribution, Situation

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
    # And the interval has 95 % of the draws, counted.
    errors = draws(answer.budget.at, 20_000, 1, shaped=True)
    inside = np.abs(errors - answer.interval.middle) <= answer.interval.half
    assert inside.mean(axis=0) == pytest.approx(0.95, abs=1e-4)
    assert any('Supplement 1' in line for line in answer.lines())


def test_an_interval_is_that_of_the_middle_95_percent() -> None:
    errors = np.stack([np.linspace(-1.0, 1.0, 100_001), np.linspace(0.0, 4.0, 100_001), np.zeros(100_001)], axis=1)
    found = interval_of(errors)
    assert found.half == pytest.approx([0.95, 1.9, 0.0])
    assert found.middle == pytest.approx([0.0, 2.0, 0.0], abs=1e-12)
