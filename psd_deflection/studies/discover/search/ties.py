# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects whose sizes one cause of the rig's geometry ties: a radius changes both stiffnesses by the same share.

EI = E pi/4 (R^4 - r^4) and GJ = G pi/2 (R^4 - r^4) (Gere and Goodno, Mechanics of Materials): a section that is scaled
changes both by the fourth power. Loads that are all noted too small by one factor deflect the link as if both were
smaller, but leave its natural frequencies. A length, 3 : 1, is tried by the search itself (:mod:`.hidden`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from psd_deflection.model.simulation.declaration import MOVES_FREQUENCY
from psd_deflection.studies.discover.search.weighing import Alternative, NamedEffect

SAME = 3.0
"""Standard deviations of their difference up to which two shares count as the same."""
EXACT = 0.003
"""Relative; a stand-in such as a clamp matches only approximately."""
CLEAR = 5.0
"""Standard deviations that a share is away from none."""


@dataclass(frozen=True, slots=True)
class CommonCause:
    """``factor``: by what the rig's radii, or the annotated loads, would have to be multiplied; with ``sd``."""

    name: str
    factor: float
    sd: float


@dataclass(frozen=True, slots=True)
class Tie:
    """``share``: by how much both stiffnesses differ from the rig file's, relative, with ``sd``; ``causes``: each
    explains both. ``moves``: whether the natural frequencies moved with them.
    """

    share: float
    sd: float
    moves: bool
    causes: tuple[CommonCause, ...]

    @property
    def sentence(self) -> str:
        """Why they are tied, the causes with their sizes, and what tells these apart."""
        share_words = f'{100.0 * self.share:.3g} ± {100.0 * self.sd:.1g} %'
        factors = {c.name: f'{c.factor:.5g} ± {c.sd:.1g}' for c in self.causes}
        words = f'Both stiffnesses, EI and GJ, differ by the same share ({share_words}), as one cause makes them: '
        radius = f"the link's radii times {factors['link_radius']} (EI and GJ grow with their fourth power)"
        if self.moves:
            return (
                f'{words}{radius}, or its material (E and G alike). Not the loads: the natural frequencies moved too. '
                f"Measure the link's diameter: that tells the radius from the material."
            )
        return (
            f'{words}{radius}, its material (E and G alike), or the annotated loads times {factors["load_unit"]}. '
            f"Static loads cannot tell these apart: measure the link's diameter, and weigh the loads."
        )


def ties(effects: Sequence[NamedEffect]) -> tuple[Tie, ...]:
    """Return the tie of the two stiffnesses among ``effects`` and their alternatives, if they differ by the same
    share.
    """
    for first, second in itertools.combinations(sorted(_shares(effects), key=lambda share: share.effect), 2):
        apart = SAME * math.hypot(first.sd, second.sd, EXACT * first.value)
        clear = min(abs(first.value) / first.sd, abs(second.value) / second.sd) > CLEAR
        same = first.moves == second.moves and abs(first.value - second.value) <= apart
        if first.effect != second.effect and same and clear:
            return (_tie(first.value, first.sd, second.value, second.sd, first.moves),)
    return ()


class _Share(NamedTuple):
    """Relative change of a stiffness by an effect, with its sd; ``moves``: whether the mode moves with it."""

    effect: str
    value: float
    sd: float
    moves: bool


def _shares(effects: Sequence[NamedEffect]) -> Iterator[_Share]:
    """The changes of stiffnesses, wherever they are named or an alternative."""
    for named in effects:
        either: tuple[NamedEffect | Alternative, ...] = (named, *named.fitted_alternatives)
        for e in either:
            effect = e.active.effect
            if MOVES_FREQUENCY not in effect.parameters:
                continue
            scale = next(p.name for p in effect.parameters if p.kind == 'amplitude')
            sd = e.sd.get(scale, 0.0)
            if sd > 0.0:
                yield _Share(effect.name, e.active.values[scale], sd, bool(e.active.values[MOVES_FREQUENCY.name]))


def _tie(a: float, sd_a: float, b: float, sd_b: float, moves: bool) -> Tie:
    weight = sd_b**2 / (sd_a**2 + sd_b**2)
    share = weight * a + (1.0 - weight) * b
    sd = sd_a * sd_b / math.hypot(sd_a, sd_b)
    radius = (1.0 + share) ** 0.25
    causes = [CommonCause('link_radius', radius, 0.25 * radius / (1.0 + share) * sd)]
    if not moves:
        causes.append(CommonCause('load_unit', 1.0 / (1.0 + share), sd / (1.0 + share) ** 2))
    return Tie(share, sd, moves, tuple(causes))
