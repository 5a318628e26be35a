# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Limits that end a search before the evidence does, and what lies beyond them, to first order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.records import FloatArray
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


@dataclass(frozen=True, slots=True)
class Terms:
    """``names`` of effects; ``columns`` (D, p), whitened: what they and the parameters of a fit do, in proportion."""

    names: Sequence[str]
    columns: FloatArray


def further_terms(
    screen: Screen, fit: Fit, passes: Callable[[Score], bool], taken: frozenset[str], most: int = MOST_TERMS
) -> Terms | None:
    """Return the terms of ``screen`` that pass one by one beside ``fit``, to first order; None if no term passes.

    No simulation is made. ``passes``: the rule for one more term; ``taken``: names of effects that are not asked.
    """
    columns = [fit.jacobian[:, j] for j, name in enumerate(fit.free) if name not in fit.at_bound]
    names: list[str] = []
    used: set[tuple[object, ...]] = set()
    while len(names) < most:
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
    return Terms(names, np.column_stack(columns)) if names else None


def beyond(workspace: Comparison, fit: Fit, terms: Terms) -> str:
    """What ``terms`` beside ``fit`` would give on unseen load cases, in words."""
    gap = unseen_gap(workspace, fit, terms.columns)
    now = workspace.gap(fit.difference)
    listed = ', '.join(name if n == 1 else f'{n} × {name}' for name, n in Counter(terms.names).items())
    count = len(terms.names)
    many = f'{MOST_TERMS} or more' if count == MOST_TERMS else f'{count} more'
    return (
        f'{many} term{"" if count == 1 else "s"} ({listed}) would pass one by one, to first order; '
        'on unseen load cases the gap would be '
        f'{workspace.worded(gap)} instead of {workspace.worded(now)}'
    )
