# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every source of error does to ΔX, ΔY and θ of one rig under one load."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from psd_deflection.rig.config import Rig, check_two_psds
from psd_deflection.studies.budget.estimate import method_of
from psd_deflection.studies.budget.evaluate import draws, evaluate, monte_carlo
from psd_deflection.studies.budget.expanded import Interval, interval_of
from psd_deflection.studies.budget.inputs import read_inputs
from psd_deflection.studies.budget.load import default_load
from psd_deflection.studies.budget.result import Budgeted
from psd_deflection.studies.budget.term import Contribution, Situation


@dataclass(frozen=True)
class BudgetProblem:
    """``rig``; ``inputs``: sizes of the errors by name, those that differ from the defaults.

    ``load``: at the tip, Fx N, Fy N, Tz N m; None: a weight on a sidebar that suits the rig. ``method``: whose errors
    are computed; None: that of the rig. ``draws``: random draws of all causes at once, 0: none; as many normal ones as
    of the declared distributions. ``seed`` of them. ``rig_file``: the name of the rig's, '' if it has none.
    """

    rig: Rig
    inputs: Mapping[str, float] = field(default_factory=lambda: read_inputs(None, {}))
    load: tuple[float, float, float] | None = None
    method: str | None = None
    draws: int = 0
    seed: int = 1
    rig_file: str = ''


def budget(problem: BudgetProblem, drawn: Callable[[int], object] = lambda size: None) -> Budgeted:
    """Every cause to first order, and the random draws that must agree; ``drawn`` gets the number of draws just done.

    Raises ConfigError for a load that leaves the active area, a method that does not suit the rig, more than two PSDs.
    """
    rig = problem.rig
    check_two_psds(rig, 'a budget')
    load = default_load(rig) if problem.load is None else problem.load
    budget_at_load = evaluate(Situation.at_load(rig, problem.inputs, load, problem.method or method_of(rig)))
    sampled: Contribution | None = None
    interval: Interval | None = None
    if problem.draws:
        sampled = monte_carlo(budget_at_load.at, problem.draws, problem.seed, drawn=drawn)
        interval = interval_of(draws(budget_at_load.at, problem.draws, problem.seed, drawn=drawn, shaped=True))
    return Budgeted(budget_at_load, load, sampled, interval, problem.draws, problem.seed, problem.rig_file)
