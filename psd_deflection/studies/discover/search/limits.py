"""Limits that end a search before the evidence does, and what lies beyond them, to first order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.hold_out import unseen_gap
from psd_deflection.studies.discover.search.screen import Score, Screen

MOST_TERMS = 20
"""Terms beyond a limit that are counted at most."""


@dataclass(frozen=True, slots=True)
class Limit:
    """``limit``: what ended the search, in words. ``beyond``: what more of it would give, in words."""

    limit: str
    beyond: str


def beyond(
    workspace: Comparison, screen: Screen, fit: Fit, passes: Callable[[Score], bool], taken: frozenset[str]
) -> str:
    """The terms of ``screen`` that pass one by one beside ``fit``, and the gap that they leave on unseen load cases.

    Linear: no simulation is made. ``passes``: the rule for one more term; ``taken``: names of effects that are not
    asked. '' if no term passes.
    """
    columns = [fit.jacobian[:, j] for j, name in enumerate(fit.free) if name not in fit.at_bound]
    names: list[str] = []
    used: set[tuple[object, ...]] = set()
    while len(names) < MOST_TERMS:
        known = np.column_stack(columns) if columns else None
        further = [
            s
            for s in screen.score(fit.residual, known)
            if s.candidate.variant not in used and s.candidate.effect.name not in taken and passes(s)
        ]
        if not further:
            break
        best = max(further, key=lambda s: s.gain)
        used.add(best.candidate.variant)
        names.append(best.candidate.effect.name)
        columns += screen.columns_of(best.candidate)
    if not names:
        return ''
    gap = unseen_gap(workspace, fit, np.column_stack(columns))
    now = workspace.gap(fit.difference)
    terms = ', '.join(name if n == 1 else f'{n} × {name}' for name, n in Counter(names).items())
    many = f'{MOST_TERMS} or more' if len(names) == MOST_TERMS else f'{len(names)} more'
    return (
        f'{many} term{"" if len(names) == 1 else "s"} ({terms}) would pass one by one, to first order; '
        'on unseen load cases the gap would be '
        f'{workspace.worded(gap)} instead of {workspace.worded(now)}'
    )
