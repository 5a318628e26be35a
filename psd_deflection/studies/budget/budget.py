# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every source of error does to ΔX, ΔY and θ of one rig under one load, and the load if the user names none."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from psd_deflection.model.link import LinkStatics
from psd_deflection.rig.config import Rig, check_two_psds, load_rig
from psd_deflection.studies.budget.chain import MeasuringChain, measure, method_of
from psd_deflection.studies.budget.evaluate import Interval, draws, evaluate, interval_of, monte_carlo
from psd_deflection.studies.budget.inputs import read_inputs
from psd_deflection.studies.budget.result import Budgeted
from psd_deflection.studies.budget.term import Contribution, Situation

SIDEBAR_FORCE = 50.0
"""N: the largest load of the thesis (chapter 5), hung on a sidebar one link length out on +X."""

SHARE = 0.5
"""Part of the way from its zero to the edge of the active area that a dot moves on a rig that is not the thesis's."""


def default_load(rig: Rig) -> tuple[float, float, float]:
    """Return a weight on a sidebar one link length out on +X: Fx N, Fy N, Tz N m.

    For the link and the detectors of the thesis its 50 N. For others as much as moves the first dot ``SHARE`` of the
    way to the edge of its active area, to two figures.
    """
    length = rig.link.length
    if _has_the_thesis_layout(rig):
        return 0.0, -SIDEBAR_FORCE, -SIDEBAR_FORCE * length
    chain = MeasuringChain.of(rig)
    statics = LinkStatics.from_rig(rig)
    # So small a turn that everything is linear in it.
    unit = 1e-6 * length / max(abs(v) for v in statics.deflection(0.0, -1.0, -length))
    pose = np.array(statics.deflection(0.0, -unit, -unit * length))
    moved, zero = (v[0] for v in measure(chain, pose))
    slope = (moved - measure(chain, np.zeros(3))[0][0]) / unit
    room = chain.half_area - np.sign(slope) * zero
    with np.errstate(divide='ignore'):
        force = float(np.min(SHARE * room / np.abs(slope)))
    force = max(force, 0.0)
    if force > 0.0:
        step = 10.0 ** (math.floor(math.log10(force)) - 1)
        force = round(math.floor(force / step) * step, 12)
    return 0.0, -force, -force * length


def _has_the_thesis_layout(rig: Rig) -> bool:
    nominal = load_rig()
    return rig.link == nominal.link and all(
        (a.center, a.height, a.active_area) == (b.center, b.height, b.active_area)
        for a, b in zip(rig.psds, nominal.psds, strict=True)
    )


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
